"""Floating-point operations of a JAX program, counted from its trace.

XLA's own cost analysis counts custom calls (factorisations, solves) as nothing, and what it
reports changes with the compiler.
"""

from collections.abc import Callable, Hashable, Iterable, Sequence
from math import log2, prod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxprs_in_params
from jaxtyping import PyTree

from .._xla.jaxprs import evaluate, parameters, structs
from .._xla.step import step_p, whole
from .lowered import arithmetic_of


def count_flops(fun: Callable[..., PyTree], *args: PyTree) -> int:
    """The floating-point operations of `fun(*args)`.

    - One for each entry of a result of `+ - * /`, a root, or an elementary function. Complex
      numbers: `+ -` 2, `*` 6, `/` 11, a modulus 4, a product of matrices four times a real one.
    - An integer power counts its multiplications by repeated squaring.
    - A product of matrices m x k and k x n counts 2 m n k; a sum of n entries, n - 1.
    - A triangular solve of size n counts n^2 for each right-hand side, n less where the diagonal
      is 1. LU and Cholesky of size n count every operation, `2 n^3 / 3` and `n^3 / 3` in the
      leading term.
    - QR of an m x n matrix, k = min(m, n), counts `4 m n k - 2 (m + n) k^2 + 4 k^3 / 3` for R and
      as much for Q with n = k (LAPACK's working note 41). Eigenvectors of a symmetric matrix count
      `9 n^3` with its eigenvalues (Golub & Van Loan). Where complex, four times these.
    - A Fourier transform of length n counts `5 n log2 n`, half of that where one side is real, as
      is usual whatever the algorithm.
    - A scan counts its body as often as it runs. A conditional counts the branch taken, if that
      follows from `args`, which may be `jax.ShapeDtypeStruct`s; otherwise its most expensive
      branch.
    - An update of some entries counts what it applies to each.
    - Changes of sign, comparisons, selections, roundings, conversions, moves of data and integer
      arithmetic count nothing. An operation that is lowered to nothing else needs no rule.

    Operations that do not reach the result count nothing, and the same operation on the same
    operands counts once, as compilers drop both.

    **Raises** `NotImplementedError` for floating-point operations without a rule, and for loops
    of them whose length is not known when the program is traced.
    """
    jaxpr = jax.make_jaxpr(fun)(*args)
    leaves = jtu.tree_leaves(args)
    return _count(jaxpr, [None if isinstance(x, jax.ShapeDtypeStruct) else x for x in leaves])


class _Operation(NamedTuple):
    cost: int
    operands: Sequence[Hashable]
    results: Sequence[Hashable]


class _Program(NamedTuple):
    """Operations in the order of the program, and the values that do not depend on inputs."""

    operations: dict[Hashable, _Operation]
    values: dict[Hashable, Any]
    # Without branches no values are computed, as only a branch may depend on them.
    has_branches: bool


def _count(jaxpr: Jaxpr | ClosedJaxpr, arguments: Sequence[Any] | None = None) -> int:
    program = _Program({}, {}, _has_branches(jaxpr))
    inner = _open(jaxpr)
    names: list[Hashable] = [object() for _ in inner.invars]
    for name, value in zip(names, arguments or (), strict=False):
        if value is not None:
            program.values[name] = jnp.asarray(value)
    live = set(_flatten(jaxpr, names, program))
    total = 0
    for operation in reversed(program.operations.values()):
        if not live.isdisjoint(operation.results):
            total += operation.cost
            live.update(operation.operands)
    return total


def _has_branches(jaxpr: Jaxpr | ClosedJaxpr) -> bool:
    return any(
        eqn.primitive.name == "cond" or any(map(_has_branches, jaxprs_in_params(eqn.params)))
        for eqn in _open(jaxpr).eqns
    )


def _flatten(
    jaxpr: Jaxpr | ClosedJaxpr, arguments: Iterable[Hashable], program: _Program
) -> list[Hashable]:
    """Adds the operations with all calls inlined; returns the names of the results.

    Values that are equal because they are computed alike get one name.
    """
    inner = _open(jaxpr)
    names: dict[Any, Hashable] = dict(zip(inner.invars, arguments, strict=True))
    # By the array: one constant may have several variables.
    constants = jaxpr.consts if isinstance(jaxpr, ClosedJaxpr) else inner.constvars
    for v, constant in zip(inner.constvars, constants, strict=True):
        names[v] = ("constant", id(constant))
        if isinstance(jaxpr, ClosedJaxpr):
            program.values[names[v]] = constant

    def name(v):
        if not isinstance(v, Literal):
            return names[v]
        literal = ("literal", str(v.aval), repr(v.val))
        program.values[literal] = jnp.asarray(v.val, _dtype(v))
        return literal

    for eqn in inner.eqns:
        operands = [name(v) for v in eqn.invars]
        results = _inlined(eqn, operands, program)
        if results is None:
            key = (eqn.primitive, tuple(operands), parameters(eqn))
            if key not in program.operations:
                results = [object() for _ in eqn.outvars]
                program.operations[key] = _Operation(_cost(eqn), operands, results)
                if program.has_branches and all(x in program.values for x in operands):
                    inputs = [program.values[x] for x in operands]
                    values = eqn.primitive.bind(*inputs, **eqn.params)
                    values = values if eqn.primitive.multiple_results else [values]
                    program.values.update(zip(results, values, strict=True))
            results = program.operations[key].results
        names.update(zip(eqn.outvars, results, strict=True))
    return [name(v) for v in inner.outvars]


def _inlined(
    eqn: JaxprEqn, operands: Sequence[Hashable], program: _Program
) -> list[Hashable] | None:
    """The results of an equation that calls a program, unless the program depends on values."""
    kind, params = eqn.primitive.name, eqn.params
    if eqn.primitive is step_p:
        return _flatten(whole(eqn), operands, program)
    if kind in _CALLS:
        return _flatten(params[_CALLS[kind]], operands, program)
    if kind == "custom_linear_solve":
        start = sum(params["const_lengths"][:2])
        stop = start + params["const_lengths"].solve
        right_sides = operands[sum(params["const_lengths"]) :]
        return _flatten(params["jaxprs"].solve, [*operands[start:stop], *right_sides], program)
    if kind == "cond" and operands[0] in program.values:
        branch = int(np.clip(program.values[operands[0]], 0, len(params["branches"]) - 1))
        return _flatten(params["branches"][branch], operands[1:], program)
    if kind == "scan" and _has_branches(params["jaxpr"]):
        return _unrolled(eqn, operands, program)
    return None


def _count_unscanned(outside: Sequence[Any], inside: Sequence[Any]) -> int:
    """How many of a scan's values are constants or carried: these have no axis of the steps."""
    return sum(len(_shape(a)) == len(_shape(b)) for a, b in zip(outside, inside, strict=True))


def _unrolled(
    eqn: JaxprEqn, operands: Sequence[Hashable], program: _Program
) -> list[Hashable] | None:
    """The results of a scan, counted step by step, as its branches may differ between steps."""
    params = eqn.params
    if not all(x in program.values for x in operands):
        return None
    # Not by parameters of the equation, whose names change with JAX's version.
    inner = params["jaxpr"].jaxpr
    num_unscanned = _count_unscanned(eqn.invars, inner.invars)
    num_consts = num_unscanned - _count_unscanned(eqn.outvars, inner.outvars)
    consts, carry = operands[:num_consts], operands[num_consts:num_unscanned]
    scanned, outputs = operands[num_unscanned:], []
    order = range(params["length"])
    for i in reversed(order) if params["reverse"] else order:
        slices: list[Hashable] = [("slice", x, i) for x in scanned]
        program.values.update(
            (x, program.values[array][i]) for x, array in zip(slices, scanned, strict=True)
        )
        results = _flatten(params["jaxpr"], [*consts, *carry, *slices], program)
        carry = results[: len(carry)]
        outputs.append(results[len(carry) :])
    if params["reverse"]:
        outputs.reverse()
    stacked: list[Hashable] = []
    for entries in zip(*outputs, strict=True):
        stacked.append(object())
        program.operations[stacked[-1]] = _Operation(0, entries, [stacked[-1]])
        if all(x in program.values for x in entries):
            program.values[stacked[-1]] = jnp.stack([program.values[x] for x in entries])
    return [*carry, *stacked]


def _open(jaxpr: Jaxpr | ClosedJaxpr) -> Jaxpr:
    return jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr


def _cost(eqn: JaxprEqn) -> int:
    name = eqn.primitive.name
    if name in _CONTROL:
        return _CONTROL[name](eqn)
    if "update_jaxpr" in eqn.params:
        return _scatter(eqn)
    if name not in _COSTS:
        _check_free(eqn)
        return 0
    dtypes = [_dtype(v) for v in (*eqn.invars, *eqn.outvars)]
    if not any(d is not None and jnp.issubdtype(d, jnp.inexact) for d in dtypes):
        return 0
    cost = _COSTS[name](eqn)
    if cost and name != "fft" and any(map(_is_complex, dtypes)):
        if name not in _COMPLEX:
            raise _without_rule(f"{name} of complex numbers", eqn)
        return _COMPLEX[name] * cost
    return cost


def _check_free(eqn: JaxprEqn) -> None:
    """Raises unless the operation, which has no rule, computes nothing."""
    try:
        operands = structs([v.aval for v in eqn.invars])
        computing = arithmetic_of(lambda *operands: evaluate(eqn, operands), *operands)
    except Exception as error:
        raise _without_rule(eqn.primitive.name, eqn) from error
    if computing:
        what = f"{eqn.primitive.name}, which consists of {', '.join(sorted(computing))}"
        raise _without_rule(what, eqn)


def _without_rule(what: str, eqn: JaxprEqn) -> NotImplementedError:
    return NotImplementedError(
        f"count_flops has no rule for {what}, in `{eqn}`. Use operations that have one (`_COSTS` "
        "in cfjax/_measure/flops.py), or add a rule there."
    )


def _is_complex(dtype: Any) -> bool:
    return dtype is not None and jnp.issubdtype(dtype, jnp.complexfloating)


def _dtype(v: Any) -> Any:
    return getattr(v.aval, "dtype", None)


def _shape(v: Any) -> tuple[int, ...]:
    return v.aval.shape


def _size(v: Any) -> int:
    return prod(_shape(v))


def _batch(v: Any) -> int:
    """The number of matrices."""
    return prod(_shape(v)[:-2])


def _elementwise(eqn: JaxprEqn) -> int:
    return _size(eqn.outvars[0])


def _integer_power(eqn: JaxprEqn) -> int:
    n = abs(eqn.params["y"])
    multiplications = n.bit_length() + n.bit_count() - 2 if n else 0
    return (multiplications + (eqn.params["y"] < 0)) * _size(eqn.outvars[0])


def _reduction(eqn: JaxprEqn) -> int:
    return _size(eqn.invars[0]) - _size(eqn.outvars[0])


def _cumulative(eqn: JaxprEqn) -> int:
    length = _shape(eqn.invars[0])[eqn.params["axis"]]
    # An empty array has no first entries to leave out.
    return _size(eqn.invars[0]) // max(length, 1) * (length - 1)


def _product(eqn: JaxprEqn) -> int:
    (axes, _), _ = eqn.params["dimension_numbers"]
    return 2 * _size(eqn.outvars[0]) * prod(_shape(eqn.invars[0])[i] for i in axes)


def _modulus(eqn: JaxprEqn) -> int:
    return _size(eqn.outvars[0]) if _is_complex(_dtype(eqn.invars[0])) else 0


def _triangular_solve(eqn: JaxprEqn) -> int:
    a, b = eqn.invars
    n = _shape(a)[-1]
    return _size(b) * (n - 1 if eqn.params["unit_diagonal"] else n)


def _lu(eqn: JaxprEqn) -> int:
    m, n = _shape(eqn.invars[0])[-2:]
    steps = ((m - k) * (1 + 2 * (n - k)) for k in range(1, min(m, n) + 1))
    return _batch(eqn.invars[0]) * sum(steps)


def _cholesky(eqn: JaxprEqn) -> int:
    n = _shape(eqn.invars[0])[-1]
    return _batch(eqn.invars[0]) * sum(1 + (n - k) * (n - k + 2) for k in range(1, n + 1))


def _reflections(m: int, n: int, k: int) -> int:
    """k Householder reflections of length m, m - 1, .. on n columns, of which each clears one."""
    return round(4 * m * n * k - 2 * (m + n) * k**2 + 4 * k**3 / 3)


def _qr(eqn: JaxprEqn) -> int:
    m, n = _shape(eqn.invars[0])[-2:]
    k = min(m, n)
    columns = m if eqn.params["full_matrices"] else k
    return _batch(eqn.invars[0]) * (_reflections(m, n, k) + _reflections(m, columns, k))


def _eigh(eqn: JaxprEqn) -> int:
    return 9 * _batch(eqn.invars[0]) * _shape(eqn.invars[0])[-1] ** 3


def _fft(eqn: JaxprEqn) -> int:
    n = prod(eqn.params["fft_lengths"])
    real = not all(_is_complex(_dtype(v)) for v in (eqn.invars[0], eqn.outvars[0]))
    # The real side is the larger one.
    transforms = max(_size(eqn.invars[0]), _size(eqn.outvars[0])) // max(n, 1)
    return round(transforms * 5 * n * log2(max(n, 1)) / (2 if real else 1))


def _scan(eqn: JaxprEqn) -> int:
    return eqn.params["length"] * _count(eqn.params["jaxpr"])


def _branches(eqn: JaxprEqn) -> int:
    return max(_count(branch) for branch in eqn.params["branches"])


def _scatter(eqn: JaxprEqn) -> int:
    """What is applied to each of the updates, such as a sum."""
    applied = eqn.params["update_jaxpr"]
    return _size(eqn.invars[2]) * _count(applied) if applied is not None else 0


def _unknown_length(eqn: JaxprEqn) -> int:
    if any(map(_count, jaxprs_in_params(eqn.params))):
        raise NotImplementedError(
            "count_flops cannot count a while loop: its length is not known when it is traced. "
            "Use jax.lax.scan, or jax.lax.fori_loop between numbers of Python."
        )
    return 0


def _check(eqn: JaxprEqn) -> int:
    """A check of equinox, which calls the host to raise its error. Others may compute anything."""
    callback = getattr(eqn.params["callback"], "callback_func", eqn.params["callback"])
    if not getattr(callback, "__module__", "").startswith("equinox."):
        raise NotImplementedError("count_flops cannot count what a function of the host computes.")
    return 0


# Calls by the parameter that holds the program.
_CALLS = {
    "cfjax_call": "program",
    "checkpoint": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "remat2": "jaxpr",
}

# What these compute is not told by the types of their operands.
_CONTROL: dict[str, Callable[[JaxprEqn], int]] = {
    "cond": _branches,
    "pure_callback": _check,
    "scan": _scan,
    "while": _unknown_length,
}

# Real operations for one of complex numbers.
_COMPLEX = {
    **dict.fromkeys("add add_any sub reduce_sum cumsum".split(), 2),
    **dict.fromkeys("mul square integer_pow reduce_prod cumprod".split(), 6),
    "abs": 4,
    "div": 11,
    **dict.fromkeys("dot_general triangular_solve lu cholesky qr eigh".split(), 4),
}
_ARITHMETIC = (
    "acos acosh add add_any asin asinh atan atan2 atanh cbrt cos cosh div erf exp exp2 expm1 log "
    "log1p logistic mul pow rem rsqrt sin sinh sqrt square sub tan tanh"
)
# The most frequent ones that compute nothing, as looking at what they are lowered to takes some
# milliseconds; and ours, which are lowered to sums that only keep XLA from fusing.
_FREE = (
    "broadcast_in_dim cfjax_materialised cfjax_pack cfjax_unpack concatenate convert_element_type "
    "eq ge gt le lt max min ne neg pad reshape select_n slice squeeze stop_gradient transpose"
)
_COSTS: dict[str, Callable[[JaxprEqn], int]] = {
    **dict.fromkeys(_ARITHMETIC.split(), _elementwise),
    **dict.fromkeys(_FREE.split(), lambda eqn: 0),
    "abs": _modulus,
    "cholesky": _cholesky,
    "cumsum": _cumulative,
    "cumprod": _cumulative,
    "dot_general": _product,
    "eigh": _eigh,
    "fft": _fft,
    "integer_pow": _integer_power,
    "lu": _lu,
    "qr": _qr,
    "reduce_prod": _reduction,
    "reduce_sum": _reduction,
    "sign": _modulus,
    "triangular_solve": _triangular_solve,
}
