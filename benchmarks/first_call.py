"""Time of the first call: from the start of a process to the first result.

Each solve has a fresh process, imports included. It measures processor time, which other work on
the machine disturbs less, and wall time. diffrax's Tsit5 solves the same problem in plain space, in
a process that does not import cfjax. Processes take turns.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import fresh_process

if TYPE_CHECKING:
    import results

PROBLEMS = ("rigid body", "spacecraft", "4 x 4 matrices", "Oja's flow on Stiefel(200, 5)")
WAYS = ("fixed steps", "controlled steps")
METHODS = ("Tsit5", "CF4", "CF54", "RKMK(Dopri8)", "Projected(Dopri8)")


def fields(problem: str, xp: Any) -> tuple[Callable[..., Any], Callable[..., Any], Any]:
    """A function from cfjax to the frozen field, the velocity in plain space, and the start.

    They are written out as a user would, for each problem alone. `xp` is `jax.numpy`.
    """
    import numpy as np

    if problem == "rigid body":
        inertia = xp.array([7 / 8, 5 / 8, 1 / 4])
        return (
            lambda cfjax: lambda t, y, args: cfjax.Rotation(-y / inertia),
            lambda t, y, args: xp.cross(-y / inertia, y),
            xp.array([8 / 9, 4 / 9, 1 / 9]),
        )
    if problem == "spacecraft":
        inertia = xp.array([3.0, 2.0, 1.0])

        def frozen(cfjax):
            def field(t, y, args):
                w = y["m"] / inertia
                q = cfjax.QuaternionRotation(w, frame="body", layout="wxyz")
                return {"q": q, "m": cfjax.Rotation(-w)}

            return field

        def velocity(t, y, args):
            w, q = y["m"] / inertia, y["q"]
            turn = xp.append(-xp.sum(q[1:] * w), q[0] * w + xp.cross(q[1:], w))
            return {"q": turn / 2, "m": xp.cross(y["m"], w)}

        y0 = {"q": xp.array([1.0, 0.0, 0.0, 0.0]), "m": xp.array([0.05, 1.0, 0.0])}
        return frozen, velocity, y0
    if problem == "4 x 4 matrices":
        a = xp.array(np.random.default_rng(0).normal(size=(4, 4)))

        def generator(t, y):
            m = a @ y + xp.sin(t) * a.T
            return m - m.T

        return (
            lambda cfjax: lambda t, y, args: cfjax.LeftMatrix(generator(t, y)),
            lambda t, y, args: generator(t, y) @ y,
            xp.eye(4),
        )
    n, p = 200, 5
    d, c = 1 + xp.arange(n) / n, -3 - xp.arange(p) / p

    def ascent(y):
        return d[:, None] * y * c

    def along_the_manifold(t, y, args):
        g = ascent(y)
        return g @ (y.T @ y) - y @ (g.T @ y)

    return (
        lambda cfjax: lambda t, y, args: cfjax.LowRankSkew(ascent(y)),
        along_the_manifold,
        xp.array(np.linalg.qr(np.cos(np.outer(np.arange(1, n + 1), np.arange(1, p + 1))))[0]),
    )


def solve(problem: str, method: str, way: str) -> None:
    """The whole solve, imports included."""
    import diffrax
    import jax

    jax.config.update("jax_enable_x64", True)
    frozen, velocity, y0 = fields(problem, jax.numpy)
    if method == "Tsit5":
        term, solver = diffrax.ODETerm(velocity), diffrax.Tsit5()
    else:
        import cfjax

        term = cfjax.LieTerm(frozen(cfjax))
        solver = {
            "CF4": cfjax.CF4,
            "CF54": cfjax.CF54,
            "RKMK(Dopri8)": cfjax.RKMK8,
            "Projected(Dopri8)": lambda: cfjax.Projected(diffrax.Dopri8()),
        }[method]()
    options: dict[str, Any] = {}
    if way == "controlled steps":
        options["stepsize_controller"] = diffrax.PIDController(rtol=0.0, atol=1e-6)
    sol = diffrax.diffeqsolve(term, solver, 0.0, 1.0, 0.02, y0, **options)
    jax.block_until_ready(sol.ys)


def measure(quick: bool) -> "Iterator[results.Row]":
    import results

    repeats = 2 if quick else 7
    # Files come from the disk the first time.
    fresh_process.seconds(__file__, PROBLEMS[0], "CF4", WAYS[0])
    for problem in PROBLEMS:
        for way in WAYS:
            turns = [
                [fresh_process.seconds(__file__, problem, m, way) for m in METHODS]
                for _ in range(repeats)
            ]
            processor, clock = ([[pair[k] for pair in turn] for turn in turns] for k in range(2))
            base = [turn[0] for turn in processor]
            for k, method in enumerate(METHODS):
                seconds = [turn[k] for turn in processor]
                yield {
                    "problem": problem,
                    "way": way,
                    "method": method,
                    "CPU seconds": results.spread(seconds),
                    "seconds": results.spread(turn[k] for turn in clock),
                    "over Tsit5": results.ratios(seconds, base),
                }


if __name__ == "__main__":
    fresh_process.run(__file__, __doc__, measure, solve)
