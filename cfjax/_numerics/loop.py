"""A loop as long as the program finds at run time, with derivatives of every order."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int, PyTree

T = TypeVar("T", bound=PyTree)


def loop(
    step: Callable[[Int[Array, ""], T], T],
    carry: T,
    length: Int[Array, ""],
    *,
    root: int,
    is_mostly_one: bool = False,
) -> T:
    """Replaces `carry` by `step(k, carry)` for k = 0, 1, .., length - 1; `length <= root^2`.

    `step` may close over traced values. Under `jax.vmap` the length must be one for the whole
    batch, as `max_over_batch` gives it.

    **Cost:** that of `length` steps. Derivatives go through a loop of `root` steps within one.
    Reverse mode keeps a carry for each of `2 root`, and computes every step twice again; a single
    step only once, if `is_mostly_one`, in a larger program.
    """
    # What is closed over must be seen by what follows.
    step = eqx.filter_closure_convert(step, length, carry)
    return _loop((step, carry), length=length, root=root, is_mostly_one=is_mostly_one)


@eqx.filter_custom_jvp
def _loop(moving: PyTree, *, length: Array, root: int, is_mostly_one: bool) -> PyTree:
    step, carry = moving

    def body(k: Array, carry: PyTree) -> PyTree:
        return step(jnp.asarray(k, length.dtype), carry)

    return lax.fori_loop(0, length, body, carry)


# A loop of unknown length has no reverse mode.
@_loop.def_jvp
def _(primals, tangents, *, length, root, is_mostly_one):
    def run(moving: PyTree) -> PyTree:
        step, carry = moving
        if not is_mostly_one:
            return _of_known_length(step, carry, length, root)
        return lax.cond(
            length == 1,
            lambda carry: step(jnp.zeros_like(length), carry),
            jax.checkpoint(lambda carry: _of_known_length(step, carry, length, root)),
            carry,
        )

    return eqx.filter_jvp(run, primals, tangents)


def _of_known_length(step: Callable, carry: PyTree, length: Array, root: int) -> PyTree:
    def part(carry: PyTree, k: Array, stride: int, run: Callable) -> PyTree:
        """`run` for those of the next `root` numbers, `stride` apart, that are in the loop."""
        # Without a checkpoint the branch not taken must hand out room for what the other saves.
        saved = jax.checkpoint(run)

        def body(carry: PyTree, k: Array) -> tuple[PyTree, None]:
            return lax.cond(k < length, saved, lambda carry, k: carry, carry, k), None

        ks = k + stride * jnp.arange(root, dtype=k.dtype)
        return lax.scan(body, carry, ks)[0]

    def one(carry: PyTree, k: Array) -> PyTree:
        return step(k, carry)

    return part(carry, jnp.zeros_like(length), root, lambda carry, k: part(carry, k, 1, one))
