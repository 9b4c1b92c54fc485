"""A step as one operation, which is scalarised where it is lowered.

The operation holds its program as it was traced: of whole arrays, and of one member of a batch.
Its derivatives, transposes and batches are JAX's own, of that program, and are the same operation
again. So where it is lowered all is known that decides how it is compiled: how long this very
program is, and what it is a batch of.

A derivative also holds what it is derived from (`Of`). On single numbers it is JAX's derivative of
the numbers, which knows what is zero; in the derivative of a loop over stages zeros are numbers as
others are, and the program is up to twice as long.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

from .expensive import has_expensive
from .jaxprs import is_inexact, narrowed, program_of, reached, replaced, structs
from .limits import MAX_ENTRIES, MAX_OPERATIONS, MAX_RESULTS
from .materialise import together
from .numbers import join, split
from .program import Declined, Reading, length, of_numbers, read
from .scope import is_rewritten, unread

step_p = Primitive("cfjax_step")
step_p.multiple_results = True


# The tangents of a function of whole arrays, or of numbers, at primals, in some directions.


def _tangents(fun, primals, tangents):
    return jax.jvp(fun, primals, tangents)[1]


def _cotangents(fun, primals, cotangents):
    return list(jax.vjp(fun, *primals)[1](cotangents))


def _transposed(fun, primals, cotangents):
    return list(jax.linear_transpose(fun, *primals)(cotangents))


class Of(NamedTuple):
    """What a program is derived from and how, and for which operands and results of that."""

    derive: Callable[[Callable[..., Any], list[Any], list[Any]], list[Any]]
    program: ClosedJaxpr
    fixed: tuple[bool, ...]
    of: "Of | None"
    moving: tuple[int, ...]
    results: tuple[int, ...]

    @property
    def residuals(self) -> list[int]:
        """The operands that the derivative has too, before its directions."""
        linear = self.moving if self.derive is _transposed else ()
        return _others(self.program.in_avals, linear)

    @property
    def directions(self) -> list[bool]:
        """Which operands of the derivative are directions, its own or those of an earlier one."""
        earlier = self.of.directions if self.of else [False] * len(self.program.in_avals)
        ways = self.moving if self.derive is _tangents else self.results
        return [*(earlier[k] for k in self.residuals), *[True] * len(ways)]

    def applied(self, fun: Callable[..., Any], operands: Sequence[Any]) -> Callable[..., list[Any]]:
        """The derivative of a function of such operands, which is the program or its like."""
        residuals, moving = self.residuals, self.moving

        def derivative(*xs: Any) -> list[Any]:
            values = replaced(operands, residuals, xs[: len(residuals)])

            def some(*primals: Any) -> list[Any]:
                outs = fun(*replaced(values, moving, primals))
                return [outs[k] for k in self.results]

            return self.derive(some, [values[k] for k in moving], list(xs[len(residuals) :]))

        return derivative

    def derived(self) -> ClosedJaxpr:
        operands, outs = self.program.in_avals, self.program.out_avals
        ways = [outs[k] for k in self.results]
        if self.derive is _tangents:
            ways = [operands[k] for k in self.moving]
        fun = self.applied(jaxpr_as_fun(self.program), operands)
        return program_of(fun, *(operands[k] for k in self.residuals), *ways)


class Kind(NamedTuple):
    """What an operation is, beyond its program."""

    # Which operands the step closes over.
    fixed: tuple[bool, ...]
    # Whether values are left as they are if they are differentiated.
    only_values: bool = False
    # The axes of each `vmap` around it, the innermost first.
    levels: tuple[tuple[int | None, ...], ...] = ()
    # How many of the last operands it is linear in, if it is a derivative.
    linear: int = 0
    # What a derivative is derived from.
    of: Of | None = None

    def is_of_directions(self, level: int) -> bool:
        """Whether a batch is one of directions of a derivative, at a point that they share."""
        if self.of is None:
            return False
        pairs = zip(self.levels[level], self.of.directions, strict=True)
        return all(axis is None or is_direction for axis, is_direction in pairs)

    @property
    def is_many(self) -> bool:
        """Whether it is of many systems."""
        return not all(map(self.is_of_directions, range(len(self.levels))))


def scalarised(fun: Callable[[PyTree], PyTree], y: PyTree, only_values: bool = False) -> PyTree:
    """`fun(y)`, in a batch computed on single numbers, if `y` is a small state of short vectors.

    The result agrees with that of `fun` to rounding. `fun` may close over traced values. Operations
    that have no rule get the array whole. Where `y` is another state or the program cannot be
    scalarised, within another one that is scalarised, and for one system, this is `fun(y)`. With
    `only_values` derivatives are left as they are. Reverse mode keeps `y` and what the function
    closes over, and computes the step again.
    """
    reading = None if is_rewritten() else read(fun, y)
    return fun(y) if reading is None else bound(reading, y, only_values)


def bound(reading: Reading, y: PyTree, only_values: bool = False) -> PyTree:
    """The results of a step as one operation. `Kind` says what the other arguments are."""
    program, parameters = reading.program, reading.parameters
    state = list(map(jnp.asarray, jtu.tree_leaves(y)))
    operands, outs = [*parameters, *state], program.out_avals
    fixed = (*[True] * len(parameters), *[False] * len(state))
    # Integers that depend on integers alone, as the number of a step, are on their own: a transpose
    # of what is linear has their values.
    are_reached = reached(program.jaxpr, map(is_inexact, operands))
    exact = [k for k, x in enumerate(outs) if not (is_inexact(x) or are_reached[k])]
    others = _others(outs, exact)
    code, _ = narrowed(program, others, range(len(operands)))
    kind = Kind(fixed, only_values)
    new = step_p.bind(*operands, program=code, kind=kind)
    counting, places = narrowed(program, exact)
    counts = map(jnp.asarray, jaxpr_as_fun(counting)(*(operands[k] for k in places)))
    leaves = replaced(replaced([None] * len(outs), others, new), exact, list(counts))
    # What it returns as it is stays the same object.
    same = {v: x for v, x in zip(program.jaxpr.invars, operands, strict=True)}
    leaves = [
        x if isinstance(v, Literal) else same.get(v, x)
        for v, x in zip(program.jaxpr.outvars, leaves, strict=True)
    ]
    return jtu.tree_unflatten(jtu.tree_structure(reading.shape), leaves)


@step_p.def_abstract_eval
def _(*operands, program, kind):
    sizes = _sizes(operands, kind.levels)
    return [ShapedArray((*sizes, *aval.shape), aval.dtype) for aval in program.out_avals]


def _sizes(operands: Sequence[Any], levels: Sequence[Any]) -> list[int]:
    """How many members each batch has, the outermost first."""
    shapes, sizes = [list(x.shape) for x in operands], []
    for axes in reversed(levels):
        pairs = zip(shapes, axes, strict=True)
        firsts = [shape.pop(0) for shape, axis in pairs if axis is not None]
        sizes.append(firsts[0])
    return sizes


def _jvp(primals, tangents, *, program, kind):
    outs = step_p.bind(*primals, program=program, kind=kind)
    ways: list[Any] = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in outs]
    pairs = enumerate(zip(primals, tangents, strict=True))
    moving = tuple(k for k, (x, way) in pairs if type(way) is not ad.Zero and is_inexact(x))
    are_reached = reached(program.jaxpr, [k in moving for k in range(len(primals))])
    results = tuple(k for k, x in enumerate(outs) if is_inexact(x) and are_reached[k])
    if not (moving and results):
        return outs, ways
    of = Of(_tangents, program, kind.fixed, kind.of, moving, results)
    new = _derivative(
        kind._replace(
            levels=tuple((*axes, *(axes[k] for k in moving)) for axes in kind.levels),
            fixed=(*kind.fixed, *[False] * len(moving)),
            linear=len(moving),
        ),
        of,
        [*primals, *(tangents[k] for k in moving)],
    )
    return outs, replaced(ways, results, new)


def _derivative(kind: Kind, of: Of, operands: Sequence[Any]) -> list[Any]:
    return step_p.bind(*operands, program=of.derived(), kind=kind._replace(of=of))


def _transpose(cotangents, *operands, program, kind):
    linear = tuple(k for k, x in enumerate(operands) if ad.is_undefined_primal(x))
    coming = tuple(k for k, x in enumerate(cotangents) if type(x) is not ad.Zero)
    derivatives: list[Any] = [None] * len(operands)
    if not coming:
        return derivatives
    residuals = _others(operands, linear)
    n, of = len(operands) - kind.linear, kind.of
    if of is not None and of.derive is _tangents and linear[0] >= n:
        # By `vjp` of what this is the derivative of: a loop in it has values in its carry, and is
        # not linear.
        moving = tuple(of.moving[k - n] for k in linear)
        results = tuple(of.results[k] for k in coming)
        of = of._replace(derive=_cotangents, moving=moving, results=results)
        # The other directions have no part in it.
        residuals = [k for k in residuals if k < n]
    else:
        of = Of(_transposed, program, kind.fixed, of, linear, coming)
    levels = kind.levels
    outs = _derivative(
        kind._replace(
            levels=tuple((*(axes[k] for k in residuals), *[0] * len(coming)) for axes in levels),
            fixed=(*(kind.fixed[k] for k in residuals), *[False] * len(coming)),
            linear=len(coming),
        ),
        of,
        [*(operands[k] for k in residuals), *(cotangents[k] for k in coming)],
    )
    for k, x in zip(linear, outs, strict=True):
        # What all members share gets the sum of their derivatives.
        shared = tuple(i for i, axes in enumerate(reversed(levels)) if axes[k] is None)
        derivatives[k] = jnp.sum(x, shared) if shared else x
    return derivatives


def _others(values: Sequence[Any], places: Sequence[int]) -> list[int]:
    return [k for k in range(len(values)) if k not in places]


def _batch(operands, dims, *, program, kind):
    pairs = zip(operands, dims, strict=True)
    moved = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in pairs]
    axes = tuple(None if d is None else 0 for d in dims)
    kind = kind._replace(levels=(*kind.levels, axes))
    outs = step_p.bind(*moved, program=program, kind=kind)
    # What the batch does not reach is in no batch.
    are_reached = reached(program.jaxpr, [d is not None for d in dims])
    outs = [x if is_one else _one_of(x) for x, is_one in zip(outs, are_reached, strict=True)]
    return outs, [0 if is_one else None for is_one in are_reached]


def _one_of(xs):
    """One of the members of a batch, which are all the same."""
    return xs[0] if xs.shape[0] else jnp.zeros(xs.shape[1:], xs.dtype)


@step_p.def_impl
def _run(*operands, program, kind, in_one_turn=False):
    is_left = kind.linear and kind.only_values
    if not kind.is_many or is_left or length(program.jaxpr) > MAX_OPERATIONS:
        return _as_traced(operands, program, kind)
    for k, size in enumerate(reversed(_sizes(operands, kind.levels))):
        if kind.is_of_directions(k) and size <= MAX_ENTRIES["step"]:
            return _one_by_one(operands, program, kind, k)
    try:
        return _on_numbers(operands, program, kind, in_one_turn)
    except Declined:
        pass
    except Exception as error:
        unread(error)
    return _as_traced(operands, program, kind)


def _on_numbers(operands, program, kind, in_one_turn) -> list[Any]:
    # In a derivative a materialised value would be a second use of what XLA never computes twice,
    # and cut the program at each of them: the gradient of `Projected(Dopri8())` on 1000 poses whose
    # field has sines took 870 ms, and takes 93 ms.
    batched = [any(axes[k] is not None for axes in kind.levels) for k in range(len(operands))]
    has_marks = kind.of is None or not has_expensive(program.jaxpr, batched)
    fun = _of_numbers(program, kind.fixed, kind.of, has_marks)
    # But for what is known, as the derivative by what has no part in it.
    are_reached = reached(program.jaxpr, [kind.of is not None] * len(operands))
    coming = [k for k, is_one in enumerate(are_reached) if is_one]

    def of_members(*operands: Any) -> list[Any]:
        outs = fun(*split(operands))
        # What needs several results of a derivative would compute it anew for each. More of them
        # are left to XLA, which drops what nobody uses.
        leaves, structure = jtu.tree_flatten([outs[k] for k in coming])
        if len(leaves) <= MAX_RESULTS:
            outs = replaced(outs, coming, structure.unflatten(together(leaves)))
        return join(outs)

    if kind.linear:
        # What is kept of many steps lies entry beside entry, and XLA would read it where it lies,
        # one member at a time: `CF4` on 1000 bodies took 6.5 ms for 50 steps, and takes 3.0 ms.
        operands = together(operands)
    whole_batch = _in_batches(of_members, kind.levels)
    if not in_one_turn:
        return whole_batch(*operands)
    sizes = _sizes(operands, kind.levels)
    outs = [jnp.zeros((*sizes, *x.shape), x.dtype) for x in program.out_avals]
    return _in_one_turn(whole_batch, operands, outs)


def _in_one_turn(fun: Callable[..., Any], operands: Sequence[Any], outs: list[Any]) -> list[Any]:
    """`fun(*operands)`, of the shapes of `outs`, in a loop of one turn.

    XLA on CPU compiles such a loop as one function, but what is in no loop that it knows to be
    short as several, where one computes anew what it needs of the others: the gradient of a step of
    `CF54` on 1000 bodies took 250 ms, and takes 0.5 ms.
    """
    # XLA does not see through barriers that there is one turn, or that all turns are alike.
    one = lax.optimization_barrier(jnp.int32(1))

    def turn(carry: Any) -> Any:
        k, some = lax.optimization_barrier((carry[0], tuple(operands)))
        return k + 1, list(fun(*some))

    return lax.while_loop(lambda carry: carry[0] < one, turn, (jnp.int32(0), outs))[1]


def _of_numbers(
    program: ClosedJaxpr,
    fixed: Sequence[bool],
    of: Of | None,
    has_marks: bool,
    is_last: bool = True,
) -> Callable[..., list[Any]]:
    """The program of operands that are apart. A derivative is that of the numbers."""
    if of is None:
        return lambda *xs: of_numbers(program, fixed, xs, is_last, has_marks)
    fun = _of_numbers(of.program, of.fixed, of.of, has_marks, False)
    return of.applied(fun, jax.eval_shape(split, structs(of.program.in_avals)))


def _one_by_one(operands, program, kind, k):
    """One member of a batch after the other, as of the few directions of a Jacobian.

    In a program for all of them single numbers meet arrays, and XLA would compute the former anew
    for every use.
    """
    levels = kind.levels
    kind = kind._replace(levels=(*levels[:k], *levels[k + 1 :]))
    moving = [n for n, axis in enumerate(levels[k]) if axis is not None]
    # What is outside of this batch comes first.
    axes = [sum(level[n] is not None for level in levels[k + 1 :]) for n in moving]
    outs = lax.map(
        lambda some: step_p.bind(*replaced(operands, moving, some), program=program, kind=kind),
        [jnp.moveaxis(operands[n], axis, 0) for n, axis in zip(moving, axes, strict=True)],
    )
    return [jnp.moveaxis(x, 0, len(levels) - 1 - k) for x in outs]


def whole(eqn: JaxprEqn) -> ClosedJaxpr:
    """The program of an operation as it was traced, of all members of a batch."""
    program, levels = eqn.params["program"], eqn.params["kind"].levels
    fun = _in_batches(jaxpr_as_fun(program), levels)
    return program_of(fun, *structs([v.aval for v in eqn.invars])) if levels else program


def _as_traced(operands, program, kind) -> list[Any]:
    fun = _in_batches(jaxpr_as_fun(program), kind.levels)
    # A literal comes out as NumPy's.
    return list(map(jnp.asarray, fun(*operands)))


def _in_batches(fun: Callable[..., Any], levels: Sequence[Any]) -> Callable[..., Any]:
    for axes in levels:
        fun = jax.vmap(fun, in_axes=axes)
    return fun


ad.primitive_jvps[step_p] = _jvp
ad.primitive_transposes[step_p] = _transpose
batching.primitive_batchers[step_p] = _batch
mlir.register_lowering(step_p, mlir.lower_fun(_run, multiple_results=True))
# Elsewhere the host would wait for each turn.
mlir.register_lowering(
    step_p,
    mlir.lower_fun(functools.partial(_run, in_one_turn=True), multiple_results=True),
    platform="cpu",
)
# Where newer versions of JAX put types of their own within, they take them out first.
step_p.to_lojax = _run
