"""Numerical checks of what the methods assume of frozen fields and of terms of a sum."""

from collections.abc import Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from ._arrays import struct
from ._control_term import LieControlTerm, fault_of_increments, is_driven
from ._field import (
    AbstractAlgebraElement,
    AbstractFrozenField,
    combine,
    describe,
    flow,
    from_chart,
    is_field,
    to_chart,
)
from ._numerics.checks import Fault
from ._term import checked_part, product

# For each comparison the requirement, the actual value, the expected one, and the scale to which
# the tolerance is relative.
_Comparisons = list[tuple[str, PyTree, PyTree, Any]]


def check_field(fields: Sequence[AbstractFrozenField], point: PyTree) -> None:
    """Checks numerically that fields of a user-defined class satisfy what the methods assume.

    Use it in a test of the class. It compares, at one point:

    - `flow` and `tangent` return values shaped like the point;
    - `flow` is finite for each field, for sums and differences of two of them, for the negatives,
      and for multiples of all these from 4^-6 to 4, except where it overflows;
    - the flow of the zero field is the identity, the flow of 0.6 of a field followed by that of 0.4
      of it is the flow of the whole field, that of -0.4 of it leads back, and `tangent` is the
      derivative of the flow at time zero. So it is for negatives, sums and differences too;
    - `combine` is linear: the tangent of a sum is the sum of the tangents;
    - `increment`, if defined, is `flow(point) - point`; `to_chart` and `from_chart` lead back to
      the point and to the same flow; and if `defect` says how far a point is off the manifold, the
      flow stays on the manifold, also over a hundred flows one after the other, along the field and
      along 2, 4, 8 and 16 times the field: rounding must not grow from flow to flow;
    - `framed`, if defined, is linear in the field, has the velocity of the field at the point, and
      is an algebra element that moves the point freely, or shaped like the point;
    - `projected`, if defined, has the velocity of the field, also off the manifold, and leads to
      points of the manifold, along velocities of the manifold;
    - for algebra elements, `[a, b]` has the sign and the size that `cfjax.AbstractAlgebraElement`
      says: its tangent is `DX_a X_b - DX_b X_a`, with the tangents of a and b as functions of the
      point. This is compared for `[a, b]`, for `[b, a]` and for the bracket of `[a, b]` with the
      last field, so the bracket is antisymmetric and obeys Jacobi's identity.

    All derivatives are computed by JAX and not by difference quotients, so the compared values
    differ by rounding only. The tolerance is half of the digits, relative to the point and to the
    compared values: a mistake is far larger, and a flow that loses some digits passes.

    **Arguments:**

    - `fields`: at least two frozen fields of one class, with coordinates of about size one and
      without special relations, such as random ones: otherwise mistakes may cancel. If the class
      carries structure, such as a spectrum, all fields must have the same.
    - `point`: a point on the manifold, of about size one: an array, or the part of the state that
      a class with `acts_on_subtree` acts on. float32, float64 or complex.

    **Raises** `TypeError` or `ValueError` for arguments of other types; `ValueError` that names the
    first check that fails, and by how much.
    """
    point = jtu.tree_map(jnp.asarray, point)
    _check_arguments(fields, point)
    name = type(fields[0]).__name__
    for field in fields:
        checked_part("point", field, point)
        eqx.filter_eval_shape(flow, field, point)

    rays = _rays(name, fields, point)
    charted, start = [], point
    for field in fields:
        field, start = field.to_chart(start, charted)
        charted.append(field)
    rtol = float(np.sqrt(max(jnp.finfo(leaf.dtype).eps for leaf in jtu.tree_leaves(point))))

    _compare(name, _of_chart(fields[0], charted[0], start, point), rtol)
    _compare(name, _of_drift(fields[0], point), rtol)
    for k, ray in enumerate(rays):
        if k < len(fields):
            label, field, in_chart = "", fields[k], charted[k]
        elif ray.is_near:
            label = _label(ray.weights)
            field, in_chart = (type(x[0]).combine(ray.weights, x) for x in (fields, charted))
        else:
            continue
        *comparisons, leads_back = _of_flow(field, in_chart, charted[0], start, point)
        comparisons += [leads_back] * (ray.is_near and ray.is_negative_near)
        _compare(name, comparisons, rtol, label)
    _compare(name, _of_combine(fields, charted, start), rtol)
    if type(fields[0]).framed is not AbstractFrozenField.framed:
        _check_framed(name, fields, point)
        _compare(name, _of_framed(fields, point), rtol)
    projected = fields[0].projected(point)
    if projected is not None and projected.has_rate() in (None, True):
        _compare(name, _of_projected(fields[0], point), rtol)
    if all(isinstance(field, AbstractAlgebraElement) for field in charted):
        _compare(name, _of_bracket(charted, start), rtol)


def check_terms(term: diffrax.AbstractTerm, t: Any, y: PyTree, args: PyTree = None) -> None:
    """Checks numerically that the terms of a sum have exact flows, as `cfjax.Splitting` assumes.

    The frozen field of a term must not change along its own flow. Otherwise a splitting has order
    1, and no error says so. A force that depends on positions and moves momenta is such a field,
    and so is the rotation of a body about *one* of its principal axes: `Rotation(-m / inertia)`
    about all three is not.

    For each term the flow in one unit of time is compared with that in two halves, between which
    the field is evaluated again. The tolerance is half of the digits, relative to how far each
    array of the state moves. Terms that a path drives, such as noise, may change along their flow.
    Of a `cfjax.LieControlTerm` it is checked that its field is linear in the increment.

    **Arguments:** `term`, a `diffrax.MultiTerm`, or a `cfjax.LieControlTerm`; `t`, `y` and `args`
    as the fields get them, with a state that is not special, such as a random one.

    **Raises** `TypeError` if `term` is another term; `ValueError` that names the first term whose
    field changes along its flow, and by how much, or is not linear in the increment.
    """
    if isinstance(term, LieControlTerm):
        _check_increments("term", term, t, jtu.tree_map(jnp.asarray, y), args)
        return
    if not isinstance(term, diffrax.MultiTerm):
        raise TypeError(f"term must be a diffrax.MultiTerm, got {term!r}.")
    y = jtu.tree_map(jnp.asarray, y)
    for k, part in enumerate(term.terms):
        if is_driven(part):
            _check_increments(f"terms[{k}]", part, t, y, args)
            continue
        end = _flow_of_term(part, t, y, args, 1.0)
        middle = _flow_of_term(part, t, y, args, 0.5)
        by_halves = _flow_of_term(part, t, middle, args, 0.5)
        for (path, start), *ends in zip(
            jtu.tree_leaves_with_path(y), *map(jtu.tree_leaves, (end, by_halves)), strict=True
        ):
            distance, error = (float(_scale(ends[0] - x)) for x in (start, ends[1]))
            eps = float(jnp.finfo(start.dtype).eps)
            # The second term allows for the rounding of an array that hardly moves.
            if not error <= np.sqrt(eps) * distance + 16 * eps * float(_scale(start)):
                raise ValueError(
                    f"The field of terms[{k}] must not change along its own flow, and its flow in "
                    f"one unit of time is off by {error:.1g}, where it moves y{jtu.keystr(path)} "
                    f"by {distance:.1g}. Split it into terms that do not change what they depend "
                    "on."
                )


def _check_increments(name: str, term: Any, t: Any, y: PyTree, args: PyTree) -> None:
    try:
        eqx.filter_eval_shape(lambda: product(term, term.vf(t, y, args), term.contr(t, t + 1.0)))
        fault = fault_of_increments(Fault.none(), term, t, t + 1.0, y, args)
        message = fault.messages[int(fault.number) - 1] if fault.number > 0 else None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    if message is not None:
        raise ValueError(f"{name}: {message}")


def _flow_of_term(term: Any, t: Any, y: PyTree, args: PyTree, time: float) -> PyTree:
    """The flow from `y` of the field that is frozen there."""
    control = jtu.tree_map(lambda x: time * x, term.contr(t, t + 1.0))
    field, point = to_chart(product(term, term.vf(t, y, args), control), y, ())
    return from_chart(field, flow(field, point))


def _check_arguments(fields: Any, point: PyTree) -> None:
    if not isinstance(fields, Sequence) or len(fields) < 2:
        raise TypeError(
            "fields must be a sequence of at least two frozen fields of one class, got "
            f"{describe(fields)}."
        )
    is_one_class = isinstance(fields[0], AbstractFrozenField) and len(set(map(type, fields))) == 1
    if not is_one_class:
        names = ", ".join(type(field).__name__ for field in fields)
        is_term = any(isinstance(field, diffrax.AbstractTerm) for field in fields)
        advice = " For terms there is cfjax.check_terms." if is_term else ""
        raise TypeError(f"fields must be frozen fields of one class, got {names}.{advice}")
    for path, leaf in jtu.tree_leaves_with_path(point):
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            raise TypeError(
                f"point{jtu.keystr(path)} must be floating or complex, got {leaf.dtype}."
            )
    defect = fields[0].defect(point)
    if defect is not None and not defect[0] < np.sqrt(jnp.finfo(defect[0].dtype).eps):
        raise ValueError(f"point must have {defect[1]}, and is off by {float(defect[0]):.1g}.")


class _Ray(NamedTuple):
    """A linear combination of fields, and whether it and its negative flow to near the point."""

    weights: list[float]
    is_near: bool
    is_negative_near: bool


def _rays(name: str, fields: Sequence[Any], point: PyTree) -> list[_Ray]:
    """The fields, their sums and differences, and the negatives of all these.

    Raises `ValueError` for a flow that is not finite, of one of these or of their multiples, unless
    that of a smaller multiple leads far away, as this one may then overflow.
    """
    own = np.eye(len(fields))
    half = np.concatenate([own, own[:-1] + own[1:], own[:-1] - own[1:]])
    rays = np.concatenate([half, -half])
    scales = 4.0 ** np.arange(-6, 2)
    weights = scales[:, None, None] * rays
    sizes = np.asarray(_sizes_of_ends(fields, point, weights))
    is_near = sizes <= 1e3 * (float(_scale(point)) or 1.0)
    may_overflow = np.logical_or.accumulate(np.isfinite(sizes) & ~is_near)
    # Those of the given fields come first.
    for j in np.argsort(np.abs(np.log(scales)), kind="stable"):
        for k in np.flatnonzero(~np.isfinite(sizes[j]) & ~may_overflow[j]):
            what = "NaN" if np.isnan(sizes[j, k]) else "infinite"
            raise ValueError(
                f"{name}.flow must be finite, but it is {what} for {_label(weights[j, k])}."
            )
    near = is_near[scales == 1][0]
    return list(map(_Ray, rays.tolist(), near.tolist(), np.roll(near, len(half)).tolist()))


@eqx.filter_jit
def _sizes_of_ends(fields: Sequence[Any], point: PyTree, weights: Any) -> Any:
    dtype = jnp.finfo(jtu.tree_leaves(point)[0].dtype).dtype

    def size(weights: Any) -> Any:
        return _scale(type(fields[0]).combine(tuple(weights), fields).flow(point))

    # In a loop, so that the flow is compiled once.
    rows = jnp.asarray(weights.reshape(-1, len(fields)), dtype)
    return lax.map(size, rows).reshape(weights.shape[:-1])


def _label(weights: Sequence[float] | np.ndarray) -> str:
    """The combination of the fields with these weights, such as `fields[0] - 4 fields[1]`."""
    terms = [
        f"{'-' if w < 0 else '+'} {'' if abs(w) == 1 else f'{abs(w):g} '}fields[{k}]"
        for k, w in enumerate(weights)
        if w != 0
    ]
    return " ".join(terms).removeprefix("+ ")


@eqx.filter_jit
def _of_chart(field: Any, in_chart: Any, start: Any, point: PyTree) -> _Comparisons:
    returned, end = in_chart.from_chart(start), field.flow(point)
    end_in_chart = in_chart.from_chart(in_chart.flow(start))
    scale = _scale((point, end))
    comparisons: _Comparisons = [
        ("to_chart and from_chart must lead back to the point", returned, point, scale),
        ("flow must be the same before and after to_chart", end, end_in_chart, scale),
    ]
    defect = field.defect(end)
    if defect is not None:
        comparisons.append((f"flow must keep {defect[1]}", defect[0], jnp.zeros_like(defect[0]), 1))
    return comparisons


@eqx.filter_jit
def _of_drift(field: Any, point: PyTree) -> _Comparisons:
    defect = field.defect(point)
    if defect is None:
        return []

    def max_defect(factor: Any) -> Any:
        """The largest defect along the flows, of points that are not far from the start."""
        scaled = type(field).combine((factor,), (field,))

        def body(carry: Any, _: None) -> Any:
            y, largest = carry
            increment = scaled.increment(y)
            y = scaled.flow(y) if increment is None else jtu.tree_map(jnp.add, y, increment)
            is_near = _scale(y) <= 1e3 * _scale(point)
            return (y, jnp.where(is_near, jnp.maximum(largest, field.defect(y)[0]), largest)), None

        return lax.scan(body, (point, jnp.zeros_like(defect[0])), length=100)[0][1]

    name = "flow" if field.increment(point) is None else "increment"
    factors = jnp.asarray([1.0, 2.0, 4.0, 8.0, 16.0], defect[0].dtype)
    defects = lax.map(max_defect, factors)
    requirement = f"{name} must keep {defect[1]} over 100 flows, also of large fields"
    return [(requirement, defects, jnp.zeros_like(defects), 1)]


@eqx.filter_jit
def _of_flow(field: Any, in_chart: Any, first: Any, start: Any, point: PyTree) -> _Comparisons:
    def flow_to(t: Any, start: Any) -> Any:
        return type(in_chart).combine((t,), (in_chart,)).flow(start)

    y = first.from_chart(start)
    # In the precision of the point, which is that of the field.
    times = jnp.asarray([0.0, 0.6, 1.0], jnp.finfo(jtu.tree_leaves(y)[0].dtype).dtype)
    # In a loop, so that the flow is compiled once.
    ends = lax.map(lambda t: flow_to(t, start), times)
    at_zero, between, end = (jtu.tree_map(itemgetter(k), ends) for k in range(3))
    parts = jnp.asarray([0.4, -0.4], times.dtype)
    later_ends = lax.map(lambda x: flow_to(*x), (parts, jtu.tree_map(lambda x: x[1:], ends)))
    later, back = (first.from_chart(jtu.tree_map(itemgetter(k), later_ends)) for k in range(2))
    end = first.from_chart(end)
    path = lambda t: first.from_chart(flow_to(t, start))  # noqa: E731
    velocity = jax.jvp(path, (0 * times[0],), (times[2],))[1]
    tangent = field.tangent(y)
    increment = field.increment(point)
    comparisons: _Comparisons = [
        (
            "flow of the zero field must be the identity",
            first.from_chart(at_zero),
            y,
            _scale(y),
        ),
        (
            "tangent must be the derivative of the flow at time zero",
            tangent,
            velocity,
            _scale((y, tangent, velocity)),
        ),
        (
            "flow of 0.4 of a field after 0.6 of it must be that of the whole field",
            later,
            end,
            _scale((y, end)),
        ),
    ]
    if type(field).mean is not AbstractFrozenField.mean:
        # To ten digits for a field of size one.
        nodes, weights = np.polynomial.legendre.leggauss(8)
        values = lax.map(
            lambda t: type(field).combine((t,), (field,)).flow(point),
            jnp.asarray((nodes + 1) / 2, times.dtype),
        )
        expected = jtu.tree_map(
            lambda y: jnp.tensordot(jnp.asarray(weights / 2, y.dtype), y, axes=1), values
        )
        requirement = "mean must be the mean of the flow"
        comparisons.append((requirement, field.mean(point), expected, _scale((point, expected))))
    if increment is not None:
        expected = jtu.tree_map(jnp.subtract, field.flow(point), point)
        requirement = "increment must be flow(point) - point"
        comparisons.append((requirement, increment, expected, _scale((point, expected))))
    requirement = "flow of -0.4 of a field must lead back along that of the field"
    between = first.from_chart(between)
    comparisons.append((requirement, back, between, _scale((y, between, end))))
    return comparisons


@eqx.filter_jit
def _of_combine(fields: Sequence[Any], charted: Sequence[Any], start: Any) -> _Comparisons:
    y = charted[0].from_chart(start)
    weights = [0.7 * (-0.6) ** k for k in range(len(fields))]
    tangents = [field.tangent(y) for field in fields]
    # The sum of arrays, without the method of the class.
    expected = combine(weights, tangents)
    scale = _scale((y, tangents))
    return [
        (
            f"combine must be linear {what}: the tangent of a sum must be the sum of the tangents",
            type(terms[0]).combine(weights, terms).tangent(y),
            expected,
            scale,
        )
        for what, terms in [("in the fields", fields), ("in what has entered", charted)]
    ]


def _check_framed(name: str, fields: Sequence[Any], point: PyTree) -> None:
    """Raises `ValueError` unless `framed` returns what can hold the coordinates of a variation."""
    framed = eqx.filter_eval_shape(fields[0].framed, point)
    if is_field(framed) and not isinstance(framed, AbstractAlgebraElement):
        raise ValueError(
            f"{name}.framed must return an algebra element or the velocity, got "
            f"{type(framed).__name__}, which has no bracket."
        )
    if not is_field(framed) and struct(framed) != struct(point):
        raise ValueError(
            f"{name}.framed must return an algebra element, or what is shaped like the point, "
            f"{describe(point)}, got {describe(framed)}."
        )
    if not is_field(framed):
        return
    zero = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), framed)
    vector, unravel = ravel_pytree(zero)
    velocity = lambda vector: ravel_pytree(unravel(vector).tangent(point))[0]  # noqa: E731
    matrix = np.asarray(jax.jit(jax.vmap(velocity))(jnp.eye(len(vector), dtype=vector.dtype)))
    values = np.linalg.svd(matrix, compute_uv=False)
    rtol = np.sqrt(np.finfo(matrix.dtype).eps)
    if len(values) < len(matrix) or values[-1] <= rtol * values[0]:
        raise ValueError(
            f"{name}.framed must return elements that move the point freely, but one of "
            f"{type(framed).__name__} that is not zero has velocity zero there. Return the "
            "velocity, which is the default."
        )


@eqx.filter_jit
def _of_framed(fields: Sequence[Any], point: PyTree) -> _Comparisons:
    weights = [0.7 * (-0.6) ** k for k in range(len(fields))]
    framed = [field.framed(point) for field in fields]
    expected = combine(weights, framed)
    comparisons: _Comparisons = [
        (
            "framed must be linear in the field",
            type(fields[0]).combine(weights, fields).framed(point),
            expected,
            _scale(framed),
        )
    ]
    for field, element in zip(fields, framed, strict=True):
        found = element.tangent(point) if is_field(element) else element
        velocity = field.tangent(point)
        requirement = "framed must have the velocity of the field at the point"
        comparisons.append((requirement, found, velocity, _scale((point, velocity))))
    return comparisons


@eqx.filter_jit
def _of_projected(field: Any, point: PyTree) -> _Comparisons:
    near = jtu.tree_map(lambda x: 1.001 * x, point)
    projected = field.projected(point)

    def moved(s: Any, point: PyTree) -> Any:
        increment, _ = type(projected).combine((s,), (projected,)).landing(point)
        return jtu.tree_map(jnp.add, point, increment)

    dtype = jnp.finfo(jtu.tree_leaves(point)[0].dtype).dtype
    zero, tenth = jnp.zeros((), dtype), jnp.asarray(0.1, dtype)
    end, velocity = moved(tenth, point), field.tangent(point)
    _, found = jax.jvp(lambda s: moved(s, point), (zero,), (jnp.ones_like(zero),))
    of_near, scale = field.tangent(near), _scale((point, velocity))
    comparisons: _Comparisons = [
        (
            "projected must have the velocity of the field, also off the manifold",
            field.projected(near).tangent(near),
            of_near,
            _scale((point, of_near)),
        ),
        ("projected must leave a velocity along the manifold as it is", found, velocity, scale),
        ("projected must leave a point of the manifold where it is", moved(zero, end), end, scale),
    ]
    defect = field.defect(end)
    if defect is not None:
        requirement = f"projected must lead to points that have {defect[1]}"
        comparisons.append((requirement, defect[0], jnp.zeros_like(defect[0]), 1))
    return comparisons


@eqx.filter_jit
def _of_bracket(charted: Sequence[Any], start: Any) -> _Comparisons:
    point = charted[0].from_chart(start)
    a, b, c = charted[0], charted[1], charted[-1]
    ab = a.bracket(b)
    comparisons: _Comparisons = []
    for what, x, y, bracket in [
        ("[a, b]", a, b, ab),
        ("[b, a]", b, a, b.bracket(a)),
        ("[[a, b], c]", ab, c, ab.bracket(c)),
    ]:
        # The derivative of each tangent along the other field.
        derivatives = [
            jax.jvp(p.tangent, (point,), (q.tangent(point),))[1] for p, q in [(x, y), (y, x)]
        ]
        expected, tangent = jtu.tree_map(jnp.subtract, *derivatives), bracket.tangent(point)
        requirement = (
            f"bracket must have the sign and size of AbstractAlgebraElement (ab - ba for matrices "
            f"that act from the left), here {what}"
        )
        comparisons.append((requirement, tangent, expected, _scale((point, tangent, derivatives))))
    return comparisons


def _scale(x: PyTree) -> Any:
    return sum(jnp.max(jnp.abs(leaf), initial=0) for leaf in jtu.tree_leaves(x))


def _compare(name: str, comparisons: _Comparisons, rtol: float, label: str = "") -> None:
    for requirement, actual, expected, scale in comparisons:
        a, b = (
            np.concatenate([np.ravel(leaf) for leaf in jtu.tree_leaves(x)])
            for x in (actual, expected)
        )
        tol = rtol * float(scale)
        # False for NaN.
        if np.all(np.abs(a - b) <= tol):
            continue
        place = f", here of {label}" if label else ""
        raise ValueError(f"{name}.{requirement}{place}, but {_difference(a, b, tol)}")


def _difference(actual: np.ndarray, expected: np.ndarray, tol: float) -> str:
    if not np.all(np.isfinite(expected)):
        return (
            "what is expected is not finite. A flow must be smooth at the zero field, as it is "
            "with cfjax.stumpff."
        )
    if not np.all(np.isfinite(actual)):
        return "it is not finite."
    square = np.vdot(expected, expected).real
    factor = np.vdot(expected, actual).real / square if square > 0 else 0.0
    if abs(factor) > 0.01 and np.abs(actual - factor * expected).max() <= max(1, abs(factor)) * tol:
        if abs(factor + 1) < 0.01:
            return "it has the opposite sign."
        return f"it is {factor:.3g} times what is expected."
    return (
        f"it is off by {np.abs(actual - expected).max():.1g}, with entries of up to "
        f"{np.abs(expected).max():.1g} expected and {tol:.0g} allowed for rounding."
    )
