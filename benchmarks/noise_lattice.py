"""Noise on a lattice: the mean energy of a ring of spins at a temperature, in steps of a length.

The energy of a bond is -L(1/kT) in equilibrium, with Langevin's function L. A row has how far the
mean over times and over many copies of the ring is off that, relatively, and its standard error.
"""

import math
from collections.abc import Iterator
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax
import results

SPINS, COPIES = 64, 64
COUPLING, DAMPING = 1.0, 0.5
STEPS = (0.2, 0.1, 0.05)
# Times between which a mean is taken, from a start with all spins aligned.
TIMES = {0.5: (50, 200), 1.0: (12, 50)}
SOLVERS = {"CF2": cfjax.CF2(), "CF4": cfjax.CF4(), "WeakOrder2": cfjax.WeakOrder2()}

Rings = Float[Array, "copies spins 3"]


def measure(quick: bool) -> Iterator[results.Row]:
    for kT, step in ((kT, step) for kT in TIMES for step in STEPS):
        begin, end = TIMES[kT]
        for name, solver in SOLVERS.items():
            rings = solve(solver, kT, step, end, COPIES // 4 if quick else COPIES)
            # The first state is that after one unit of time.
            means = np.asarray(bonds(rings[begin:])).mean(axis=0)
            exact = 1 / math.tanh(1 / kT) - kT
            yield {
                "kT": kT,
                "step": step,
                "method": name,
                "off by": results.digits(means.mean() / exact - 1),
                "standard error": results.digits(means.std(ddof=1) / len(means) ** 0.5 / exact),
            }


def solve(
    solver: Any, kT: float, step: float, end: int, copies: int
) -> Float[Array, "times copies spins 3"]:
    """The rings after each unit of time."""
    levy_area = diffrax.SpaceTimeLevyArea
    shape = (copies, SPINS, 3)
    noise = diffrax.UnsafeBrownianPath(shape, jax.random.key(0), levy_area=levy_area)
    term = diffrax.MultiTerm(
        cfjax.LieTerm(lambda t, m, args: turning(m, neighbours(m))),
        cfjax.LieControlTerm(
            lambda t, m, args, dw: turning(m, math.sqrt(2 * DAMPING * kT) * dw), noise
        ),
    )
    start = jnp.zeros(shape).at[..., 2].set(1.0)
    unit = round(1 / step)
    sol = cfjax.integrate(
        term, solver, 0.0, float(end), start, num_steps=end * unit, save_every=unit
    )
    return jnp.asarray(sol.ys)


def neighbours(m: Rings) -> Rings:
    return COUPLING * (jnp.roll(m, 1, axis=1) + jnp.roll(m, -1, axis=1))


def turning(m: Rings, b: Rings) -> cfjax.Rotation:
    return cfjax.Rotation((b + DAMPING * jnp.cross(m, b)) / (1 + DAMPING**2))


@jax.jit
def bonds(rings: Float[Array, "times copies spins 3"]) -> Float[Array, "times copies"]:
    """The mean product of neighbours, which is less the energy of a bond."""
    return jnp.mean(jnp.sum(rings * jnp.roll(rings, 1, axis=2), axis=-1), axis=-1)


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
