"""Finished chunks of a batch, on disk."""

import contextlib
import hashlib
import json
import math
import os
import secrets
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np
from jax.experimental import multihost_utils

from .fingerprint import digest
from .program import Program


class Store:
    """Finished chunks as files, and a file that describes them and the batch.

    The file of a chunk has a digest of the computation and the members, then a digest of all else
    in the file, to detect damage, then the bytes of the results.
    """

    FORMAT = "cfjax.map_batch 1"
    START = 2 * hashlib.sha256().digest_size

    def __init__(self, folder: Path, program: Program, size: int):
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
        _on_first_process(self._open)

    def _arrays(self, program: Program) -> list[dict[str, Any]]:
        """Where each array of a chunk is in its file."""
        structure, offset, arrays = program.structure, self.START, []
        tree = structure.treedef.unflatten(self.outputs)
        paths = [jtu.keystr(path) for path, _ in jtu.tree_leaves_with_path(tree)]
        for path, kind, a in zip(paths, structure.kinds, self.outputs, strict=True):
            # With the byte order, for dtypes that NumPy knows.
            dtype = a.dtype.str if a.dtype.isbuiltin == 1 else a.dtype.name
            arrays.append({"path": path, "dtype": dtype, "shape": a.shape[1:], "offset": offset})
            if kind is not None:
                arrays[-1]["key"] = str(kind)
            offset += math.prod(a.shape) * a.dtype.itemsize
        return arrays

    def _open(self) -> None:
        """Makes the folder, or checks that its contents are of this batch."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise type(error)(
                f"folder must be a folder, or a path where one can be made, got "
                f"{str(self.folder)!r}: {error}"
            ) from None
        # Files of processes that are running, or that were killed.
        self.partial_files = list(self.folder.glob("*.part"))
        path, text = self.folder / "batch.json", json.dumps(self.description, indent=2).encode()
        # In this order: another process writes the description before its first chunk.
        has_chunks = any(self.folder.glob("chunk_*.bin"))
        stored = self._content(path)
        if stored == text:
            return
        if has_chunks:
            raise ValueError(self._conflict(self._differences(stored)))
        self._write(path, text)

    def _content(self, path: Path) -> bytes | None:
        """The content of a file: None if there is no file, empty if it cannot be read."""
        if path.is_dir():
            raise IsADirectoryError(
                f"folder must hold files, but in {str(self.folder)!r} {path.name} is a folder. "
                "Remove it, or give another folder."
            )
        for _ in range(2):  # On some file systems reading fails while a process replaces the file.
            try:
                return path.read_bytes()
            except FileNotFoundError:
                return None
            except OSError:
                continue
        return b""

    def _differences(self, text: bytes | None) -> str:
        if text is None:
            return "chunks, but no batch.json"
        try:
            stored = json.loads(text)
            names = [name for name in self.description if name not in ("computation", "arrays")]
            differences = [
                f"{name} {stored[name]!r} where {self.description[name]!r} is expected"
                for name in names
                if stored[name] != self.description[name]
            ]
        except (ValueError, TypeError, KeyError):
            return "a batch.json that is damaged"
        # Another chunk size alone changes the computation, so that is checked last.
        return ", ".join(differences) or (
            "the results of another computation: another solve, another constant that it captures, "
            "or another setting of jax"
        )

    def _conflict(self, contents: str) -> str:
        return (
            f"folder must be empty or hold this batch, but {str(self.folder)!r} holds {contents}. "
            "It is left as it is. Make the call that it was made with, give another folder, or "
            "remove this one."
        )

    def read(self, number: int, inputs: Sequence[np.ndarray]) -> list[np.ndarray] | None:
        """The outputs of a chunk, or None where there is no whole file.

        **Raises** `ValueError` for a whole file of other inputs.
        """
        data = _on_first_process(lambda: self._read(number, inputs))
        if data is None:
            return None
        arrays, offset = [], 0
        for a in self.outputs:
            arrays.append(np.ndarray(a.shape, a.dtype, data, offset))
            offset += arrays[-1].nbytes
        return arrays

    def _read(self, number: int, inputs: Sequence[np.ndarray]) -> bytes | None:
        path = self._path(number)
        content = self._content(path)
        if content is None:
            return None
        header, data = content[: self.START], content[self.START :]
        owner, checksum = header[: self.START // 2], header[self.START // 2 :]
        if checksum != digest(owner, data):
            warnings.warn(f"{path} is damaged, and is computed again.", stacklevel=6)
            return None
        if owner != digest(self.fingerprint, *inputs):
            raise ValueError(self._conflict(f"the results of other members in {path.name}"))
        return data

    def write(
        self, number: int, inputs: Sequence[np.ndarray], outputs: Sequence[np.ndarray]
    ) -> None:
        if jax.process_index() == 0:
            data = b"".join(a.tobytes() for a in outputs)
            owner = digest(self.fingerprint, *inputs)
            self._write(self._path(number), owner + digest(owner, data) + data)

    def _write(self, path: Path, content: bytes) -> None:
        # A name of its own: another process may write the same file at the same time.
        partial = path.with_suffix(f".{secrets.token_hex(8)}.part")
        try:
            with open(partial, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            # The file gets its name when it is complete and on the disk.
            try:
                os.replace(partial, path)
            except OSError:
                # Another process has written it and removed this part, or reads it on Windows.
                if not path.is_file():
                    raise
        finally:
            partial.unlink(missing_ok=True)
        # The names of the folder's files are put on the disk, where the system can.
        with contextlib.suppress(OSError):
            descriptor = os.open(self.folder, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        # The chunk is written, so partial files of it are needed no more.
        for leftover in self.partial_files:
            if leftover.name.startswith(f"{path.stem}."):
                with contextlib.suppress(OSError):
                    leftover.unlink()

    def _path(self, number: int) -> Path:
        return self.folder / f"chunk_{number:06}.bin"


def _on_first_process(fun: Callable[[], bytes | None]) -> bytes | None:
    """The result of `fun` in process 0 for all processes; its error is raised in all of them."""
    data, error = None, None
    if jax.process_index() == 0:
        try:
            data = fun()
        except (ValueError, OSError) as raised:
            error = raised
    if jax.process_count() > 1:
        # All processes must return, or all must raise.
        sent = data if error is None else str(error).encode()
        header = np.asarray([error is not None, sent is not None, len(sent or b"")])
        failed, has_data, size = multihost_utils.broadcast_one_to_all(header)
        content = np.zeros(size, np.uint8) if not sent else np.frombuffer(sent, np.uint8)
        content = np.asarray(multihost_utils.broadcast_one_to_all(content)).tobytes()
        data = content if has_data else None
        if failed and error is None:
            error = ValueError(content.decode())
    if error is not None:
        raise error
    return data
