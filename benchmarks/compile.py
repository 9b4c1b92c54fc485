"""Time to compile: cfjax's methods over diffrax's Tsit5 in plain space, through `diffeqsolve`.

It measures processor time to trace, lower and compile, which other work on the machine disturbs
less than wall time, for three problems, each with fixed steps, adaptive steps, output at given
times, and a gradient. Programs take turns with Tsit5. Then it measures second derivatives.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import results
from cfjax.scenes import rigid_body

WAYS = ("fixed steps", "controlled steps", "output at times", "gradient")
METHODS = {
    "CF4": cfjax.CF4(),
    "CF43": cfjax.CF43(),
    "CF54": cfjax.CF54(),
    "YRK135": cfjax.YRK135(),
    "RKMK(Dopri8)": cfjax.RKMK(diffrax.Dopri8.tableau),
}
# It does not estimate its error.
WITHOUT_CONTROL = ("YRK135",)

RNG = np.random.default_rng(0)
REAL = RNG.normal(size=(4, 4))
COMPLEX = RNG.normal(size=(3, 3)) + 1j * RNG.normal(size=(3, 3))


def skew(t, y, args):
    a = REAL @ y + jnp.sin(t) * REAL.T
    return cfjax.LeftMatrix(a - a.T)


def skew_hermitian(t, y, args):
    a = jnp.cos(t) * (COMPLEX @ y) + jnp.sin(t) * COMPLEX
    return cfjax.LeftMatrix(a - a.conj().T)


PROBLEMS: dict[str, tuple[Callable[..., Any], Any]] = {
    "rigid body": (lambda t, y, args: rigid_body.field(t, y, rigid_body.inertia), rigid_body.y0),
    "4 x 4 real": (skew, np.eye(4)),
    "3 x 3 complex": (skew_hermitian, np.eye(3, dtype=complex)),
}


def program(problem: str, method: str, way: str) -> Callable[[Any], Any]:
    field, _ = PROBLEMS[problem]
    term, solver = cfjax.LieTerm(field), METHODS.get(method)
    if solver is None:
        term = diffrax.ODETerm(lambda t, y, args: field(t, y, args).tangent(y))
        solver = diffrax.Tsit5()
    options: dict[str, Any] = {}
    if way == "controlled steps":
        options["stepsize_controller"] = diffrax.PIDController(rtol=0.0, atol=1e-6)
    if way == "output at times":
        options["saveat"] = diffrax.SaveAt(ts=jnp.linspace(0.0, 1.0, 5))

    def solve(y0):
        sol = diffrax.diffeqsolve(term, solver, 0.0, 1.0, 0.02, y0, max_steps=256, **options)
        return jnp.asarray(sol.ys)

    def loss(y0):
        y = solve(y0)
        return jnp.sum(jnp.abs(y) ** 4 + y.real)

    return jax.grad(loss) if way == "gradient" else solve


def second_derivative(what: str) -> Callable[[Any], Any]:
    def loss(inertia):
        term = cfjax.LieTerm(rigid_body.field)
        y0 = jnp.asarray(rigid_body.y0)
        ys = cfjax.integrate(term, cfjax.CF4(), 0.0, 10.0, y0, inertia, num_steps=100).ys
        return jnp.asarray(ys)[-1] @ jnp.array([1.0, 2.0, 3.0])

    gradient = jax.grad(loss)
    product = lambda inertia: jax.jvp(gradient, (inertia,), (jnp.ones(3),))[1]  # noqa: E731
    return {"gradient": gradient, "product": product, "Hessian": jax.hessian(loss)}[what]


def seconds(make: Callable[[], Callable[[Any], Any]], argument: Any) -> float:
    """Of the processor. A new function each time, or jax would remember the old program."""
    begin = time.process_time()
    jax.jit(make()).lower(jnp.asarray(argument)).compile()
    return time.process_time() - begin


def measure(quick: bool) -> Iterator[results.Row]:
    repeats = 1 if quick else 3
    seconds(lambda: program("rigid body", "Tsit5", "gradient"), rigid_body.y0)  # warm-up
    for problem in [*PROBLEMS][: 1 if quick else None]:
        _, y0 = PROBLEMS[problem]
        for way in WAYS:
            methods = ["Tsit5", *METHODS]
            if way == "controlled steps":
                methods = [method for method in methods if method not in WITHOUT_CONTROL]
            taken = np.array(
                [
                    [seconds(lambda m=m: program(problem, m, way), y0) for m in methods]  # noqa: B023
                    for _ in range(repeats)
                ]
            ).T
            for method, times in zip(methods, taken, strict=True):
                yield {
                    "problem": problem,
                    "way": way,
                    "method": method,
                    "CPU seconds": results.spread(times),
                    "over Tsit5": results.ratios(times, taken[0]),
                }
    for what in ("gradient", "product", "Hessian"):
        times = [
            seconds(lambda what=what: second_derivative(what), rigid_body.inertia)
            for _ in range(repeats)
        ]
        yield {"derivative": what, "CPU seconds": results.spread(times)}


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
