"""The solvers in a table, from which tests select: orders, evaluations, and what they take.

test_solver_table.py checks that none is left out, the evaluations, and that the solvers say the
same orders of themselves. That the orders are right follows elsewhere from the order conditions, in
methods/, and from observed errors.
"""

from collections.abc import Callable
from fractions import Fraction
from typing import Any, Literal, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import cfjax

# For interpreters of steps.
from cfjax._methods.continuous_extension import continuous_extension as continuous_extension
from cfjax._methods.continuous_extension import runge_kutta_extension as runge_kutta_extension

Kind = Literal[
    "commutator-free",
    "low-storage",
    "Munthe-Kaas",
    "projected",
    "Magnus",
    "Kraus",
    "exponential",
    "stabilised",
    "splitting",
    "implicit",
    "composition",
    "step doubling",
    "noise",
]
Takes = Literal[
    "any",
    "brackets",
    "time only",
    "density matrices",
    "linear part",
    "columns",
    "terms",
    "noise",
]


class Row(NamedTuple):
    """A solver.

    - `make`: makes it, with its estimate if it has one. Its class where that takes no arguments.
    - `order`: of an ordinary equation. `embedded`: that of its embedded method, or None.
    - `evaluations`: of the field in a step, with the estimate and without output within the step.
      Of the first term of a splitting, and of the drift beside noise. None where an iteration
      decides. `first`: how many more the first step has, or the checks before it.
    - `output`: the uniform order of output within a step, where the solver promises one.
    - `takes`: any field; fields with brackets; fields of time only; `Lindblad` of time only; those
      with a linear part; those that move orthonormal columns; a sum of terms; or terms with noise.
    """

    make: Callable[[], Any]
    kind: Kind
    order: int
    # These are integers, or None.
    embedded: Any
    evaluations: Any
    first: int
    output: Any
    takes: Takes = "any"
    is_symmetric: bool = False

    @property
    def is_named(self) -> bool:
        """Whether the class is one method, and takes no tableau or other solver."""
        return isinstance(self.make, type)


SOLVERS = {
    "LieEuler": Row(cfjax.LieEuler, "commutator-free", 1, None, 1, 0, 1),
    "CF2": Row(cfjax.CF2, "commutator-free", 2, 1, 2, 0, 2),
    "CF3": Row(cfjax.CF3, "commutator-free", 3, 2, 3, 0, 2),
    "CF4": Row(cfjax.CF4, "commutator-free", 4, 3, 4, 1, 3),
    "CF43": Row(cfjax.CF43, "commutator-free", 4, 3, 6, 0, 3),
    "CF54": Row(cfjax.CF54, "commutator-free", 5, 4, 7, 1, 4),
    "CG3": Row(cfjax.CG3, "commutator-free", 3, 2, 3, 0, 2),
    "CG4": Row(cfjax.CG4, "commutator-free", 4, None, 5, 0, 3),
    "CG5": Row(cfjax.CG5, "commutator-free", 5, None, 9, 0, 4),
    "CommutatorFree": Row(
        lambda: cfjax.CommutatorFree(cfjax.CF3.tableau), "commutator-free", 3, 2, 3, 0, 2
    ),
    "Williamson3": Row(cfjax.Williamson3, "low-storage", 3, None, 3, 0, 2),
    "BWRRK33": Row(cfjax.BWRRK33, "low-storage", 3, None, 3, 0, 2),
    "BWRRK53": Row(cfjax.BWRRK53, "low-storage", 3, 2, 5, 0, 3),
    "CK34": Row(cfjax.CK34, "low-storage", 3, 2, 4, 0, 3),
    "CK54": Row(cfjax.CK54, "low-storage", 4, None, 5, 0, 3),
    "Luscher3": Row(cfjax.Luscher3, "low-storage", 3, 2, 3, 0, 2),
    "CFEES25": Row(cfjax.CFEES25, "low-storage", 2, 1, 3, 0, 2),
    "CFEES27": Row(cfjax.CFEES27, "low-storage", 2, None, 4, 0, 2),
    "YRK135": Row(cfjax.YRK135, "low-storage", 5, None, 13, 0, 4),
    "RKMK3": Row(cfjax.RKMK3, "Munthe-Kaas", 3, 2, 3, 0, 2, "brackets"),
    "RKMK4": Row(cfjax.RKMK4, "Munthe-Kaas", 4, None, 4, 0, 3, "brackets"),
    "RKMK5": Row(cfjax.RKMK5, "Munthe-Kaas", 5, 4, 6, 1, 4, "brackets"),
    "RKMK8": Row(cfjax.RKMK8, "Munthe-Kaas", 8, 7, 13, 0, 7, "brackets"),
    "CayleyRK4": Row(cfjax.CayleyRK4, "Munthe-Kaas", 4, None, 4, 0, 3, "columns"),
    "RKMK": Row(
        lambda: cfjax.RKMK(diffrax.Bosh3.tableau), "Munthe-Kaas", 3, 2, 3, 1, 2, "brackets"
    ),
    "Projected": Row(
        lambda: cfjax.Projected(diffrax.Bosh3()), "projected", 3, 2, 3, 1, 2, "columns"
    ),
    "Magnus2": Row(cfjax.Magnus2, "Magnus", 2, None, 1, 0, 1, "time only", True),
    "Magnus4": Row(cfjax.Magnus4, "Magnus", 4, 2, 3, 0, 3, "time only", True),
    "Magnus4Lobatto": Row(cfjax.Magnus4Lobatto, "Magnus", 4, 2, 2, 1, 3, "time only", True),
    "Magnus6": Row(cfjax.Magnus6, "Magnus", 6, 4, 4, 1, 5, "time only", True),
    "Magnus8": Row(cfjax.Magnus8, "Magnus", 8, 6, 6, 1, 7, "time only", True),
    "Magnus10": Row(cfjax.Magnus10, "Magnus", 10, 6, 8, 1, 9, "time only", True),
    "Kraus4": Row(cfjax.Kraus4, "Kraus", 4, 3, 5, 1, 4, "density matrices"),
    "ETDRK4": Row(cfjax.ETDRK4, "exponential", 4, None, 4, 0, 3, "linear part"),
    "ETD43": Row(cfjax.ETD43, "exponential", 4, 3, 5, 1, 3, "linear part"),
    "ETD54": Row(cfjax.ETD54, "exponential", 5, 4, 8, 0, 4, "linear part"),
    "ExponentialRungeKutta": Row(
        lambda: cfjax.ExponentialRungeKutta(cfjax.ETD43.tableau),
        *("exponential", 4, 3, 5, 1, 3, "linear part"),
    ),
    # With 5 stages; the halves of RKL3 have 5 and 5 of their own.
    "RKL2": Row(lambda: cfjax.RKL2(5), "stabilised", 2, 2, 5, 1, 2),
    "RKG2": Row(lambda: cfjax.RKG2(5), "stabilised", 2, 2, 5, 1, 2),
    "RKL3": Row(lambda: cfjax.RKL3(5), "stabilised", 3, 2, 14, 1, 2),
    "Strang": Row(cfjax.Strang, "splitting", 2, None, 1, 1, None, "terms", True),
    "BlanesMoan4": Row(cfjax.BlanesMoan4, "splitting", 4, None, 6, 1, None, "terms", True),
    "BlanesMoan6": Row(cfjax.BlanesMoan6, "splitting", 6, None, 10, 1, None, "terms", True),
    "Splitting": Row(
        lambda: cfjax.Splitting((0.5, 0.5)), "splitting", 2, None, 1, 1, None, "terms", True
    ),
    "ImplicitMidpoint": Row(
        cfjax.ImplicitMidpoint, "implicit", 2, None, None, 0, 2, is_symmetric=True
    ),
    "Composition": Row(
        lambda: cfjax.Composition(cfjax.Strang(), 4),
        *("composition", 4, None, 5, 1, None, "terms", True),
    ),
    # Its estimate falls like that of an embedded method of one order below.
    "Richardson": Row(lambda: cfjax.Richardson(cfjax.CF2()), "step doubling", 2, 1, 6, 0, 2),
    # Without noise the order is that of the inner solver, `CF4`.
    "WeakOrder2": Row(cfjax.WeakOrder2, "noise", 4, None, 8, 0, None, "noise"),
    "ShiftedNoise": Row(cfjax.ShiftedNoise, "noise", 4, None, 4, 0, None, "noise"),
}

# Members of the families, by their tableaus.
COMMUTATOR_FREE = {
    name: Row(lambda t=tableau: cfjax.CommutatorFree(t), "commutator-free", 3, None, 3, 0, 2)
    for name, tableau in {
        "family A, 1/2": cfjax.third_order_a(Fraction(1, 2)),
        "family A, 1": cfjax.third_order_a(1),
        "family B, 2/3": cfjax.third_order_b(Fraction(2, 3)),
        "family B, 0.1": cfjax.third_order_b(0.1),
    }.items()
}
MUNTHE_KAAS = {
    name: Row(
        lambda n=name: cfjax.RKMK(getattr(diffrax, n).tableau),
        *("Munthe-Kaas", order, order - 1, evaluations, first, output, "brackets"),
    )
    for name, order, evaluations, first, output in [
        ("Heun", 2, 2, 0, 2),
        ("Bosh3", 3, 3, 1, 2),
        ("Dopri5", 5, 6, 1, 4),
        ("Tsit5", 5, 6, 1, 4),
        ("Dopri8", 8, 13, 0, 7),
    ]
}


def solvers(*kinds: Kind) -> dict[str, Row]:
    """The rows of some kinds."""
    return {name: row for name, row in SOLVERS.items() if row.kind in kinds}


def named(*kinds: Kind) -> dict[str, Row]:
    """The rows of some kinds whose class is one method."""
    return {name: row for name, row in solvers(*kinds).items() if row.is_named}


# A problem for each solver.

ON_SPHERE = np.array([0.6, 0.0, 0.8])
FRAME = np.linalg.qr(np.array([[1.0, 0.2], [0.5, 1.0], [0.3, -0.4]]))[0]


def unit(t, y, args):
    """The rotation of a vector, or of a frame that is moved by its own span."""
    if y.ndim == 2:
        return cfjax.LowRankSkew(args[:, None] * jnp.sin(y))
    return cfjax.Rotation(args * y + t)


def of_time(t, y, args):
    """What does not depend on the state."""
    return cfjax.Rotation(args * jnp.asarray(ON_SPHERE) + t)


def decay(t, y, args):
    """The decay of density matrices, which does not depend on the state."""
    return cfjax.Lindblad(jnp.diag(args * t), [args[:, None] * np.eye(3, k=1)])


def linear(t, y, args):
    """The rotation of a vector, as a linear part and no rest."""
    return cfjax.LinearAffine(jnp.cross(args * y + t, jnp.eye(3), axisb=1, axisc=1).T, 0 * y)


def about(axis):
    """A part of `unit` that is constant along its own flow, about one axis."""

    def field(t, y, args):
        # The time passes while the last term acts, which does not depend on it.
        passed = 0.0 if axis == 2 else t
        return cfjax.Rotation(jnp.eye(3)[axis] * (args * y + passed))

    return field


def noise(t, y, args, increment):
    """So weak that it moves the end by some 1e-3."""
    return cfjax.Rotation(1e-3 * args * increment)


def problem_for(takes: Takes) -> tuple[Any, np.ndarray]:
    """The rotation `unit` with its start, or what a solver takes in its place. `args` has 3 rates.

    Noise has its times from 0 to 1.
    """
    if takes == "columns":
        return cfjax.LieTerm(unit), FRAME
    if takes == "density matrices":
        return cfjax.LieTerm(decay), np.full((3, 3), 1 / 3 + 0j)
    if takes == "noise":
        path = diffrax.VirtualBrownianTree(
            0.0, 1.0, 0.05, (3,), jax.random.key(0), levy_area=diffrax.SpaceTimeLevyArea
        )
        term = diffrax.MultiTerm(cfjax.LieTerm(unit), cfjax.LieControlTerm(noise, path))
    elif takes == "terms":
        term = diffrax.MultiTerm(*(cfjax.LieTerm(about(axis)) for axis in range(3)))
    else:
        term = cfjax.LieTerm({"linear part": linear, "time only": of_time}.get(takes, unit))
    return term, ON_SPHERE
