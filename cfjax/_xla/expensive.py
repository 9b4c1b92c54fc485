"""What XLA never computes twice: functions such as a sine, whose values go through memory."""

from collections.abc import Sequence

from jax.extend.core import Jaxpr, JaxprEqn, jaxprs_in_params

from .jaxprs import are_among
from .over_stages import Loop

# But for divisions: most are by what is fixed, and become products.
_EXPENSIVE = frozenset(
    "acos acosh asin asinh atan atan2 atanh cbrt cos cosh erf exp exp2 expm1 "
    "log log1p logistic pow rsqrt sin sinh sqrt tan tanh".split()
)


def has_expensive(jaxpr: Jaxpr, operands: Sequence[bool]) -> bool:
    """Whether a function that XLA never computes twice may depend on some of the operands."""
    return _follow(jaxpr, operands)[0]


def _follow(jaxpr: Jaxpr, operands: Sequence[bool]) -> tuple[bool, list[bool]]:
    """The same, and which of the results may depend on them."""
    values = {v for v, x in zip(jaxpr.invars, operands, strict=True) if x}
    found = False
    for eqn in jaxpr.eqns:
        flags = are_among(eqn.invars, values)
        if not any(flags):
            continue
        is_found, outs = _within(eqn, flags)
        found = found or is_found
        values.update(v for v, x in zip(eqn.outvars, outs, strict=True) if x)
    return found, are_among(jaxpr.outvars, values)


def _within(eqn: JaxprEqn, flags: list[bool]) -> tuple[bool, list[bool]]:
    if eqn.primitive.name == "scan":
        loop = Loop.of(eqn)
        start, end = loop.num_constants, loop.num_constants + loop.num_carried
        while True:
            found, outs = _follow(loop.body.jaxpr, flags)
            carried = [a or b for a, b in zip(flags[start:end], outs, strict=False)]
            if carried == flags[start:end]:
                return found, outs
            flags[start:end] = carried
    found, outs = eqn.primitive.name in _EXPENSIVE, [True] * len(eqn.outvars)
    for inner in jaxprs_in_params(eqn.params):
        # The first operand of a choice is which of them.
        inner_flags = flags[len(flags) - len(inner.invars) :]
        found = found or _follow(inner, inner_flags)[0]
    return found, outs
