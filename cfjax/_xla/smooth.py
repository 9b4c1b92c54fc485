"""Where a division by a parameter may be a product with its reciprocal.

XLA materialises a division, which cuts a program of numbers in two: the gradient of a loop of small
steps takes six times as long. The product differs from the quotient in the last bit. That is
rounding to what is smooth, but not to a comparison, a floor or an index: `49 * (1 / 49)` is less
than 1. So a program has products only if nothing but smooth operations makes anything of them.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.extend.core import Jaxpr, JaxprEqn, Literal
from jaxtyping import Array, PyTree

from .over_stages import Loop
from .understood import is_understood

_SCOPE = "cfjax_smooth"
# Functions that are smooth wherever they have values, and those that only move entries or add them.
_SMOOTH = frozenset(
    "acos acosh add add_any asin asinh atan atan2 atanh broadcast_in_dim cbrt cfjax_pack "
    "cfjax_unpack complex concatenate conj copy cos cosh cumprod cumsum div dot_general erf exp "
    "exp2 expm1 fft imag integer_pow log log1p logistic mul neg pad pow real reduce_prod "
    "reduce_sum reshape rev rsqrt scatter-add scatter-mul scatter_add scatter_mul sin sinh slice "
    "split sqrt square squeeze stack stop_gradient sub tan tanh transpose".split()
)
# Which of their operands may be what a division gives. The others are indices and predicates.
_SMOOTH_IN_PART = {
    "dynamic_slice": slice(1),
    "dynamic_update_slice": slice(2),
    "gather": slice(1),
    "scatter": slice(0, None, 2),
    "select_n": slice(1, None),
}
_CALLS = {"custom_jvp_call": "call_jaxpr", "jit": "jaxpr", "pjit": "jaxpr"}


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
    """Whether divisions by what is fixed may be products; `fixed` says it of all arguments."""
    is_fixed = dict(zip((*jaxpr.constvars, *jaxpr.invars), fixed, strict=True))
    try:
        _follow(jaxpr, is_fixed, set(), False)
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


def _follow(jaxpr: Jaxpr, is_fixed: dict[Any, bool], inexact: set[Any], is_smooth: bool) -> None:
    """Follows what comes of divisions: the variables whose last bits may differ, `inexact`."""
    for eqn in jaxpr.eqns:
        fixed = [isinstance(v, Literal) or is_fixed[v] for v in eqn.invars]
        reached = [not isinstance(v, Literal) and v in inexact for v in eqn.invars]
        within = is_smooth or _SCOPE in str(getattr(eqn.source_info, "name_stack", ""))
        is_fixed.update((v, all(fixed)) for v in eqn.outvars)
        inside = _inside(eqn, fixed, reached, within)
        if inside is not None:
            for v, (is_one, is_inexact) in zip(eqn.outvars, inside, strict=True):
                is_fixed[v] = is_one
                if is_inexact:
                    inexact.add(v)
        elif any(reached):
            if not within and not _is_smooth(eqn, reached):
                raise _NotSmooth
            inexact.update(eqn.outvars)
        elif by_fixed(eqn, fixed):
            inexact.update(eqn.outvars)


def _inside(
    eqn: JaxprEqn, fixed: list[bool], reached: list[bool], is_smooth: bool
) -> Sequence[tuple[bool, bool]] | None:
    """Of each result of an operation with programs within, whether it is fixed, and whether its
    last bits may differ. None for other operations.
    """
    name = eqn.primitive.name
    if name in _CALLS:
        return _results(eqn.params[_CALLS[name]].jaxpr, fixed, reached, is_smooth)
    if name == "cond":
        if reached[0]:
            raise _NotSmooth
        given = fixed[1:], reached[1:], is_smooth
        some = [_results(branch.jaxpr, *given) for branch in eqn.params["branches"]]
        return [
            (all(is_one for is_one, _ in each), any(is_inexact for _, is_inexact in each))
            for each in zip(*some, strict=True)
        ]
    if name != "scan":
        return None
    loop = Loop.of(eqn)
    n, m = loop.num_constants, loop.num_carried
    fixed = [is_one and not n <= k < n + m for k, is_one in enumerate(fixed)]
    while True:
        results = _results(loop.body.jaxpr, fixed, reached, is_smooth)
        carried = [a or b for a, (_, b) in zip(reached[n : n + m], results[:m], strict=True)]
        if carried == reached[n : n + m]:
            return [*((False, is_inexact) for is_inexact in carried), *results[m:]]
        reached = [*reached[:n], *carried, *reached[n + m :]]


def _results(
    jaxpr: Jaxpr, fixed: Sequence[bool], reached: Sequence[bool], is_smooth: bool
) -> list[tuple[bool, bool]]:
    known = dict(zip(jaxpr.invars, fixed, strict=True))
    known.update((v, True) for v in jaxpr.constvars)
    some = {v for v, is_one in zip(jaxpr.invars, reached, strict=True) if is_one}
    _follow(jaxpr, known, some, is_smooth)
    return [
        (True, False) if isinstance(v, Literal) else (known[v], v in some) for v in jaxpr.outvars
    ]


def _is_smooth(eqn: JaxprEqn, reached: Sequence[bool]) -> bool:
    name = eqn.primitive.name
    if name == "cfjax_materialised":
        return True
    if name == "convert_element_type":
        aval: Any = eqn.outvars[0].aval
        return jnp.issubdtype(aval.dtype, jnp.inexact)
    if not is_understood(eqn):
        return False
    if name in _SMOOTH_IN_PART:
        places = range(len(reached))
        return not any(reached[k] for k in places if k not in places[_SMOOTH_IN_PART[name]])
    return name in _SMOOTH
