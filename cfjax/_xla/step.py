"""A step as one operation, which is scalarised where it is lowered.

The operation holds its program as it was traced: of whole arrays, and of one member of a batch.
Its derivatives, transposes and batches are JAX's own, of that program, and are the same operation
again. So where it is lowered all is known that decides how it is compiled: how long this very
program is, and what it is a batch of.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, JaxprEqn, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

from .derivatives import once_for_each_program
from .jaxprs import (
    CALLS,
    altered,
    called,
    flattened,
    is_inexact,
    program_of,
    reached,
    replaced,
    structs,
)
from .limits import (
    FLAT_BATCHES,
    FLAT_DERIVATIVES,
    FLAT_VALUES,
    FLAT_WHOLE,
    MAX_ENTRIES,
    MAX_RESULTS_IN_BATCHES,
)
from .materialise import not_materialised
from .operation import in_two, together
from .program import Declined, Reading, join, known_constant, length, on_numbers, split
from .scope import is_everywhere, unread
from .turns import by_turns

# `levels` are the axes of each `vmap` around it, the innermost first. `fixed` says which operands
# the step closes over, and `first` how many of its results are mostly used alone. A derivative is
# linear in its last operands, `linear` of them, and a tangent knows what it is the tangent `of`.
# With `once` its results are materialised together, as what needs several of them would compute it
# anew for each. Values of one system that are longer than `alone` are not scalarised; if that is
# zero, no derivatives are, either.
step_p = Primitive("cfjax_step")
step_p.multiple_results = True


class Of(NamedTuple):
    """What a program is the tangent of: some results of another along some of its operands."""

    program: ClosedJaxpr
    moving: tuple[int, ...]
    smooth: tuple[int, ...]


def step(reading: Reading, y: PyTree, is_pair: bool, in_batches: bool) -> PyTree:
    """What the function that has been read makes of `y`, as one operation.

    With `is_pair` it returns a pair, of which mostly the first part alone is used. Reverse mode
    keeps `y` and what the function closes over, and computes the step again.
    """
    known, given = [], []
    for pair in zip(reading.code.constvars, reading.consts, strict=True):
        is_known = not isinstance(pair[1], jax.Array) or known_constant(pair[1]) is not None
        (known if is_known else given).append(pair)
    code = altered(
        reading.code,
        constvars=[v for v, _ in known],
        invars=[*(v for v, _ in given), *reading.code.invars],
    )
    operands = [jnp.asarray(x) for x in (*(x for _, x in given), *jtu.tree_leaves(y))]
    structure = jtu.tree_structure(reading.shape)
    outs = step_p.bind(
        *operands,
        program=ClosedJaxpr(code, [x for _, x in known]),
        levels=(),
        fixed=tuple(k < len(given) for k in range(len(operands))),
        first=len(jtu.tree_leaves(reading.shape[0])) if is_pair else structure.num_leaves,
        linear=0,
        once=False,
        alone=0 if in_batches else FLAT_BATCHES if is_everywhere() else FLAT_VALUES,
        of=None,
    )
    return jtu.tree_unflatten(structure, outs)


@step_p.def_abstract_eval
def _(*operands, program, levels, **_):
    sizes = _sizes(operands, levels)
    return [ShapedArray((*sizes, *aval.shape), aval.dtype) for aval in program.out_avals]


def _sizes(operands: Sequence[Any], levels: Sequence[Any]) -> list[int]:
    """How many members each batch has, the outermost first."""
    shapes, sizes = [list(x.shape) for x in operands], []
    for axes in reversed(levels):
        given = zip(shapes, axes, strict=True)
        firsts = [shape.pop(0) for shape, axis in given if axis is not None]
        sizes.append(firsts[0])
    return sizes


def _jvp(primals, tangents, *, program, levels, fixed, alone, **params):
    params = params | dict(levels=levels, fixed=fixed, alone=alone)
    outs = step_p.bind(*primals, program=program, **params)
    ways: list[Any] = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in outs]
    given = enumerate(zip(primals, tangents, strict=True))
    moving = tuple(k for k, (x, way) in given if type(way) is not ad.Zero and is_inexact(x))
    are_reached = reached(program.jaxpr, [k in moving for k in range(len(primals))])
    smooth = tuple(k for k, x in enumerate(outs) if is_inexact(x) and are_reached[k])
    if not (moving and smooth):
        return outs, ways
    new = step_p.bind(
        *primals,
        *(tangents[k] for k in moving),
        program=_tangent(program, moving, smooth),
        levels=tuple((*axes, *(axes[k] for k in moving)) for axes in levels),
        fixed=(*fixed, *[False] * len(moving)),
        first=len(smooth),
        linear=len(moving),
        once=True,
        alone=alone,
        of=Of(program, moving, smooth),
    )
    return outs, replaced(ways, smooth, new)


def _some(
    program: ClosedJaxpr, values: Sequence[Any], places: Sequence[int], gives: Sequence[int]
) -> Callable[..., list[Any]]:
    """Some results as a function of some operands."""
    fun = jaxpr_as_fun(program)

    def some(*xs: Any) -> list[Any]:
        outs = fun(*replaced(values, places, xs))
        return [outs[k] for k in gives]

    return some


@once_for_each_program
def _tangent(program: ClosedJaxpr, moving: tuple[int, ...], smooth: tuple[int, ...]) -> ClosedJaxpr:
    n, avals = len(program.in_avals), program.in_avals

    def tangent(*xs):
        fun = _some(program, xs[:n], moving, smooth)
        return jax.jvp(fun, [xs[k] for k in moving], list(xs[n:]))[1]

    return program_of(tangent, *avals, *(avals[k] for k in moving))


def _transpose(cotangents, *operands, program, levels, fixed, linear, alone, of, **_):
    unknown = tuple(k for k, x in enumerate(operands) if ad.is_undefined_primal(x))
    coming = tuple(k for k, x in enumerate(cotangents) if type(x) is not ad.Zero)
    results: list[Any] = [None] * len(operands)
    if not coming:
        return results
    rest = [k for k in range(len(operands)) if k not in unknown]
    first = len(operands) - linear
    if of is not None and unknown[0] >= first:
        # By `vjp` of what this is the derivative of: a loop in it has values in its carry, and is
        # not linear.
        back = _backward(
            of.program,
            tuple(of.moving[k - first] for k in unknown),
            tuple(of.smooth[k] for k in coming),
        )
        # The other directions have no part in it.
        rest = [k for k in rest if k < first]
    else:
        back = _transposed(program, unknown, coming)
    outs = step_p.bind(
        *(operands[k] for k in rest),
        *(cotangents[k] for k in coming),
        program=back,
        levels=tuple((*(axes[k] for k in rest), *[0] * len(coming)) for axes in levels),
        fixed=(*(fixed[k] for k in rest), *[False] * len(coming)),
        first=len(unknown),
        linear=len(coming),
        once=True,
        alone=alone,
        of=None,
    )
    for k, x in zip(unknown, outs, strict=True):
        # What all members share gets the sum of their derivatives.
        shared = tuple(n for n, axes in enumerate(reversed(levels)) if axes[k] is None)
        results[k] = jnp.sum(x, shared) if shared else x
    return results


@once_for_each_program
def _backward(
    program: ClosedJaxpr, moving: tuple[int, ...], smooth: tuple[int, ...]
) -> ClosedJaxpr:
    n, avals = len(program.in_avals), program.in_avals

    def backward(*xs):
        fun = _some(program, xs[:n], moving, smooth)
        return jax.vjp(fun, *(xs[k] for k in moving))[1](list(xs[n:]))

    return program_of(backward, *avals, *(program.out_avals[k] for k in smooth))


@once_for_each_program
def _transposed(
    program: ClosedJaxpr, unknown: tuple[int, ...], coming: tuple[int, ...]
) -> ClosedJaxpr:
    avals = program.in_avals
    rest = [k for k in range(len(avals)) if k not in unknown]

    def transposed(*xs):
        known = replaced(avals, rest, xs[: len(rest)])
        fun = _some(program, known, unknown, coming)
        return jax.linear_transpose(fun, *(avals[k] for k in unknown))(list(xs[len(rest) :]))

    cotangents = (program.out_avals[k] for k in coming)
    return program_of(transposed, *(avals[k] for k in rest), *cotangents)


def _batch(operands, dims, *, program, levels, **params):
    given = zip(operands, dims, strict=True)
    moved = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in given]
    axes = tuple(None if d is None else 0 for d in dims)
    outs = step_p.bind(*moved, program=program, levels=(*levels, axes), **params)
    # What the batch does not reach is in no batch.
    are_reached = reached(program.jaxpr, [d is not None for d in dims])
    outs = [x if is_one else _one_of(x) for x, is_one in zip(outs, are_reached, strict=True)]
    return outs, [0 if is_one else None for is_one in are_reached]


def _one_of(xs):
    """One of the members of a batch, which are all the same."""
    return xs[0] if xs.shape[0] else jnp.zeros(xs.shape[1:], xs.dtype)


@step_p.def_impl
def _run(*operands, program, levels, fixed, first, linear, once, alone, of):
    num_operations = length(program.jaxpr)
    most = (FLAT_DERIVATIVES if alone else 0) if linear else FLAT_BATCHES if levels else alone
    if num_operations > most:
        return _as_traced(operands, program, levels, fixed, alone)
    for k, size in enumerate(reversed(_sizes(operands, levels))):
        moves = [axis is not None for axis in levels[k]]
        is_linear = linear and not any(moves[: len(moves) - linear])
        if is_linear and size <= MAX_ENTRIES["step"]:
            params = dict(fixed=fixed, first=first, linear=linear, once=once)
            params.update(program=program, alone=alone, of=of)
            return _one_by_one(operands, levels, k, params)
    if levels and num_operations > FLAT_WHOLE:
        operands = _without_single_numbers(operands, levels)
    outs = _flat(operands, program, levels, fixed, first, once)
    return _as_traced(operands, program, levels, fixed, alone) if outs is None else outs


def _one_by_one(operands, levels, k, params):
    """One member of a batch after the other, as of the few directions of a Jacobian.

    In a program for all of them single numbers meet arrays, and XLA would compute the former anew
    for every use.
    """
    rest = [*levels[:k], *levels[k + 1 :]]
    moving = [n for n, axis in enumerate(levels[k]) if axis is not None]
    # What is outside of this batch comes first.
    places = [sum(axes[n] is not None for axes in levels[k + 1 :]) for n in moving]
    given = zip(moving, places, strict=True)
    outs = lax.map(
        lambda some: step_p.bind(*replaced(operands, moving, some), levels=tuple(rest), **params),
        [jnp.moveaxis(operands[n], place, 0) for n, place in given],
    )
    return [jnp.moveaxis(x, 0, len(levels) - 1 - k) for x in outs]


def _flat(operands, program, levels, fixed, first, once) -> list[Any] | None:
    """The results, computed on single numbers; None if the program declines."""

    def on_one(*given):
        outs = on_numbers(program, fixed, given)
        # More results are left to XLA, which drops what nobody uses.
        leaves, structure = jtu.tree_flatten(outs)
        is_few = len(leaves) <= MAX_RESULTS_IN_BATCHES
        return structure.unflatten(together(leaves) if once and is_few else leaves)

    def apart(k: int) -> Any:
        axes = [(axes[k],) for axes in levels if axes[k] is not None]
        return _in_batches(split, axes)(operands[k])

    given = [apart(k) for k in range(len(operands))]
    try:
        made, out = jax.make_jaxpr(_in_batches(on_one, levels), return_shape=True)(*given)
        code = flattened(made, CALLS, is_once=True)
    except Declined:
        return None
    except Exception as error:
        return unread(error)
    leaves = jtu.tree_leaves(given)
    if levels and first < len(out):
        new = in_two(code, len(jtu.tree_leaves(out[:first])), leaves)
    else:
        new = called(code, leaves)
    outs = jtu.tree_unflatten(jtu.tree_structure(out), new)
    return [_in_batches(join, [(0,)] * len(levels))(x) for x in outs]


def whole(eqn: JaxprEqn) -> ClosedJaxpr:
    """The program of an operation as it was traced, of all members of a batch."""
    program, levels = eqn.params["program"], eqn.params["levels"]
    fun = _in_batches(jaxpr_as_fun(program), levels)
    return program_of(fun, *structs(eqn.invars)) if levels else program


def _as_traced(operands, program, levels, fixed, alone) -> list[Any]:
    if levels:
        operands = _without_single_numbers(operands, levels)
    fun = jaxpr_as_fun(by_turns(not_materialised(program), fixed, functools.partial(_turn, alone)))
    # A literal comes out as NumPy's.
    return list(map(jnp.asarray, _in_batches(fun, levels)(*operands)))


def _turn(alone: int, operands: Sequence[Any], program: ClosedJaxpr, fixed: Sequence[bool]):
    """A turn of a loop as an operation."""
    first = len(program.out_avals)
    params = dict(levels=(), first=first, linear=0, once=True, alone=alone, of=None)
    return step_p.bind(*operands, program=program, fixed=tuple(fixed), **params)


def _in_batches(fun: Callable[..., Any], levels: Sequence[Any]) -> Callable[..., Any]:
    for axes in levels:
        fun = jax.vmap(fun, in_axes=axes)
    return fun


def _without_single_numbers(operands: Sequence[Any], levels: Sequence[Any]) -> list[Any]:
    """The operands, materialised where they have no batch axis, as the time of a step.

    XLA would compute them anew in each of its functions for a batch.
    """
    single = [k for k in range(len(operands)) if all(axes[k] is None for axes in levels)]
    return replaced(operands, single, together([operands[k] for k in single]))


ad.primitive_jvps[step_p] = _jvp
ad.primitive_transposes[step_p] = _transpose
batching.primitive_batchers[step_p] = _batch
mlir.register_lowering(step_p, mlir.lower_fun(_run, multiple_results=True))
# Where newer versions of JAX put types of their own within, they take them out first.
step_p.to_lojax = _run
