"""Where a division by a parameter may be a product with its reciprocal.

XLA materialises a division, which cuts a program of numbers in two: the gradient of a loop of small
steps takes six times as long. The product differs from the quotient in the last bit. That is
rounding to what is smooth, but not to a comparison, a floor or an index: `49 * (1 / 49)` is less
than 1. So a program has products only if nothing but smooth operations makes anything of them.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.extend.core import Jaxpr, JaxprEqn, Literal
from jaxtyping import Array, PyTree

from .jaxprs import CALLS, OPENED_LAST, are_among
from .over_stages import Loop
from .understood import is_understood

_SCOPE = "cfjax_smooth"
# Functions that are smooth wherever they have values, and those that only move entries or add them.
_SMOOTH = frozenset(
    "acos acosh add add_any asin asinh atan atan2 atanh broadcast_in_dim cbrt complex concatenate "
    "conj copy cos cosh div dot_general erf exp exp2 expm1 imag integer_pow log log1p logistic mul "
    "neg pad pow real reduce_prod reduce_sum reshape rev rsqrt scatter-add scatter-mul sin sinh "
    "slice split sqrt square squeeze stack stop_gradient sub tan tanh transpose unstack".split()
)
# Which of their operands may be what a division gives. The others are indices and predicates.
_SMOOTH_IN_PART = {
    "dynamic_slice": slice(1),
    "dynamic_update_slice": slice(2),
    "gather": slice(1),
    "scatter": slice(0, None, 2),
    "select_n": slice(1, None),
}


def smooth(fun: Callable[..., Any]) -> Callable[..., Any]:
    """`fun`, which is smooth up to rounding, although it compares or rounds numbers.

    As a function does that has a series for small arguments and a closed form for others.
    """

    @functools.wraps(fun)
    def within_scope(*args: Any) -> Any:
        with jax.named_scope(_SCOPE):
            return fun(*args)

    return within_scope


def has_reciprocals(jaxpr: Jaxpr, fixed: Sequence[bool]) -> bool:
    """Whether divisions by what is fixed may be products; `fixed` says it of the operands."""
    try:
        _follow(jaxpr, fixed, [False] * len(fixed), False)
    except _NotSmooth:
        return False
    return True


class _NotSmooth(Exception):
    pass


def by_fixed(eqn: JaxprEqn, fixed: Sequence[bool]) -> bool:
    """Whether this is a real division by what is fixed, of what is not; in no half precision.

    XLA itself makes a product of a division by a literal.
    """
    if eqn.primitive.name != "div" or isinstance(eqn.invars[1], Literal):
        return False
    aval: Any = eqn.outvars[0].aval
    dtype = aval.dtype
    is_real = jnp.issubdtype(dtype, jnp.floating) and dtype.itemsize >= 4
    return list(fixed) == [False, True] and is_real


def scaled_reciprocal(divisor: PyTree) -> tuple[PyTree, PyTree]:
    """s and 1 / (s a), for each number a: x / a is (x s) / (s a).

    Where a is one of the largest numbers, 1 / a is not a normal one, and XLA takes it for zero. s
    is a power of two, small there and otherwise one. x s is zero only where x / a is.
    """

    def scale(a: Array) -> Array:
        half = jnp.finfo(a.dtype).maxexp // 2
        return lax.select(lax.abs(a) < 2.0**half, lax.full_like(a, 1), lax.full_like(a, 2.0**-half))

    scales = jtu.tree_map(scale, divisor)
    return scales, jtu.tree_map(lambda s, a: lax.integer_pow(s * a, -1), scales, divisor)


def _follow(
    jaxpr: Jaxpr, fixed: Sequence[bool], inexact: Sequence[bool], is_smooth: bool
) -> list[tuple[bool, bool]]:
    """Follows what comes of divisions: of each result, whether it is fixed, and whether its last
    bits may differ, by what is said of the operands.
    """
    varying = set(itertools.compress(jaxpr.invars, (not x for x in fixed)))
    rounded = set(itertools.compress(jaxpr.invars, inexact))

    def read(atoms: Sequence[Any]) -> tuple[list[bool], list[bool]]:
        return [not x for x in are_among(atoms, varying)], are_among(atoms, rounded)

    for eqn in jaxpr.eqns:
        fixed, inexact = read(eqn.invars)
        within = is_smooth or _SCOPE in str(getattr(eqn.source_info, "name_stack", ""))
        outs = _inside(eqn, fixed, inexact, within)
        if outs is None:
            if any(inexact) and not within and not _is_smooth(eqn, inexact):
                raise _NotSmooth
            outs = [(all(fixed), any(inexact) or by_fixed(eqn, fixed))] * len(eqn.outvars)
        for v, (is_fixed, is_inexact) in zip(eqn.outvars, outs, strict=True):
            if not is_fixed:
                varying.add(v)
            if is_inexact:
                rounded.add(v)
    return list(zip(*read(jaxpr.outvars), strict=True))


def _inside(
    eqn: JaxprEqn, fixed: list[bool], inexact: list[bool], is_smooth: bool
) -> Sequence[tuple[bool, bool]] | None:
    """The same of the results of an operation with programs within. None for other operations."""
    name = eqn.primitive.name
    if name in OPENED_LAST:
        return _follow(eqn.params[CALLS[name]].jaxpr, fixed, inexact, is_smooth)
    if name == "cond":
        if inexact[0]:
            raise _NotSmooth
        branches = [
            _follow(branch.jaxpr, fixed[1:], inexact[1:], is_smooth)
            for branch in eqn.params["branches"]
        ]
        return [
            (all(is_fixed for is_fixed, _ in outs), any(is_inexact for _, is_inexact in outs))
            for outs in zip(*branches, strict=True)
        ]
    if name != "scan":
        return None
    loop = Loop.of(eqn)
    n, m = loop.num_constants, loop.num_constants + loop.num_carried
    fixed = [is_fixed and not n <= k < m for k, is_fixed in enumerate(fixed)]
    while True:
        outs = _follow(loop.body.jaxpr, fixed, inexact, is_smooth)
        carry = [a or b for a, (_, b) in zip(inexact[n:m], outs[: m - n], strict=True)]
        if carry == inexact[n:m]:
            return [*((False, is_inexact) for is_inexact in carry), *outs[m - n :]]
        inexact = [*inexact[:n], *carry, *inexact[m:]]


def _is_smooth(eqn: JaxprEqn, inexact: Sequence[bool]) -> bool:
    name = eqn.primitive.name
    if name == "cfjax_materialised":
        return True
    if name == "convert_element_type":
        aval: Any = eqn.outvars[0].aval
        return jnp.issubdtype(aval.dtype, jnp.inexact)
    if not is_understood(eqn):
        return False
    if name in _SMOOTH_IN_PART:
        places = range(len(inexact))
        return not any(inexact[k] for k in places if k not in places[_SMOOTH_IN_PART[name]])
    return name in _SMOOTH
