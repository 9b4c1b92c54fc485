"""A function on single numbers: where it is scalarised, and where it is left as it is."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun, jaxprs_in_params
from jaxtyping import Array, PyTree

from .alone import Choice, alone_p
from .jaxprs import operation_p, program_of, without_constants
from .materialise import materialised
from .operation import operation
from .program import (
    SHORT,
    Reading,
    closed_over,
    filled,
    join,
    read,
    run_split,
    split,
    split_like,
    traced,
)
from .scope import in_equal_steps, is_everywhere, rewriting, where
from .step import step
from .struct_of_arrays import StructOfArrays


def scalarised(
    fun: Callable[[PyTree], PyTree],
    y: PyTree,
    is_derived: bool = True,
    is_pair: bool = False,
    is_alone: bool = False,
) -> PyTree:
    """`fun(y)`, computed on single numbers where `y` is a small state of short vectors.

    The result agrees with that of `fun` to rounding. `fun` may close over traced values. Operations
    that have no rule get the array whole. Where `y` is another state, the program is too long or
    cannot be scalarised, and within another one that is scalarised, this is `fun(y)`. Unless
    `is_derived`, derivatives are JAX's own of the program as it is, which compile faster. Outside
    of a loop of equal steps, what is long is scalarised in batches only, and its derivatives are
    not, unless rewriting is switched on. With `is_alone` so is what is short. With `is_pair` the
    function returns a pair, of which mostly the first part alone is used.
    """
    reading = None if where() else read(fun, y, "step")
    if reading is None:
        return fun(y)
    is_long = reading.length > SHORT or is_alone
    is_usual = is_derived and not is_long
    if not (is_usual or reading.rows or in_equal_steps() or is_everywhere()):
        outs = _in_batches(fun, y, reading, is_pair)
        if outs is not None:
            return outs
    if is_usual and not reading.rows:
        return step(reading, y, is_pair)
    program = traced(fun, y, reading, "step", is_derived)
    if program is None:
        return fun(y)
    y, parameters = split((y, program.parameters), program.rows)
    # What is around may use single entries, so that XLA computes anew what these share. It does
    # little harm to a step, but much to a derivative.
    is_derived = is_derived and (not is_long or in_equal_steps() or is_everywhere())
    through = _materialised if is_derived else lambda x: x
    # The derivative of an adaptive loop computes a step at one place and uses its derivative at
    # another. What that needs of the step is many numbers: to compute them again is cheaper than to
    # materialise them.
    out = operation(
        program.run,
        *through((y, parameters)),
        place="step",
        is_batch=program.rows,
        plain=program.plain,
        order=1 if is_derived else 0,
        is_pair=is_pair,
    )
    # One by one: what is not used is not computed.
    is_apart = lambda x: isinstance(x, StructOfArrays)  # noqa: E731
    return jtu.tree_map(lambda x: join(through(x)), out, is_leaf=is_apart)


def _in_batches(
    fun: Callable[[PyTree], PyTree], y: PyTree, reading: Reading, is_pair: bool
) -> PyTree | None:
    """`fun(y)`, scalarised in batches only; None if what it returns depends on that."""
    alone, shape = jax.make_jaxpr(fun, return_shape=True)(y)
    derived, other = alone, shape
    if _has_operations(alone.jaxpr):
        # A loop over stages each of which is scalarised has a derivative that is longer.
        with rewriting(False):
            derived, other = jax.make_jaxpr(fun, return_shape=True)(y)
    if not _types(shape) == _types(other) == _types(reading.shape):
        return None
    parameters, consts, *rest = closed_over(reading.consts, alone.consts, derived.consts)
    leaves, structure = jtu.tree_flatten(y)
    operands = [*map(jnp.asarray, leaves), *parameters]
    avals = list(map(jax.typeof, operands))
    n, ends = len(leaves), jtu.tree_structure(shape)
    shapes = jax.eval_shape(split, (y, parameters))

    def of_operands(program: ClosedJaxpr, consts: Sequence[Any]) -> ClosedJaxpr:
        def run(*operands: Array) -> Sequence[Any]:
            closed = ClosedJaxpr(program.jaxpr, filled(consts, operands[n:]))
            # A literal comes out as NumPy's.
            return list(map(jnp.asarray, jaxpr_as_fun(closed)(*operands[:n])))

        return program_of(run, *avals)

    is_one = derived is alone
    alone = of_operands(alone, rest[0])
    derived = alone if is_one else of_operands(derived, rest[1])
    # Nothing that is traced now may be kept for later.
    code = without_constants(ClosedJaxpr(reading.code, reading.consts)).jaxpr
    reading = reading._replace(code=code, consts=())

    def make() -> Callable[..., Sequence[Any]] | None:
        found = reading.scalarised(consts, *shapes)
        if found is None:
            return None
        made, out = found

        def plain(y: PyTree, parameters: PyTree) -> PyTree:
            outs = jaxpr_as_fun(derived)(*jtu.tree_leaves(join((y, parameters))))
            return split_like(out, jtu.tree_unflatten(ends, outs))

        def run(*operands: Array) -> Sequence[Any]:
            apart = split((jtu.tree_unflatten(structure, operands[:n]), list(operands[n:])))
            outs = operation(
                lambda *args: run_split(made, out, *args),
                *apart,
                place="step",
                plain=plain,
                order=0,
                is_pair=is_pair,
            )
            return list(map(jnp.asarray, jtu.tree_leaves(join(outs))))

        return run

    outs = alone_p.bind(*operands, program=alone, choice=Choice(derived, make))
    return jtu.tree_unflatten(ends, outs)


def _has_operations(jaxpr: Jaxpr) -> bool:
    return any(
        eqn.primitive in (operation_p, alone_p)
        or any(map(_has_operations, jaxprs_in_params(eqn.params)))
        for eqn in jaxpr.eqns
    )


def _types(shape: PyTree) -> tuple[Any, list[Any]]:
    leaves, structure = jtu.tree_flatten(shape)
    return structure, [(x.shape, x.dtype) for x in leaves]


def _materialised(tree: Any) -> Any:
    """The same, with all single numbers materialised where this is differentiated."""
    leaves, structure = jtu.tree_flatten(tree)
    places = [k for k, x in enumerate(leaves) if _is_number(x)]
    if places:
        new = materialised([leaves[k] for k in places], in_batches=True, now=False)
        for k, x in zip(places, new, strict=True):
            leaves[k] = x
    return jtu.tree_unflatten(structure, leaves)


def _is_number(x: Any) -> bool:
    return isinstance(x, Tracer) and x.ndim == 0 and jnp.issubdtype(x.dtype, jnp.inexact)
