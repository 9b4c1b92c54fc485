"""Noise in equal steps: `cfjax.integrate`, `diffrax.diffeqsolve`, and a `jax.lax.scan` by hand.

A linear equation of Stratonovich with three numbers and two channels, by diffrax's own solvers, and
a unit vector by `CF2`. Each program draws increments in every step, and keeps the end alone. The
gradient is with respect to the start and the parameter, a number. diffrax has none with increments
of `UnsafeBrownianPath`, only with those of a tree.
"""

from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

import cfjax
import results

STEPS = 100_000
SOLVERS: dict[str, Any] = {"EulerHeun": diffrax.EulerHeun(), "Heun": diffrax.Heun()}
Y0 = (0.6, 0.0, 0.8)


def drift(t: Any, y: Array, size: Any) -> Float[Array, "3"]:
    return jnp.stack([y[1], -y[0] - size * y[1], -size * y[2]])


def noise(t: Any, y: Array, size: Any) -> Float[Array, "3 2"]:
    zero = jnp.zeros_like(y[0])
    return 0.1 * size * jnp.stack([jnp.stack([y[2], zero, -y[0]]), y], axis=1)


def in_space(path: diffrax.AbstractPath) -> diffrax.MultiTerm:
    return diffrax.MultiTerm(diffrax.ODETerm(drift), diffrax.ControlTerm(noise, path))


def on_sphere(path: diffrax.AbstractPath) -> diffrax.MultiTerm:
    def turn(t: Any, y: Array, size: Any, dw: Array) -> cfjax.Rotation:
        return cfjax.Rotation(0.1 * size * (dw[0] * y[::-1] + dw[1] * jnp.cos(y)))

    return diffrax.MultiTerm(
        cfjax.LieTerm(lambda t, y, size: cfjax.Rotation(size * jnp.cos(y))),
        cfjax.LieControlTerm(turn, path),
    )


def path(key: Any) -> diffrax.UnsafeBrownianPath:
    return diffrax.UnsafeBrownianPath((2,), key)


def by_integrate(solver: Any, terms: Callable[..., Any]) -> Callable[..., Array]:
    def end(y0: Array, size: Any, key: Any) -> Array:
        sol = cfjax.integrate(terms(path(key)), solver, 0.0, 1.0, y0, size, num_steps=STEPS)
        return jnp.asarray(sol.ys)[-1]

    return end


def by_diffeqsolve(
    solver: Any, terms: Callable[..., Any], *, is_tree: bool = False
) -> Callable[..., Array]:
    def end(y0: Array, size: Any, key: Any) -> Array:
        noise: diffrax.AbstractPath = path(key)
        options: dict[str, Any] = {"adjoint": diffrax.ForwardMode()}
        if is_tree:
            noise, options = diffrax.VirtualBrownianTree(0.0, 1.0, 1 / STEPS, (2,), key), {}
        sol = diffrax.diffeqsolve(
            *(terms(noise), solver, 0.0, 1.0, 1 / STEPS, y0, size), max_steps=STEPS + 1, **options
        )
        return jnp.asarray(sol.ys)[-1]

    return end


def by_hand(y0: Array, size: Any, key: Any) -> Array:
    """Heun's method, as one would write it."""
    h = 1 / STEPS

    def step(y: Array, key: Any) -> tuple[Array, None]:
        dw = jnp.sqrt(h) * jax.random.normal(key, (2,))
        slope = lambda y: h * drift(0.0, y, size) + noise(0.0, y, size) @ dw  # noqa: E731
        k = slope(y)
        return y + (k + slope(y + k)) / 2, None

    # A split for each step at once takes less time than one in each step.
    return lax.scan(step, y0, jax.random.split(key, STEPS))[0]


def measure(quick: bool) -> Iterator[results.Row]:
    args = jnp.asarray(Y0), jnp.asarray(0.5), jax.random.key(0)
    programs: dict[tuple[str, str], Callable[..., Array]] = {("a scan by hand", "Heun"): by_hand}
    for name, solver in SOLVERS.items():
        programs["cfjax.integrate", name] = by_integrate(solver, in_space)
        programs["diffeqsolve", name] = by_diffeqsolve(solver, in_space)
        programs["diffeqsolve, tree", name] = by_diffeqsolve(solver, in_space, is_tree=True)
    programs["cfjax.integrate", "CF2"] = by_integrate(cfjax.CF2(), on_sphere)
    programs["diffeqsolve", "CF2"] = by_diffeqsolve(cfjax.CF2(), on_sphere)
    programs["diffeqsolve, tree", "CF2"] = by_diffeqsolve(cfjax.CF2(), on_sphere, is_tree=True)
    for kind in ("solve", "gradient"):
        runs: dict[Any, Callable[[], Any]] = {}
        for key, end in programs.items():
            program = end
            if kind == "gradient":
                if key[0] == "diffeqsolve":
                    continue
                program = jax.grad(lambda *args, end=end: jnp.sum(end(*args)), argnums=(0, 1))
            runs[key] = results.compiled(program, *args)
        seconds: dict[Any, Any] = results.in_turns(runs, repeats=1 if quick else 7)
        for (way, method), times in seconds.items():
            base = seconds["diffeqsolve, tree", method]
            yield {
                "way": way,
                "method": method,
                "kind": kind,
                "steps": STEPS,
                "seconds": results.spread(times),
                "over diffeqsolve, tree": results.ratios(times, base),
            }


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
