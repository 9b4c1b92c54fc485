"""A solve for every member of a large batch: in chunks, on all devices, and safe on disk."""

import contextlib
import functools
import hashlib
import json
import math
import os
import warnings
from collections.abc import Callable, Sequence
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
from jaxtyping import Array, Bool, Int, PyTree

from .._integrate import count
from .fingerprint import digest, environment, fingerprint
from .progress import progress_bar


class BatchResult(NamedTuple):
    """What `map_batch` returns.

    - `values`: what `solve` returned, each array with an axis of the batch's length in front, in
      NumPy, or with PRNG keys.
    - `failed`: indices of the members that failed, in order: those with an entry that is not
      finite, and, where `solve` returns a `diffrax.Solution`, whose `result` is not successful.
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

    - `solve`: a JAX function of one member. Return no more than is needed: all results are kept in
      the host's memory. An error raised within it, as `diffrax.diffeqsolve` does on failure, stops
      the batch; with `throw=False` there a failed member leaves the others alone.
    - `members`: a pytree of arrays of numbers or of PRNG keys, each with the batch's axis in front.
      They may be NumPy memory maps: only a chunk at a time goes to the devices.
    - `chunk_size`: how many members are solved at once, rounded up to a multiple of the number of
      devices.
    - `folder`: where finished chunks are kept, one file each, written atomically. After an
      interruption the same call goes on where it stopped: what is there is read instead of
      computed. A folder belongs to one batch. If it holds chunks of other members, of another
      `chunk_size` or of another computation, the call is an error, and leaves them as they are. To
      the computation belong all constants that `solve` captures, wherever, the versions of cfjax
      and jax, and the kind of device, but no functions of the host, whose code jax does not see:
      `solve` must not take values from one. What it prints does not count. A file that is damaged
      is computed again, with a warning. `batch.json` in the folder says how to read the files
      without this function; the page on batches shows how.
    - `mesh`: a `jax.sharding.Mesh`, over all of whose axes each chunk is spread. With several
      processes (`jax.distributed`) every process makes the same call and gets the whole result;
      process 0 alone reads and writes files. By default one device.
    - `progress`: whether to show a progress bar with the time left, on a terminal. Needs `rich`,
      and without it there is none.

    **Raises** `TypeError` or `ValueError` if members are not arrays or differ in length, for
    an empty batch, for `chunk_size < 1`, if `mesh` is not a `Mesh`, for a `folder` that holds
    another batch, and for one with a `solve` that calls a function of the host, as
    `jax.pure_callback` and progress meters do; `OSError` if the folder cannot be made or written
    to.
    """
    size = _batch_size(members)
    if not isinstance(mesh, Mesh | None):
        raise TypeError(f"mesh must be a jax.sharding.Mesh, got {mesh!r}.")
    devices = 1 if mesh is None else mesh.size
    chunk_size = -(-min(count("chunk_size", chunk_size), size) // devices) * devices
    program = _Program(solve, members, chunk_size, mesh)
    store = None if folder is None else _Store(Path(folder), program, size)
    chunks: list[list[np.ndarray]] = []
    with progress_bar(progress and jax.process_index() == 0, "Solving", size) as update:
        for number, start in enumerate(range(0, size, chunk_size)):
            stop = min(start + chunk_size, size)
            inputs = program.inputs(start, stop)
            outputs = None if store is None else store.read(number, inputs)
            if outputs is None:
                outputs = program(inputs)
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
    """Whether jax has arrays of it. Of NumPy's numbers it lacks those of extended precision.

    Not by the names of these: on some machines `np.longdouble` is a double.
    """
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return True
    is_number = any(jnp.issubdtype(dtype, kind) for kind in (np.bool_, np.number))
    return is_number and dtype.itemsize <= (16 if jnp.issubdtype(dtype, np.complexfloating) else 8)


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


class _Structure(NamedTuple):
    """That of a pytree of arrays, whose leaves are kept apart, and PRNG keys as their numbers."""

    treedef: Any
    kinds: list[Any]  # For each leaf, what kind of PRNG key it is, or None.

    @classmethod
    def of(cls, tree: PyTree) -> tuple["_Structure", list[Any]]:
        leaves, treedef = jtu.tree_flatten(tree)
        kinds = [jax.random.key_impl(a) if _is_key(a) else None for a in leaves]
        return cls(treedef, kinds), [jax.random.key_data(a) if _is_key(a) else a for a in leaves]

    def tree(self, leaves: Sequence[Any]) -> PyTree:
        return self.treedef.unflatten(
            a if kind is None else jax.random.wrap_key_data(a, impl=kind)
            for a, kind in zip(leaves, self.kinds, strict=True)
        )


class _Program:
    """The compiled solve of one chunk."""

    def __init__(
        self,
        solve: Callable[[PyTree], PyTree],
        members: PyTree,
        chunk_size: int,
        mesh: Mesh | None,
    ):
        structure, leaves = _Structure.of(members)
        self.chunk_size = chunk_size
        # An array on a device is small enough for the host; a memory map stays where it is.
        self.members = [np.asarray(a) if isinstance(a, jax.Array) else a for a in leaves]
        # In the order of bytes of this machine, whatever that of a file is.
        native = [a.dtype.newbyteorder("=") for a in leaves]
        self.dtypes = [jax.dtypes.canonicalize_dtype(dtype) for dtype in native]
        self.mesh, self.sharding = mesh, None
        if mesh is not None:
            self.sharding = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
        found: dict[str, Any] = {}

        def one(member: list[Array]) -> list[Array]:
            value = solve(structure.tree(member))
            arrays, found["static"] = eqx.partition(value, eqx.is_array_like)
            found["structure"], leaves = _Structure.of(arrays)
            return [jnp.asarray(a) for a in leaves]

        shapes = [
            jax.ShapeDtypeStruct((chunk_size, *a.shape[1:]), dtype)
            for a, dtype in zip(leaves, self.dtypes, strict=True)
        ]
        run = jax.jit(jax.vmap(one), in_shardings=self.sharding, out_shardings=self.sharding)
        self.traced = run.trace(shapes)
        self.lowered = self.traced.lower()
        self.outputs = jtu.tree_leaves(self.traced.out_info)
        self.static, self.structure = found["static"], found["structure"]

    @functools.cached_property
    def run(self) -> jax.stages.Compiled:
        # Where all chunks are read, nothing is compiled.
        return self.lowered.compile()

    @property
    def environment(self) -> dict[str, Any]:
        devices = jnp.zeros(()).devices() if self.mesh is None else self.mesh.devices.flat
        return environment(devices)

    def fingerprint(self) -> bytes:
        return fingerprint(self.traced, self.lowered, self.environment)

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
        return eqx.combine(self.structure.tree(arrays), self.static)


class _Store:
    """Finished chunks as files, and a file that says how to read them and what they belong to.

    The file of a chunk has a digest of the computation and the members, then one of all else in the
    file, so that no damage goes unseen, then the bytes of the results.
    """

    FORMAT = "cfjax.map_batch 1"
    START = 2 * hashlib.sha256().digest_size

    def __init__(self, folder: Path, program: _Program, size: int):
        self.folder, self.outputs = folder, program.outputs
        self.fingerprint = program.fingerprint()
        self.description = {
            "format": self.FORMAT,
            "members": size,
            "chunk_size": program.chunk_size,
            "computation": self.fingerprint.hex(),
            **program.environment,
            "arrays": self._arrays(program),
        }
        _of_first_process(self._open)

    def _arrays(self, program: _Program) -> list[dict[str, Any]]:
        """Where each array of a chunk is in its file."""
        structure, offset, arrays = program.structure, self.START, []
        tree = structure.treedef.unflatten(self.outputs)
        paths = [jtu.keystr(path) for path, _ in jtu.tree_leaves_with_path(tree)]
        for path, kind, a in zip(paths, structure.kinds, self.outputs, strict=True):
            # With the order of bytes, for dtypes that NumPy knows.
            dtype = a.dtype.str if a.dtype.isbuiltin == 1 else a.dtype.name
            arrays.append({"path": path, "dtype": dtype, "shape": a.shape[1:], "offset": offset})
            if kind is not None:
                arrays[-1]["key"] = str(kind)
            offset += math.prod(a.shape) * a.dtype.itemsize
        return arrays

    def _open(self) -> None:
        """Makes the folder, or sees that what it holds is of this batch."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path, text = self.folder / "batch.json", json.dumps(self.description, indent=2)
        found = path.read_text() if path.exists() else None
        if found == text:
            return
        if any(self.folder.glob("chunk_*.bin")):
            what = f"chunks, but no {path.name}" if found is None else self._differences(found)
            raise ValueError(self._other(what))
        self._write(path, text.encode())

    def _differences(self, text: str) -> str:
        try:
            found = json.loads(text)
            names = [name for name in self.description if name not in ("computation", "arrays")]
            texts = [
                f"{name} {found[name]!r} where {self.description[name]!r} is expected"
                for name in names
                if found[name] != self.description[name]
            ]
        except (ValueError, TypeError, KeyError):
            return "a batch.json that is damaged"
        # That of another chunk size is another one in any case.
        return ", ".join(texts) or (
            "the results of another computation: another solve, another constant that it captures, "
            "or another setting of jax"
        )

    def _other(self, what: str) -> str:
        return (
            f"folder must be empty or hold this batch, but {str(self.folder)!r} holds {what}. It "
            "is left as it is. Make the call that it was made with, give another folder, or remove "
            "this one."
        )

    def read(self, number: int, inputs: Sequence[np.ndarray]) -> list[np.ndarray] | None:
        """The outputs of a chunk, or None where there is no whole file.

        **Raises** `ValueError` for a whole file of other inputs.
        """
        data = _of_first_process(lambda: self._read(number, inputs))
        if data is None:
            return None
        arrays, start = [], 0
        for a in self.outputs:
            arrays.append(np.ndarray(a.shape, a.dtype, data, start))
            start += arrays[-1].nbytes
        return arrays

    def _read(self, number: int, inputs: Sequence[np.ndarray]) -> bytes | None:
        path = self._path(number)
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError:
            content = b""
        middle = self.START // 2
        belongs, whole, data = content[:middle], content[middle : self.START], content[self.START :]
        if whole != _digest(belongs, data):
            warnings.warn(f"{path} is damaged, and is computed again.", stacklevel=6)
            return None
        if belongs != _digest(self.fingerprint, *inputs):
            raise ValueError(self._other(f"the results of other members in {path.name}"))
        return data

    def write(
        self, number: int, inputs: Sequence[np.ndarray], outputs: Sequence[np.ndarray]
    ) -> None:
        if jax.process_index() == 0:
            data = b"".join(a.tobytes() for a in outputs)
            belongs = _digest(self.fingerprint, *inputs)
            self._write(self._path(number), belongs + _digest(belongs, data) + data)

    def _write(self, path: Path, content: bytes) -> None:
        # One name for each file: what a killed process leaves is written over.
        part = path.with_suffix(".part")
        try:
            with open(part, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            # The file gets its name when it is whole and on the disk. It is there under it already
            # where another process has written the same just now.
            with contextlib.suppress(FileNotFoundError):
                os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
        _sync(self.folder)

    def _path(self, number: int) -> Path:
        return self.folder / f"chunk_{number:06}.bin"


def _digest(*parts: bytes | np.ndarray) -> bytes:
    return digest([np.frombuffer(x, np.uint8) if isinstance(x, bytes) else x for x in parts])


def _of_first_process(fun: Callable[[], bytes | None]) -> bytes | None:
    """What `fun` returns in process 0, or an error in all of them where it raises one there."""
    data, error = None, None
    if jax.process_index() == 0:
        try:
            data = fun()
        except (ValueError, OSError) as raised:
            error = raised
    if jax.process_count() > 1:
        # All processes must go the same way.
        sent = data if error is None else str(error).encode()
        facts = np.asarray([error is not None, sent is not None, len(sent or b"")])
        failed, is_some, size = multihost_utils.broadcast_one_to_all(facts)
        content = np.zeros(size, np.uint8) if not sent else np.frombuffer(sent, np.uint8)
        content = np.asarray(multihost_utils.broadcast_one_to_all(content)).tobytes()
        data = content if is_some else None
        if failed and error is None:
            error = ValueError(content.decode())
    if error is not None:
        raise error
    return data


def _sync(folder: Path) -> None:
    """Puts the names of a folder's files on the disk, where the system can."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _failed(values: PyTree) -> Int[np.ndarray, " failures"]:
    if not isinstance(values, diffrax.Solution):
        return np.flatnonzero(np.any(_not_finite(values), axis=0))
    bad = [np.asarray(values.result != diffrax.RESULTS.successful)]
    # diffrax fills what is left of the room for saved times and states with infinity.
    jtu.tree_map(lambda ts, ys: bad.extend(_not_finite(ys, np.isfinite(ts))), values.ts, values.ys)
    return np.flatnonzero(np.any(bad, axis=0))


def _not_finite(values: PyTree, where: Any = True) -> list[Bool[np.ndarray, " members"]]:
    """For each array of numbers, which members have one that is not finite there."""
    arrays: list[Any] = [a for a in jtu.tree_leaves(values) if isinstance(a, np.ndarray)]
    # Not by np.issubdtype: to NumPy bfloat16 is no number.
    arrays = [a for a in arrays if jnp.issubdtype(a.dtype, np.inexact)]
    places = [np.reshape(where, np.shape(where) + (1,) * (a.ndim - np.ndim(where))) for a in arrays]
    bad = [~np.isfinite(a) & place for a, place in zip(arrays, places, strict=True)]
    return [a.reshape(len(a), -1).any(axis=1) for a in bad]
