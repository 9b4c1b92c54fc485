"""The solve of one chunk of a batch, compiled."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, PyTree

from .._arguments import captures_traced
from .fingerprint import environment, fingerprint

OUTSIDE = (
    "map_batch compiles and runs solve itself: call it outside of jax.jit, jax.vmap, jax.grad and "
    "loops of jax. For derivatives of a batch, or a batch within another program, use "
    "jax.vmap(solve)(members)."
)


class Structure(NamedTuple):
    """The structure of a pytree of arrays, with PRNG keys stored as arrays of numbers."""

    treedef: Any
    kinds: list[Any]  # for each leaf the implementation of the PRNG key, or None

    @classmethod
    def of(cls, tree: PyTree) -> tuple["Structure", list[Any]]:
        leaves, treedef = jtu.tree_flatten(tree)
        kinds = [jax.random.key_impl(a) if _is_key(a) else None for a in leaves]
        return cls(treedef, kinds), [jax.random.key_data(a) if _is_key(a) else a for a in leaves]

    def tree(self, leaves: Sequence[Any]) -> PyTree:
        return self.treedef.unflatten(
            a if kind is None else jax.random.wrap_key_data(a, impl=kind)
            for a, kind in zip(leaves, self.kinds, strict=True)
        )


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


class Program:
    """The compiled solve of one chunk."""

    def __init__(
        self,
        solve: Callable[[PyTree], PyTree],
        members: PyTree,
        chunk_size: int,
        mesh: Mesh | None,
    ):
        structure, leaves = Structure.of(members)
        self.chunk_size = chunk_size
        # An array on a device is small enough for the host; a memory map stays where it is.
        self.members = [np.asarray(a) if isinstance(a, jax.Array) else a for a in leaves]
        # In the byte order of this machine, whatever that of a file is.
        native = [a.dtype.newbyteorder("=") for a in leaves]
        self.dtypes = [jax.dtypes.canonicalize_dtype(dtype) for dtype in native]
        self.mesh, self.sharding = mesh, None
        if mesh is not None:
            self.sharding = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
        captured: dict[str, Any] = {}

        def solve_member(member: list[Array]) -> list[Array]:
            value = solve(structure.tree(member))
            arrays, captured["static"] = eqx.partition(value, eqx.is_array_like)
            captured["structure"], leaves = Structure.of(arrays)
            return [jnp.asarray(a) for a in leaves]

        shapes = [
            jax.ShapeDtypeStruct((chunk_size, *a.shape[1:]), dtype)
            for a, dtype in zip(leaves, self.dtypes, strict=True)
        ]
        solve_chunk = jax.jit(
            jax.vmap(solve_member), in_shardings=self.sharding, out_shardings=self.sharding
        )
        self.traced = solve_chunk.trace(shapes)
        if captures_traced(self.traced, shapes):
            raise TypeError(
                "solve must not capture values that are traced, and it captures one of the "
                f"function that calls map_batch. {OUTSIDE}"
            )
        self.lowered = self.traced.lower()
        self.outputs = jtu.tree_leaves(self.traced.out_info)
        self.static, self.structure = captured["static"], captured["structure"]

    @functools.cached_property
    def run(self) -> jax.stages.Compiled:
        # Lazily: nothing is compiled if all chunks are read from files.
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
