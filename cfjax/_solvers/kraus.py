"""Completely positive steps of Lindblad's equation, for rates and jumps that depend on time."""

import functools
from collections.abc import Sequence
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Complex, PyTree, Real

from .._field import Rest, is_field
from .._fields.elementwise import each
from .._fields.lindblad import Lindblad
from .._numerics.checks import Fault
from .._numerics.diagonals import dense
from .._numerics.expm import expm
from .._numerics.matmul import small_product
from .._numerics.operators import added, scaled
from .._term import product
from .base import State, check_choice
from .dense import AbstractPath
from .magnus import AbstractOfTime
from .step import Step

# The nodes of Simpson's rule for the halves of a step. Every other one is a node of RK4.
_NODES = (0.0, 0.25, 0.5, 0.75, 1.0)


class Kraus4(AbstractOfTime, diffrax.AbstractAdaptiveSolver):
    """Order 4, for `cfjax.Lindblad` that does not depend on rho: 5 evaluations.

    **A step is completely positive and keeps the trace**, to rounding, however long it is, for all
    rates that are not negative. Rates and jumps may depend on t. A large h and stiff dissipation
    need no short steps, though with stiff dissipation the observed order is below 4. It is the
    classical Runge-Kutta method in the frame of the
    motion without jumps, which is computed by exponentials; a congruence then corrects the trace.

    The estimate of the error, with an embedded method of order 3, costs some 40% more.
    `estimate=None` switches it off. (`cfjax.integrate` does so.)

    Output within a step, of order 4, is a step of that length from the same start, so it is
    completely positive too. It takes the field between the nodes from a polynomial, so jumps
    should be smooth functions of time.

    A step backwards in time has order 4 and keeps the trace, but is not positive, as the equation
    itself is not then. If it is long, it ends in NaN.

    **Cost:** for m jumps, some `37 + 21 m` products of n x n matrices, two exponentials among them,
    each more than 7 where h times the step is large. The estimate adds `22 + 2 m`.

    **Raises** `TypeError` when the program is traced if the field of a part of the state is not a
    `cfjax.Lindblad`, depends on the state, or is driven by a path; `ValueError` for another
    `estimate`.

    Source: derived for this package. For methods of Kraus form of lower order see Cao & Lu,
    Structure-preserving numerical schemes for Lindblad equations, arXiv:2103.01194.
    """

    estimate: Literal["group"] | None = eqx.field(static=True, default="group", kw_only=True)

    def __check_init__(self):
        check_choice("estimate", self.estimate, "group", None)

    def order(self, terms) -> int:
        return 4

    def error_order(self, terms) -> int:
        return 4

    def start(self, terms, t0, t1, y0, args) -> tuple[State, Fault]:
        self.for_terms(terms)
        control = terms.contr(t0, t1)
        field = eqx.filter_eval_shape(lambda y: product(terms, terms.vf(t0, y, args), control), y0)
        for path, part in jtu.tree_leaves_with_path(field, is_leaf=is_field):
            if not isinstance(part, Lindblad):
                raise TypeError(_is_no_lindblad(jtu.keystr(path), part))
        return super().start(terms, t0, t1, y0, args)

    def step_in(self, chart):
        later = [chart.field(c, chart.start, ()) for c in _NODES[1:]]
        fields = [chart.first_field, *later]
        y0 = chart.sums.y0
        increment, error = _increments(fields, y0, self.estimate is not None)
        y1 = chart.sums.map(lambda c, y, z: y + z if c is None else z, increment)
        return Step(y1, _Path(y0, fields), error)


class _Path(AbstractPath):
    """Output within a step: the end of a step of that length."""

    start: PyTree
    fields: Sequence[PyTree]

    def point(self, theta: Any) -> PyTree:
        theta = jnp.asarray(theta)
        weights = [_lagrange(theta * c) for c in _NODES]
        fields = [
            jtu.tree_map(
                functools.partial(_interpolated, w, theta),
                *self.fields,
                is_leaf=is_field,
            )
            for w in weights
        ]
        increment, _ = _increments(fields, self.start, False)
        return jtu.tree_map(jnp.add, self.start, increment)


def _is_no_lindblad(place: str, part: Any) -> str:
    name = type(part).__name__ if is_field(part) else "a translation"
    if isinstance(part, Rest):
        name = "None"
    return (
        "Kraus4 takes only density matrices: the field of each part of the state must be "
        f"cfjax.Lindblad, and for y{place} it is {name}. Use a commutator-free method, for example "
        "cfjax.CF4()."
    )


def _lagrange(c: Real[Array, ""]) -> list[Any]:
    """The weights of the values at the nodes in the polynomial through them, at c."""
    weights = []
    for k, node in enumerate(_NODES):
        others = [x for j, x in enumerate(_NODES) if j != k]
        factors = [(c - x) / (node - x) for x in others]
        weights.append(functools.reduce(jnp.multiply, factors))
    return weights


def _interpolated(weights: Sequence[Any], theta: Any, *fields: Lindblad) -> Lindblad:
    """The field of a step of length theta, by the polynomial through the nodes."""
    dtype = fields[0].rates.dtype

    def mix(*values: Array) -> Array:
        if all(x is values[0] for x in values):
            return values[0]
        return added(scaled(w.astype(dtype), x) for w, x in zip(weights, values, strict=True))

    def jump(*values: Any) -> Any:
        if len({jtu.tree_structure(x) for x in values}) > 1:
            values = tuple(map(dense, values))
        return jtu.tree_map(mix, *values)

    rates = mix(*(f.rates for f in fields))
    # Where they touch zero the polynomial may have the other sign, by an error of order 5.
    rates = jnp.where(rates * added(f.rates for f in fields) < 0, 0, rates)
    length = theta.astype(dtype)
    parts = (
        scaled(length, mix(*(f.h for f in fields))),
        length * rates,
        tuple(jump(*x) for x in zip(*(f.jumps for f in fields), strict=True)),
    )
    return eqx.tree_at(lambda f: (f.h, f.rates, f.jumps), fields[0], parts)


def _increments(fields: Sequence[PyTree], y0: PyTree, estimate: bool) -> tuple[PyTree, PyTree]:
    """What a step adds to each part of the state, and the estimate of its error, or None."""

    def part(x: Array, *fields: Lindblad) -> tuple[Array, Array | None]:
        num_axes = fields[0].h.ndim - 2
        step = functools.partial(_increment, estimate=estimate)
        return each(step, num_axes)([_with_axes(f, num_axes) for f in fields], x)

    treedef = jtu.tree_structure(fields[0], is_leaf=is_field)
    columns = [treedef.flatten_up_to(f) for f in fields]
    pairs = [
        part(x, *column) for x, *column in zip(treedef.flatten_up_to(y0), *columns, strict=True)
    ]
    increments, errors = (treedef.unflatten(x) for x in zip(*pairs, strict=True))
    return increments, errors if estimate else None


def _with_axes(field: Lindblad, num_axes: int) -> Lindblad:
    """The field with leading axes of 1 for jumps that have none."""
    jumps = jtu.tree_map(lambda a: a.reshape(*[1] * (num_axes + 2 - a.ndim), *a.shape), field.jumps)
    return eqx.tree_at(lambda f: f.jumps, field, jumps)


def _increment(
    fields: Sequence[Lindblad], x: Complex[Array, "n n"], estimate: bool
) -> tuple[Complex[Array, "n n"], Complex[Array, "n n"] | None]:
    """What a step adds to a density matrix, and the estimate of its error."""
    f0, f1, f2, _, f4 = fields
    k0, k1, k2, k3, k4 = (f.no_jump() for f in fields)
    eye = jnp.eye(x.shape[0], dtype=x.dtype)
    # The motion without jumps in the halves, and in about a quarter.
    quarter = expm(_exponent(1 / 2, k0, k1, k2) / 2)
    a, b = small_product(quarter, quarter), expm(_exponent(1 / 2, k2, k3, k4))

    def stages(x: Array) -> tuple[Array, ...]:
        e, a1 = _congruence(a, x), _congruence(a, f0.jump(x))
        j2 = f2.jump(e + a1 / 2)
        j3 = f2.jump(e + j2 / 2)
        j4 = f4.jump(_congruence(b, e + j3))
        return _congruence(b, e + a1 / 6 + (j2 + j3) / 3) + j4 / 6, a1, j2, j3, j4

    # The map is made to keep the trace by a congruence with a Cholesky factor of what its adjoint
    # makes of the identity, which is 1 but for an error of order 5. Where damping is strong, this
    # underflows, and rounding may make it negative.
    (s,) = jax.linear_transpose(lambda x: stages(x)[0], x)(eye)
    s = _hermitian_part(s.T)
    shift = lax.stop_gradient(4 * len(x) * jnp.finfo(x.dtype).eps * jnp.max(jnp.sum(jnp.abs(s), 1)))
    factor = jnp.linalg.cholesky(s + scaled(shift, eye))
    solve = functools.partial(lax.linalg.triangular_solve, factor, lower=True)
    y = solve(solve(x, left_side=True, transpose_a=True, conjugate_a=True), left_side=False)
    end, a1, j2, j3, j4 = stages(y)
    increment = _hermitian_part(end + scaled(shift, y)) - x
    # It has no trace but for rounding.
    increment = increment - scaled(jnp.trace(increment).real / len(x), eye)
    if not estimate:
        return increment, None
    # The error of the jumps: with a stage at a quarter the weights 0, 4/9, 1/9, 2/9, 2/9 are of
    # order 3. The motion to there must have an error of order 3, so it takes a correction.
    correction = (k0 - k2) / 16
    j1 = f1.jump(_moved(correction, _congruence(quarter, y + f0.jump(y) / 4)))
    j1 = _congruence(quarter, _moved(-correction, j1))
    error = _congruence(b, a1 / 6 - 4 / 9 * j1 + 2 / 9 * j2 + 1 / 9 * j3) - j4 / 18
    # The error of the motion without jumps: one exponential for all of the step. It starts from y,
    # and the other from x: so this sees the congruence too, the error of stiff steps.
    coarse = expm(_exponent(1.0, k0, k2, k4))
    return increment, error + _congruence(small_product(b, a), x) - _congruence(coarse, y)


def _exponent(c: float, k0: Array, k1: Array, k2: Array) -> Array:
    """Magnus' exponent of order 4 for a part c of the step, from k at its start, middle and end."""
    commutator = small_product(k0, k2) - small_product(k2, k0)
    return c / 6 * (k0 + 4 * k1 + k2) - c**2 / 12 * commutator


def _congruence(a: Array, x: Array) -> Array:
    return small_product(small_product(a, x), a.conj().T)


def _moved(k: Array, x: Array) -> Array:
    """x moved without jumps by a small exponent k, but for its square."""
    y = small_product(k, x)
    return x + y + y.conj().T


def _hermitian_part(x: Array) -> Array:
    return (x + x.conj().T) / 2
