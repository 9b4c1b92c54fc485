"""A solve for every member of a large batch: in chunks, on all devices, and safe on disk."""

import contextlib
import hashlib
import importlib.util
import os
import re
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Int, PyTree, Shaped


class BatchResult(NamedTuple):
    """What `map_batch` returns.

    - `values`: what `solve` returned, each array with an axis of the batch's length in front, in
      NumPy.
    - `failed`: indices of the members that failed, in order: those with an entry that is not
      finite, and, where `solve` returns a `diffrax.Solution`, whose `result` is not successful.
    """

    values: PyTree
    failed: Int[np.ndarray, " failures"]


def map_batch(
    solve: Callable[[PyTree], PyTree],
    members: PyTree,
    *,
    chunk_size: int = 10_000,
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

    - `solve`: a JAX function of one member. Return no more than is needed: all results are kept in
      the host's memory. An error raised within it, as `diffrax.diffeqsolve` does on failure, stops
      the batch; with `throw=False` there a failed member leaves the others alone.
    - `members`: a pytree of arrays, each with the batch's axis in front. They may be NumPy memory
      maps: only a chunk at a time goes to the devices.
    - `chunk_size`: how many members are solved at once, rounded up to a multiple of the number of
      devices.
    - `folder`: where finished chunks are kept, one file each, written atomically. After an
      interruption the same call goes on where it stopped: a file of the same members and the same
      computation is read instead of computed, anything else in its place is computed again.
    - `mesh`: a `jax.sharding.Mesh`, over all of whose axes each chunk is spread. With several
      processes (`jax.distributed`) every process makes the same call and gets the whole result;
      process 0 alone reads and writes files. By default one device.
    - `progress`: whether to show a progress bar with the time left, on a terminal. Needs `rich`,
      and without it there is none.

    **Raises** `TypeError` or `ValueError` for members that are no arrays or differ in length, for
    an empty batch and for `chunk_size < 1`; `OSError` if the folder cannot be made or written to.
    """
    size = _batch_size(members)
    if isinstance(chunk_size, bool) or not isinstance(chunk_size, int) or chunk_size < 1:
        raise ValueError(f"chunk_size must be an integer of at least 1, got {chunk_size!r}.")
    devices = 1 if mesh is None else mesh.size
    chunk_size = -(-min(chunk_size, size) // devices) * devices
    program = _Program(solve, members, chunk_size, mesh)
    store = None if folder is None else _Store(Path(folder), program)
    chunks: list[list[np.ndarray]] = []
    with _progress_bar(progress and jax.process_index() == 0, size) as advance:
        for number, start in enumerate(range(0, size, chunk_size)):
            stop = min(start + chunk_size, size)
            inputs = program.inputs(start, stop)
            outputs = None if store is None else store.read(number, inputs)
            if outputs is None:
                outputs = program(inputs)
                if store is not None:
                    store.write(number, inputs, outputs)
            chunks.append([a[: stop - start] for a in outputs])
            advance(stop - start)
    values = program.combine([np.concatenate(column) for column in zip(*chunks, strict=True)])
    return BatchResult(values, _failed(values))


def _batch_size(members: PyTree) -> int:
    leaves = jtu.tree_leaves_with_path(members)
    if not leaves:
        raise TypeError(f"members must have at least one array, got {members!r}.")
    for path, leaf in leaves:
        is_array = isinstance(leaf, jax.Array | np.ndarray)
        if not is_array or leaf.ndim == 0 or jnp.issubdtype(leaf.dtype, jax.dtypes.extended):
            raise TypeError(
                f"members{jtu.keystr(path)} must be an array of numbers with the batch's axis in "
                f"front, got {eqx.tree_pformat(leaf)}."
            )
    sizes = {f"members{jtu.keystr(path)}": len(leaf) for path, leaf in leaves}
    if len(set(sizes.values())) != 1:
        raise ValueError(f"All members must have one length, got {sizes}.")
    (size, *_) = sizes.values()
    if size == 0:
        raise ValueError("members must not be empty, got arrays of length 0.")
    return size


class _Program:
    """The compiled solve of one chunk."""

    def __init__(
        self,
        solve: Callable[[PyTree], PyTree],
        members: PyTree,
        chunk_size: int,
        mesh: Mesh | None,
    ):
        leaves, treedef = jtu.tree_flatten(members)
        self.chunk_size = chunk_size
        # An array on a device is small enough for the host; a memory map stays where it is.
        self.members = [np.asarray(a) if isinstance(a, jax.Array) else a for a in leaves]
        self.dtypes = [jax.dtypes.canonicalize_dtype(a.dtype) for a in leaves]
        self.sharding = None
        if mesh is not None:
            self.sharding = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
        found: dict[str, Any] = {}

        def one(member: list[Array]) -> list[Array]:
            value = solve(jtu.tree_unflatten(treedef, member))
            arrays, found["static"] = eqx.partition(value, eqx.is_array_like)
            leaves, found["treedef"] = jtu.tree_flatten(arrays)
            return [jnp.asarray(a) for a in leaves]

        shapes = [
            jax.ShapeDtypeStruct((chunk_size, *a.shape[1:]), dtype)
            for a, dtype in zip(leaves, self.dtypes, strict=True)
        ]
        run = jax.jit(jax.vmap(one), in_shardings=self.sharding, out_shardings=self.sharding)
        traced = run.trace(shapes)
        self.run = traced.lower().compile()
        self.outputs = jtu.tree_leaves(traced.out_info)
        self.static, self.treedef = found["static"], found["treedef"]
        # Functions print with their place in memory, which is another one in every process.
        text = re.sub("0x[0-9a-f]+", "", str(traced.jaxpr))
        self.fingerprint = _digest([np.frombuffer(text.encode(), np.uint8), *traced.jaxpr.consts])

    def inputs(self, start: int, stop: int) -> list[np.ndarray]:
        """The members of one chunk. The last chunk repeats its last member until it is full."""
        index = np.minimum(np.arange(start, start + self.chunk_size), stop - 1)
        return [
            np.asarray(a[index], dtype) for a, dtype in zip(self.members, self.dtypes, strict=True)
        ]

    def __call__(self, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
        if self.sharding is None:
            return [np.asarray(a) for a in self.run(list(inputs))]
        placed = [
            jax.make_array_from_callback(a.shape, self.sharding, lambda index, a=a: a[index])
            for a in inputs
        ]
        outputs = self.run(placed)
        if jax.process_count() > 1:
            outputs = multihost_utils.process_allgather(outputs, tiled=True)
        return [np.asarray(a) for a in outputs]

    def combine(self, arrays: list[np.ndarray]) -> PyTree:
        return eqx.combine(jtu.tree_unflatten(self.treedef, arrays), self.static)


class _Store:
    """Finished chunks as files that say what they are results of."""

    def __init__(self, folder: Path, program: _Program):
        self.folder, self.program = folder, program
        if jax.process_index() == 0:
            folder.mkdir(parents=True, exist_ok=True)

    def read(self, number: int, inputs: Sequence[np.ndarray]) -> list[np.ndarray] | None:
        """The outputs of a chunk, or None where there is no whole file of just these inputs."""
        outputs = self._read(number, inputs) if jax.process_index() == 0 else None
        if jax.process_count() == 1:
            return outputs
        # All processes must go the same way.
        if not multihost_utils.broadcast_one_to_all(np.asarray(outputs is not None)):
            return None
        if outputs is None:
            outputs = [np.zeros(a.shape, a.dtype) for a in self.program.outputs]
        return [np.asarray(a) for a in multihost_utils.broadcast_one_to_all(outputs)]

    def _read(self, number: int, inputs: Sequence[np.ndarray]) -> list[np.ndarray] | None:
        try:
            # Opened here: `np.load` by name leaves a damaged file open.
            with open(self._path(number), "rb") as raw, np.load(raw, allow_pickle=False) as file:
                if file["key"].tobytes() != self._key(inputs):
                    return None
                outputs = [file[f"output_{i}"] for i in range(len(self.program.outputs))]
        # What a file cut short or changed on the disk can raise; each array has a checksum.
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            return None
        expected = [(a.shape, a.dtype) for a in self.program.outputs]
        return outputs if [(a.shape, a.dtype) for a in outputs] == expected else None

    def write(
        self, number: int, inputs: Sequence[np.ndarray], outputs: Sequence[np.ndarray]
    ) -> None:
        if jax.process_index() != 0:
            return
        named = {f"output_{i}": a for i, a in enumerate(outputs)}
        named["key"] = np.frombuffer(self._key(inputs), np.uint8)
        # The file gets its name when it is whole and on the disk.
        with tempfile.NamedTemporaryFile(dir=self.folder, suffix=".part", delete=False) as file:
            try:
                np.savez(file, allow_pickle=False, **named)
                file.flush()
                os.fsync(file.fileno())
                os.replace(file.name, self._path(number))
            except BaseException:
                os.unlink(file.name)
                raise

    def _path(self, number: int) -> Path:
        return self.folder / f"chunk_{number:06}.npz"

    def _key(self, inputs: Sequence[np.ndarray]) -> bytes:
        return self.program.fingerprint + _digest(inputs)


def _digest(arrays: Iterable[Shaped[Array | np.ndarray, "..."]]) -> bytes:
    digest = hashlib.sha256()
    for array in map(np.asarray, arrays):
        digest.update(f"{array.shape} {array.dtype};".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()


def _failed(values: PyTree) -> Int[np.ndarray, " failures"]:
    if not isinstance(values, diffrax.Solution):
        return np.flatnonzero(np.any(_not_finite(values), axis=0))
    bad = [np.asarray(values.result != diffrax.RESULTS.successful)]
    # diffrax fills what is left of the room for saved times and states with infinity.
    jtu.tree_map(lambda ts, ys: bad.extend(_not_finite(ys, np.isfinite(ts))), values.ts, values.ys)
    return np.flatnonzero(np.any(bad, axis=0))


def _not_finite(values: PyTree, where: Any = True) -> list[Bool[np.ndarray, " members"]]:
    """For each array of numbers, which members have one that is not finite there."""
    arrays = [a for a in jtu.tree_leaves(values) if eqx.is_inexact_array_like(a)]
    places = [np.reshape(where, np.shape(where) + (1,) * (a.ndim - np.ndim(where))) for a in arrays]
    bad = [~np.isfinite(a) & place for a, place in zip(arrays, places, strict=True)]
    return [a.reshape(len(a), -1).any(axis=1) for a in bad]


@contextlib.contextmanager
def _progress_bar(wanted: bool, size: int) -> Iterator[Callable[[int], None]]:
    if not wanted or importlib.util.find_spec("rich") is None:
        yield lambda count: None
        return
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("Solving", total=size)
        yield lambda count: bar.advance(task, count)
