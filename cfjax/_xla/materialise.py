"""Materialised values, which XLA computes once and on their own."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from .jaxprs import altered, is_inexact, renamed, replaced, without_dead_code
from .limits import MAX_RESULTS, MAX_RESULTS_IN_BATCHES, MAX_SIZE
from .pack import pack, sharding, unpack
from .scope import is_on, is_rewritten, is_short


def materialised(
    entries: Sequence[Array],
    *,
    in_batches: bool = False,
    alone: bool = True,
) -> list[Array]:
    """The same arrays, materialised: sent through memory.

    Otherwise XLA may compute them anew for every use. In a batch, where memory is what
    takes time, only if asked for, on CPU; outside of batches only if `alone`.
    """
    return materialised_p.bind(*entries, in_batches=in_batches, alone=alone)


def materialised_together(tree: PyTree) -> PyTree:
    """The same arrays, all of which are used several times in what follows.

    Otherwise each use would compute the step anew. They go together, as what one is made of others
    may be made of too.
    """
    leaves, structure = jtu.tree_flatten(tree)
    groups: list[list[Array]] = [[]]
    for x in leaves:
        if groups[-1] and sum(map(np.size, (*groups[-1], x))) > MAX_RESULTS:
            groups.append([])
        groups[-1].append(x)
    return structure.unflatten(x for group in groups for x in _once(group, in_batches=True))


def materialised_in_rows(tree: PyTree, alone: bool = False) -> PyTree:
    """The same arrays, computed once in states with leading axes.

    Along these axes a point needs its neighbours, and would compute them anew. With `alone` also in
    a program that is not rewritten, as it stands: in a long chain of flows XLA computes each again
    for all that follow.
    """
    if is_rewritten():
        pays = lambda x: np.size(x) > MAX_SIZE  # noqa: E731
    elif alone and is_on():
        pays = lambda x: np.ndim(x) > 0  # noqa: E731
    else:
        return tree
    return jtu.tree_map(lambda x: materialised([x], in_batches=True)[0] if pays(x) else x, tree)


def computed_once(tree: PyTree) -> PyTree:
    """The same arrays, computed once in any program."""
    # A barrier in what is rewritten would keep arrays whole.
    return materialised_in_rows(tree) if is_rewritten() else lax.optimization_barrier(tree)


def together(values: Sequence[Any], places: Sequence[int] | None = None) -> list[Any]:
    """The same, but for integers materialised together; or only those at some places."""
    places = range(len(values)) if places is None else places
    return _at([k for k in places if is_inexact(values[k])], values, in_batches=True)


def _once(tree: PyTree, **options: bool) -> PyTree:
    if not is_rewritten():
        return tree
    leaves, structure = jtu.tree_flatten(tree)
    places = [k for k, x in enumerate(leaves) if is_short(x)]
    return structure.unflatten(_at(places, leaves, **options))


def _at(places: Sequence[int], values: Sequence[Any], **options: bool) -> list[Any]:
    new = materialised([values[k] for k in places], **options) if places else []
    return replaced(values, places, new)


def not_materialised(value: Any) -> Any:
    """A program, or a parameter of an operation, in which nothing is materialised."""
    if isinstance(value, ClosedJaxpr):
        return ClosedJaxpr(_not_materialised(value.jaxpr), value.consts)
    if isinstance(value, Jaxpr):
        return _not_materialised(value)
    if isinstance(value, tuple) and any(isinstance(x, ClosedJaxpr) for x in value):
        new = map(not_materialised, value)
        # The programs of a linear solve are a named tuple.
        return value._make(new) if hasattr(value, "_make") else tuple(new)  # pyright: ignore[reportAttributeAccessIssue]
    return value


def _not_materialised(jaxpr: Jaxpr) -> Jaxpr:
    names: dict[Any, Any] = {}
    eqns = []
    for eqn in jaxpr.eqns:
        invars = renamed(eqn.invars, names)
        if eqn.primitive is materialised_p:
            names.update(zip(eqn.outvars, invars, strict=True))
        else:
            params = {name: not_materialised(value) for name, value in eqn.params.items()}
            eqns.append(eqn.replace(invars=invars, params=params))
    return without_dead_code(altered(jaxpr, eqns=eqns, outvars=renamed(jaxpr.outvars, names)))


materialised_p = Primitive("cfjax_materialised")
materialised_p.multiple_results = True


@materialised_p.def_impl
def _materialised_impl(*entries, in_batches, alone, has_calls=False):
    outs = list(entries)
    groups: dict[Any, list[int]] = {}
    for k, x in enumerate(entries):
        if jnp.issubdtype(x.dtype, jnp.inexact):
            groups.setdefault((x.shape, x.dtype, sharding(x)), []).append(k)
    for (shape, *_), places in groups.items():
        # Who asks for batches has scalars.
        is_batch = in_batches and shape != ()
        if has_calls if is_batch else alone:
            through = _by_call if is_batch else _by_reduction
            most = MAX_RESULTS_IN_BATCHES if is_batch else MAX_RESULTS
            for some in np.array_split(places, -(-len(places) // most)):
                for k, x in zip(some, through([entries[k] for k in some]), strict=True):
                    outs[k] = x
    return outs


def _by_reduction(entries: Sequence[Array]) -> list[Array]:
    # XLA fuses nothing with a reduction over the first axis, and it drops optimization barriers
    # before it fuses. The loop around stays small.
    whole = pack(entries)
    return unpack(jnp.sum(pack([whole, jnp.zeros_like(whole)]), axis=0))


def _by_call(entries: Sequence[Array]) -> list[Array]:
    # In a batch a reduction would compute everything twice. One array goes as it is: with an axis
    # more XLA may update it in place where it is still read (`understood.py`).
    is_one = len(entries) == 1
    whole = entries[0] if is_one else pack(entries, axis=entries[0].ndim)
    whole = _identity(whole)
    return [whole] if is_one else unpack(whole, axis=entries[0].ndim)


def _apart(fun: Callable[..., Any]) -> Callable[..., Any]:
    """`fun` as a function of its own, which XLA compiles apart from what is around."""
    compiled = jax.jit(fun)

    def called(*args: Any) -> Any:
        with set_xla_metadata(inlineable="false"):
            return compiled(*args)

    return called


@_apart
def _identity(x: Array) -> Array:
    return x


def call(fun: Callable[..., Any]) -> Callable[..., Any]:
    """`fun` of arrays as a function of its own in the program, on CPU.

    Otherwise XLA fuses it with what follows, and computes it anew for every entry of that.
    For functions of large arrays: what goes in and comes out goes through memory.
    """
    apart = _apart(fun)
    # Only there the calls are known to work.
    return lambda *args: lax.platform_dependent(*args, cpu=apart, default=fun)


@materialised_p.def_abstract_eval
def _(*entries, **params):
    return list(entries)


def _materialised_jvp(entries, tangents, **params):
    moving = [k for k, tangent in enumerate(tangents) if type(tangent) is not ad.Zero]
    outs = _at(moving, tangents, **params)
    return materialised_p.bind(*entries, **params), outs


def _materialised_transpose(cts, *entries, **params):
    # The transpose of zeros would compute all that comes before, too.
    coming = [k for k, ct in enumerate(cts) if type(ct) is not ad.Zero]
    outs = _at(coming, cts, **params)
    return [x if k in coming else None for k, x in enumerate(outs)]


def _materialised_batch(entries, dims, **params):
    if not params["in_batches"]:
        return entries, dims
    moved = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(entries, dims, strict=True)]
    return materialised_p.bind(*moved, **params), [None if d is None else 0 for d in dims]


ad.primitive_jvps[materialised_p] = _materialised_jvp
ad.primitive_transposes[materialised_p] = _materialised_transpose
batching.primitive_batchers[materialised_p] = _materialised_batch
mlir.register_lowering(materialised_p, mlir.lower_fun(_materialised_impl, multiple_results=True))
# Only there the calls are known to work.
mlir.register_lowering(
    materialised_p,
    mlir.lower_fun(functools.partial(_materialised_impl, has_calls=True), multiple_results=True),
    platform="cpu",
)
