"""A solve for every member of a large batch: in chunks, on all devices, and safe on disk."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh
from jaxtyping import Bool, Int, PyTree

from .._arguments import count
from .failure import solved
from .program import OUTSIDE, Program
from .progress import progress_bar
from .store import Store


class BatchResult(NamedTuple):
    """What `map_batch` returns.

    - `values`: what `solve` returned, as NumPy arrays or arrays of PRNG keys, each with an axis of
      the batch's length in front.
    - `failed`: indices of the members that failed, in order: members with an entry that is not
      finite and, if `solve` returns a `diffrax.Solution`, members whose `result` is not successful.
    """

    values: PyTree
    failed: Int[np.ndarray, " failures"]


def map_batch(
    solve: Callable[[PyTree], PyTree],
    members: PyTree,
    *,
    chunk_size: int | np.integer = 10_000,
    folder: str | os.PathLike[str] | None = None,
    mesh: Mesh | None = None,
    progress: bool = True,
) -> BatchResult:
    """Calls `solve` for every member of a batch, compiled once, chunk by chunk under `jax.vmap`.

    ```python
    def solve(member):
        y0, inertia = member
        return cfjax.integrate(term, cfjax.CF4(), 0.0, 10.0, y0, inertia, num_steps=100).ys[-1]

    result = cfjax.map_batch(solve, (y0s, inertias), folder="results")
    ```

    **Arguments:**

    - `solve`: a JAX function of one member. Return no more than you need: all results are kept in
      the host's memory. An error raised within `solve`, as `diffrax.diffeqsolve` does on failure,
      stops the batch, and names the first member that fails. `map_batch` finds it by bisection,
      in up to `2 + log2(chunk_size)` times the time of a chunk. If `solve` uses `throw=False`, a
      failed member does not affect the others. `solve` must not capture traced values: call
      `map_batch` outside of `jax.jit`, `jax.vmap` and `jax.grad`.
    - `members`: a pytree of arrays of numbers or of PRNG keys, each with the batch's axis in front.
      They may be NumPy memory maps: only one chunk at a time goes to the devices.
    - `chunk_size`: how many members are solved at once, rounded up to a multiple of the number of
      devices.
    - `folder`: where finished chunks are kept, one file each, written atomically. After an
      interruption the same call continues where it stopped: it reads finished chunks instead of
      computing them. A folder belongs to one batch. If it has chunks of other members, of another
      `chunk_size` or of another computation, the call is an error, and leaves the chunks as they
      are. The computation includes all constants that `solve` captures, the versions of cfjax and
      jax, and the kind of device. It does not include functions of the host, whose code jax does
      not see, so `solve` must not take values from one. Prints are allowed. If a file is damaged,
      its chunk is computed again, with a warning. `batch.json` in the folder says how to read the
      files without this function; the page on batches shows how.
    - `mesh`: a `jax.sharding.Mesh`; each chunk is spread over all of its axes. With several
      processes (`jax.distributed`) every process makes the same call and gets the whole result;
      only process 0 reads and writes files. By default one device.
    - `progress`: whether to show a progress bar with the time left, on a terminal. Without `rich`
      there is none.

    **Raises** `TypeError` or `ValueError` if members are not arrays or differ in length, if the
    batch is empty, if members or what `solve` captures are traced, if `chunk_size < 1`, if `mesh`
    is not a `Mesh`, if `folder` is no path, empty or has another batch, or if there is a `folder`
    and `solve` calls a function of the host, as `jax.pure_callback` and progress meters do;
    `OSError` if the folder cannot be made or written to, or has a folder in place of a file;
    `equinox.EquinoxRuntimeError`, with the number of the member, for an error raised within
    `solve`.
    """
    size = _batch_size(members)
    if not isinstance(mesh, Mesh | None):
        raise TypeError(f"mesh must be a jax.sharding.Mesh, got {mesh!r}.")
    if folder is not None and not isinstance(folder, str | os.PathLike):
        raise TypeError(f"folder must be a path or None, got {folder!r}.")
    if folder == "":
        # `Path` takes it as the working folder.
        raise ValueError("folder must not be empty, got ''. The working folder is '.'.")
    devices = 1 if mesh is None else mesh.size
    chunk_size = -(-min(count("chunk_size", chunk_size), size) // devices) * devices
    program = Program(solve, members, chunk_size, mesh)
    store = None if folder is None else Store(Path(folder), program, size)
    chunks: list[list[np.ndarray]] = []
    with progress_bar(progress and jax.process_index() == 0, "Solving", size) as update:
        for number, start in enumerate(range(0, size, chunk_size)):
            stop = min(start + chunk_size, size)
            inputs = program.inputs(start, stop)
            outputs = None if store is None else store.read(number, inputs)
            if outputs is None:
                outputs = solved(program, inputs, start, stop, update)
                if store is not None:
                    store.write(number, inputs, outputs)
            chunks.append([a[: stop - start] for a in outputs])
            update(advance=stop - start)
    values = program.combine([np.concatenate(column) for column in zip(*chunks, strict=True)])
    return BatchResult(values, _failed(values))


def _batch_size(members: PyTree) -> int:
    leaves = jtu.tree_leaves_with_path(members)
    if not leaves:
        raise TypeError(f"members must have at least one array, got {members!r}.")
    for path, leaf in leaves:
        if isinstance(leaf, Tracer):
            raise TypeError(
                f"members{jtu.keystr(path)} must be an array with values, got one that is traced. "
                f"{OUTSIDE}"
            )
        is_array = isinstance(leaf, jax.Array | np.ndarray)
        if not is_array or leaf.ndim == 0 or not _is_of_jax(leaf.dtype):
            raise TypeError(
                f"members{jtu.keystr(path)} must be an array of numbers or of PRNG keys with the "
                f"batch's axis in front, got {eqx.tree_pformat(leaf)}."
            )
        if np.ma.isMaskedArray(leaf):
            raise TypeError(f"members{jtu.keystr(path)} must not be masked, got a masked array.")
    sizes = {f"members{jtu.keystr(path)}": len(leaf) for path, leaf in leaves}
    if len(set(sizes.values())) != 1:
        raise ValueError(f"All members must have one length, got {sizes}.")
    (size, *_) = sizes.values()
    if size == 0:
        raise ValueError("members must not be empty, got arrays of length 0.")
    return size


def _is_of_jax(dtype: Any) -> bool:
    """Whether jax has arrays of this dtype. It lacks NumPy's numbers of extended precision.

    Names do not identify these: on some machines `np.longdouble` is a double.
    """
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return True
    is_number = any(jnp.issubdtype(dtype, kind) for kind in (np.bool_, np.number))
    return is_number and dtype.itemsize <= (16 if jnp.issubdtype(dtype, np.complexfloating) else 8)


def _failed(values: PyTree) -> Int[np.ndarray, " failures"]:
    if not isinstance(values, diffrax.Solution):
        return np.flatnonzero(np.any(_not_finite(values), axis=0))
    bad = [np.asarray(values.result != diffrax.RESULTS.successful)]
    # diffrax fills unused entries of saved times and states with infinity.
    jtu.tree_map(lambda ts, ys: bad.extend(_not_finite(ys, np.isfinite(ts))), values.ts, values.ys)
    return np.flatnonzero(np.any(bad, axis=0))


def _not_finite(values: PyTree, mask: Any = True) -> list[Bool[np.ndarray, " members"]]:
    """For each array of numbers, which members have one in the mask that is not finite."""
    arrays: list[Any] = [a for a in jtu.tree_leaves(values) if isinstance(a, np.ndarray)]
    # Not by np.issubdtype: to NumPy bfloat16 is no number.
    arrays = [a for a in arrays if jnp.issubdtype(a.dtype, np.inexact)]
    masks = [np.reshape(mask, np.shape(mask) + (1,) * (a.ndim - np.ndim(mask))) for a in arrays]
    bad = [~np.isfinite(a) & m for a, m in zip(arrays, masks, strict=True)]
    return [a.reshape(len(a), -1).any(axis=1) for a in bad]
