"""Operations that only move entries: which each entry of the result is."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import JaxprEqn

from .numbers import array_of, numbers, of_places, places, static_value


def moved(eqn: JaxprEqn, values: Sequence[Any]) -> np.ndarray | list[np.ndarray] | None:
    """By NumPy's function of the same meaning."""
    return BY_NUMPY[eqn.primitive.name](eqn.params, *map(numbers, values))


def _broadcast(params: Any, x: np.ndarray) -> np.ndarray:
    shape = params["shape"]
    sides = [1] * len(shape)
    for axis, n in zip(params["broadcast_dimensions"], x.shape, strict=True):
        sides[axis] = n
    return np.broadcast_to(x.reshape(sides), shape)


def _slice(params: Any, x: np.ndarray) -> np.ndarray:
    strides = params["strides"] or [1] * x.ndim
    ends = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return x[tuple(itertools.starmap(slice, ends))]


def _split(params: Any, x: np.ndarray) -> list[np.ndarray]:
    return np.split(x, np.cumsum(params["sizes"])[:-1].tolist(), params["axis"])


BY_NUMPY: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, *xs: np.concatenate(xs, params["dimension"]),
    "reshape": lambda params, x: x.reshape(params["new_sizes"]),
    "rev": lambda params, x: np.flip(x, params["dimensions"]),
    "slice": _slice,
    "split": _split,
    "squeeze": lambda params, x: np.squeeze(x, tuple(params["dimensions"])),
    "stack": lambda params, *xs: np.stack(xs, params["axis"]),
    "transpose": lambda params, x: x.transpose(params["permutation"]),
    "unstack": lambda params, x: list(np.moveaxis(x, params["axis"], 0)),
}


def sliced(eqn: JaxprEqn, values: Sequence[Any]) -> np.ndarray | None:
    """`dynamic_slice` and `dynamic_update_slice`, where the indices are known."""
    x, *rest = values
    x = numbers(x)
    is_update = eqn.primitive.name == "dynamic_update_slice"
    part = numbers(rest.pop(0)) if is_update else None
    sizes = eqn.params["slice_sizes"] if part is None else part.shape
    indices = list(map(static_value, rest))
    if any(k is None for k in indices):
        return None
    # As JAX has it, within the array.
    axes = zip(x.shape, indices, sizes, strict=True)
    firsts = [min(max(int(k), 0), n - size) for n, k, size in axes]  # pyright: ignore[reportArgumentType]
    window = tuple(slice(k, k + size) for k, size in zip(firsts, sizes, strict=True))
    if part is None:
        return x[window]
    x = x.copy()
    x[window] = part
    return x


def padded(eqn: JaxprEqn, values: Sequence[Any]) -> np.ndarray | None:
    """Fills between entries, then puts more before and after, or takes away."""
    config = eqn.params["padding_config"]

    def pad(x: np.ndarray, fill: np.ndarray) -> np.ndarray:
        sides = [
            n + max(n - 1, 0) * inner for n, (_, _, inner) in zip(x.shape, config, strict=True)
        ]
        spaced = np.full(sides, fill, x.dtype)
        spaced[tuple(slice(None, None, inner + 1) for _, _, inner in config)] = x
        more = [(max(low, 0), max(high, 0)) for low, high, _ in config]
        outs = np.pad(spaced, more, constant_values=fill)
        less = zip(outs.shape, config, strict=True)
        return outs[tuple(slice(max(-low, 0), n - max(-high, 0)) for n, (low, high, _) in less)]

    return of_places(pad, *map(numbers, values))


def gathered(eqn: JaxprEqn, values: Sequence[Any]) -> np.ndarray | None:
    x, indices = numbers(values[0]), static_value(values[1])
    if indices is None:
        return None
    # What fills is no entry, nor is what was promised not to be asked for.
    is_clipped = eqn.params["mode"] == lax.GatherScatterMode.CLIP
    mode = lax.GatherScatterMode.CLIP if is_clipped else lax.GatherScatterMode.FILL_OR_DROP
    params = eqn.params | {"fill_value": -1, "mode": mode}
    return of_places(lambda k: _by_jax(lax.gather_p, params, k, indices), x)


def scattered(eqn: JaxprEqn, values: Sequence[Any]) -> np.ndarray | None:
    """`scatter`, `scatter-add` and `scatter-mul`, where the indices are known."""
    x, indices, updates = numbers(values[0]), static_value(values[1]), numbers(values[2])
    if indices is None:
        return None
    if eqn.primitive.name == "scatter":
        put = lambda k, new: _by_jax(lax.scatter_p, eqn.params, k, indices, new)  # noqa: E731
        return of_places(put, x, updates)
    params = eqn.params | {"update_jaxpr": None, "update_consts": ()}
    none = np.full(x.shape, -1, np.int32)
    taken = _by_jax(lax.scatter_p, params, none, indices, places(updates))
    if len(np.unique(taken[taken >= 0])) < updates.size:
        return None  # Some go to one entry, or to none.
    combine = lax.add if eqn.primitive.name == "scatter-add" else lax.mul
    new, pairs = list(updates.flat), zip(x.flat, taken.flat, strict=True)
    return array_of([combine(e, new[k]) if k >= 0 else e for e, k in pairs], x.shape)


def _by_jax(primitive: Any, params: Any, *operands: np.ndarray) -> np.ndarray:
    with jax.ensure_compile_time_eval():
        return np.asarray(primitive.bind(*map(jnp.asarray, operands), **params))
