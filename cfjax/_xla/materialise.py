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
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from .jaxprs import is_inexact, replaced
from .limits import MAX_RESULTS
from .pack import pack, unpack
from .scope import is_rewritten, is_short


def materialised(entries: Sequence[Array], is_mark: bool = False) -> list[Array]:
    """The same arrays, in a batch materialised: sent through memory. Only on CPU.

    Otherwise XLA may compute them anew for every use. Arrays of one shape go together, as what one
    is made of others may be made of too. A mark is for numbers, where all is scalarised around, and
    otherwise nothing.
    """
    return materialised_p.bind(*entries, is_mark=is_mark)


def materialised_together(tree: PyTree) -> PyTree:
    """The same arrays, all of which are used several times in what follows.

    Otherwise each use would compute the step anew.
    """
    if not is_rewritten():
        return tree
    leaves, structure = jtu.tree_flatten(tree)
    places = [k for k, x in enumerate(leaves) if is_short(x)]
    return structure.unflatten(_at(places, leaves, is_mark=True))


def computed_once(tree: PyTree) -> PyTree:
    """The same arrays, computed once in a program that is not rewritten."""
    # A barrier in what is rewritten would keep arrays whole.
    return tree if is_rewritten() else lax.optimization_barrier(tree)


def together(values: Sequence[Any]) -> list[Any]:
    """The same, but for integers materialised together."""
    return _at([k for k, x in enumerate(values) if is_inexact(x)], values)


def _at(places: Sequence[int], values: Sequence[Any], is_mark: bool = False) -> list[Any]:
    new = materialised([values[k] for k in places], is_mark) if places else []
    return replaced(values, places, new)


materialised_p = Primitive("cfjax_materialised")
materialised_p.multiple_results = True


@materialised_p.def_impl
def _impl(*entries, is_mark, has_calls=False):
    outs = list(entries)
    groups: dict[Any, list[int]] = {}
    for k, x in enumerate(entries):
        # Without axes there is no batch.
        if has_calls and not is_mark and x.ndim and is_inexact(x):
            groups.setdefault((x.shape, x.dtype, jax.typeof(x).sharding), []).append(k)
    for places in groups.values():
        for some in map(np.ndarray.tolist, np.array_split(places, -(-len(places) // MAX_RESULTS))):
            outs = replaced(outs, some, _by_call([entries[k] for k in some]))
    return outs


def _by_call(entries: Sequence[Array]) -> list[Array]:
    # One array goes as it is: with an axis more XLA may update it in place where it is still read
    # (`understood.py`).
    if len(entries) == 1:
        return [_identity(entries[0])]
    axis = entries[0].ndim
    return unpack(_identity(pack(entries, axis)), axis)


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
def _(*entries, is_mark):
    return list(entries)


def _jvp(entries, tangents, **params):
    moving = [k for k, tangent in enumerate(tangents) if type(tangent) is not ad.Zero]
    return materialised_p.bind(*entries, **params), _at(moving, tangents, **params)


def _transpose(cts, *entries, **params):
    # The transpose of zeros would compute all that comes before, too.
    coming = [k for k, ct in enumerate(cts) if type(ct) is not ad.Zero]
    outs = _at(coming, cts, **params)
    return [x if k in coming else None for k, x in enumerate(outs)]


def _batch(entries, dims, **params):
    moved = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(entries, dims, strict=True)]
    return materialised_p.bind(*moved, **params), [None if d is None else 0 for d in dims]


ad.primitive_jvps[materialised_p] = _jvp
ad.primitive_transposes[materialised_p] = _transpose
batching.primitive_batchers[materialised_p] = _batch
mlir.register_lowering(materialised_p, mlir.lower_fun(_impl, multiple_results=True))
# Only there the calls are known to work.
mlir.register_lowering(
    materialised_p,
    mlir.lower_fun(functools.partial(_impl, has_calls=True), multiple_results=True),
    platform="cpu",
)
