"""Explicit Runge-Kutta methods in plain space whose steps end on the manifold."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, PyTree, Real

from .._field import AbstractCoordinates, has_rate, in_coordinates, is_field, keeping, kept, landing
from .._fields.coordinates import BesideCayley
from .._fields.elementwise import ElementwiseCoordinates, elementwise
from .._term import product
from .coordinates import ProjectedChart, plus_zero, zero_or_nan
from .munthe_kaas import AbstractRungeKutta

_NOT_SKEW = (
    "cfjax.Projected needs skew-Hermitian matrices a in LeftMatrix and RightMatrix, as for "
    "orthogonal and unitary matrices, and a is not skew-Hermitian at the start. Use a "
    "commutator-free method, for example cfjax.CF4()."
)
# Turns of Newton's method: they lead from a thousandth to rounding, and so do their derivatives.
_TURNS = 3
# Units of rounding of the values, by the sizes of what they consist of.
_UNITS = 16

Invariants = Callable[[Any, PyTree, PyTree], PyTree]


class Projected(AbstractRungeKutta, diffrax.AbstractAdaptiveSolver):
    """An explicit Runge-Kutta method in plain space, each step of which ends on the manifold.

    The stages are those of the method along the velocities of the frozen fields, off the manifold
    by their own error. The end of the step, and output within it, is moved to the point of the
    manifold that is nearest. Orders, estimate and cost are those of the method; no exponentials or
    commutators are computed. In a linear space it is the method itself.

    `Rotation`, `QuaternionRotation` and `SphereRotation` keep lengths, or the columns of a matrix
    as one body; motions the unit number or orthogonal matrix of the attitude; `LeftMatrix` and
    `RightMatrix`, whose `a` must be skew-Hermitian, the products of columns or rows; `LowRankSkew`
    and `BorderedSkew` orthonormal columns; `Conjugation` and `Congruence` without `q` the spectrum.
    Arrays stay as they are. Any other class needs a method `projected`. *Methods* in the
    documentation has the table.

    **It is not** exact for a constant field, as `cfjax.CF4` and `cfjax.RKMK8` are at any angle; and
    it is neither symmetric nor symplectic. Its steps end where those in plain space do, at some 3
    radians: a step whose end is off the manifold by more than half of its size fails. The term is
    called slightly off the manifold, and must return elements of the same algebra there.

    **Arguments:**

    - `method`: an explicit Runge-Kutta solver of diffrax, such as `diffrax.Tsit5()`, or a
      `diffrax.ButcherTableau`.
    - `invariants`: None, or a function `invariants(t, y, args)` whose real values, a pytree, stay
      what they were at the start of the solve, such as an energy. After each step the end is moved
      along their derivatives by y, and back to the manifold, three times (Newton's method). Where
      this does not lead to rounding, or the derivatives depend on each other, the step fails.
    - `unroll`: whether the stages are unrolled in the program, as in `cfjax.CommutatorFree`.

    **Raises** `TypeError` if `method` is something else, or a class; `ValueError` if it is
    implicit, or for another `unroll`; `TypeError` for a term driven by a path, and for a field
    without `projected`; a runtime error for an `a` that is not skew-Hermitian at the start, by more
    than 1000 units of rounding of its largest entry. Such an `a` later on makes a step fail. After
    a step that fails `cfjax.integrate` raises an error, and an adaptive step is taken again,
    shorter.

    Source: Hairer, Lubich & Wanner, Geometric Numerical Integration, Section IV.4.
    """

    name: str = eqx.field(static=True)
    invariants: Invariants | None = eqx.field(static=True, default=None)
    # Of the end of a step: its time, `args`, what it has in common with the start, and what
    # invariants are to be.
    target: PyTree = eqx.field(default=None, repr=False)

    takes_noise: ClassVar[bool] = False

    def __init__(
        self,
        method: diffrax.AbstractSolver | diffrax.ButcherTableau,
        *,
        invariants: Invariants | None = None,
        unroll: bool | None = None,
    ):
        super().__init__(_tableau(method), estimate="algebra", unroll=unroll)
        self.name = type(method).__name__
        if invariants is not None and not callable(invariants):
            raise TypeError(f"invariants must be a function or None, got {invariants!r}.")
        self.invariants = invariants
        self.target = None

    @property
    def chart_type(self) -> type[ProjectedChart]:
        return ProjectedChart

    def start(self, terms, t0, t1, y0, args):
        state, fault = super().start(terms, t0, t1, y0, args)
        field = product(terms, terms.vf(t0, y0, args), terms.contr(t0, t1))
        field, start = lax.stop_gradient((field, y0))
        field = in_coordinates("projected", field, start)
        has_step = has_rate(field)
        if has_step is not None:
            fault = fault.with_case(~has_step, _NOT_SKEW)
        values = None
        if self.invariants is not None:
            values = _values(self.invariants, t0, y0, args)
        return replace(state, kept=(kept(field, start), values)), fault

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        solver: Any = self._with(target=(t1, args, *solver_state.kept))
        return AbstractRungeKutta.step(solver, terms, t0, t1, y0, args, solver_state, made_jump)

    def end_of(self, chart, v):
        t1, args, of_start, values = self.target
        end, is_there = super().end_of(chart, keeping(v, of_start))
        if self.invariants is None:
            return end, is_there
        correction, is_kept = _correction(
            lambda y: _values(self.invariants, t1, y, args), values, v, chart.sums.state(end)
        )
        correction = plus_zero(correction, zero_or_nan(is_kept, v))
        is_there = is_kept if is_there is None else is_there & is_kept
        return jtu.tree_map(jnp.add, end, correction), is_there


def _tableau(method: Any) -> diffrax.ButcherTableau:
    if isinstance(method, type):
        raise TypeError(
            f"method must be an instance, {method.__name__}(), got the class {method.__name__}."
        )
    is_solver = isinstance(method, diffrax.AbstractERK | diffrax.AbstractDIRK)
    tableau: Any = method.tableau if is_solver else method
    if not isinstance(tableau, diffrax.ButcherTableau):
        raise TypeError(
            "method must be an explicit Runge-Kutta solver of diffrax, such as diffrax.Dopri8(), "
            f"or a diffrax.ButcherTableau, got {method!r}."
        )
    if tableau.implicit:
        raise ValueError(
            f"method must be explicit, got the implicit one {type(method).__name__}. For stiff "
            "equations use an exponential method, for example cfjax.ETD54()."
        )
    return tableau


def _values(invariants: Any, t: Any, y: PyTree, args: PyTree) -> Real[Array, " m"]:
    values = ravel_pytree(invariants(t, y, args))[0]
    if jnp.iscomplexobj(values) or not jnp.issubdtype(values.dtype, jnp.floating):
        raise TypeError(f"invariants must return floating numbers, got {values.dtype}.")
    return values


def _correction(
    values: Callable[[PyTree], Real[Array, " m"]],
    kept: Real[Array, " m"],
    field: PyTree,
    y: PyTree,
) -> tuple[PyTree, Bool[Array, ""]]:
    """What is added to a point on the manifold so that the values are what is kept; and whether
    they are then.
    """
    start, unravel = ravel_pytree(y)

    def turn(end: Array, _: None) -> tuple[Array, Any]:
        def moved(w: Array) -> Array:
            """Where a velocity in plain space leads on the manifold."""
            increment, _ = landing(_along(field, unravel(w)), unravel(end))
            return end + ravel_pytree(increment)[0]

        point, along = jax.vjp(moved, jnp.zeros_like(end))
        now, pullback = jax.vjp(lambda end: values(unravel(end)), point)
        (in_space,) = jax.vmap(pullback)(jnp.eye(len(kept), dtype=kept.dtype))
        (rows,) = jax.vmap(along)(in_space)
        factors, is_independent = _solved(
            (rows @ rows.conj().T).real, kept - now, jnp.linalg.norm(in_space, axis=1)
        )
        size = jnp.abs(kept) + jnp.abs(rows) @ jnp.abs(end)
        return moved(rows.conj().T @ factors.astype(rows.dtype)), (is_independent, size)

    end, (are_independent, sizes) = lax.scan(turn, start, length=_TURNS)
    off, size = lax.stop_gradient((jnp.abs(values(unravel(end)) - kept), sizes[-1]))
    is_kept = jnp.all(off <= _UNITS * float(jnp.finfo(start.dtype).eps) * size)
    return unravel(end - start), jnp.all(are_independent) & is_kept


def _solved(
    gram: Real[Array, "m m"], x: Real[Array, " m"], lengths: Real[Array, " m"]
) -> tuple[Array, Bool[Array, ""]]:
    """The solution of a system with products of vectors, and whether they are independent.

    It is zero where they are not. A vector is zero if it is rounding beside its length before it
    was projected.
    """
    root = float(jnp.finfo(x.dtype).eps) ** 0.5
    scale = jnp.sqrt(jnp.diagonal(gram))
    is_positive = jnp.all(scale > root * lengths)
    scale = jnp.where(is_positive, scale, 1)
    gram = jnp.where(is_positive, gram / jnp.outer(scale, scale), jnp.eye(len(x), dtype=x.dtype))
    factor = jnp.linalg.cholesky(lax.stop_gradient(gram))
    # The sine of the angle between a vector and those before it. NaN is no number above zero.
    found = is_positive & jnp.all(jnp.diagonal(factor) > root)
    gram = jnp.where(found, gram, jnp.eye(len(x), dtype=x.dtype))
    solution = jnp.linalg.solve(gram, x / scale) / scale
    return jnp.where(found, solution, 0), found


def _along(field: PyTree, w: PyTree) -> PyTree:
    """The same coordinates of a step with the velocity w and nothing else."""

    def part(f: Any, w: PyTree) -> Any:
        if not isinstance(f, AbstractCoordinates):
            return f if is_field(f) else w
        zero = jtu.tree_map(jnp.zeros_like, f)
        one = zero.field if isinstance(zero, ElementwiseCoordinates) else zero
        if not hasattr(one, "v") or isinstance(one, BesideCayley):
            raise TypeError(
                "invariants with Conjugation or Congruence cannot be kept by cfjax.Projected, as "
                "their points move by an element of the algebra."
            )
        velocity = eqx.tree_at(lambda x: x.v, one, w)
        return velocity if one is zero else elementwise(velocity, zero.num_axes)

    return jtu.tree_map(part, field, w, is_leaf=is_field)
