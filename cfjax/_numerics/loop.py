"""A loop whose length is computed at run time, with derivatives of every order."""

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
    mostly: int = 0,
) -> T:
    """Replaces `carry` by `step(k, carry)` for k = 0, 1, .., length - 1; `length <= root^2`.

    `step` may close over traced values. Under `jax.vmap` the length must be one for the whole
    batch, as `max_over_batch` gives it.

    **Cost:** that of `length` steps. Derivatives use two nested loops of `root` steps each. Reverse
    mode stores `2 root` carries, and computes every step twice more. If there are at most `mostly`
    steps, it stores their residuals instead, in a larger program.
    """
    # Derivatives need the closed-over values as arguments.
    step = eqx.filter_closure_convert(step, length, carry)
    return _loop((step, carry), length=length, root=root, mostly=mostly)


@eqx.filter_custom_jvp
def _loop(differentiable: PyTree, *, length: Array, root: int, mostly: int) -> PyTree:
    step, carry = differentiable

    def body(k: Array, carry: PyTree) -> PyTree:
        return step(jnp.asarray(k, length.dtype), carry)

    return lax.fori_loop(0, length, body, carry)


# A loop of unknown length has no reverse mode.
@_loop.def_jvp
def _(primals, tangents, *, length, root, mostly):
    def some(run: Callable, carry: PyTree, ks: Array) -> PyTree:
        """`run(carry, k)` for each k below the length."""

        def body(carry: PyTree, k: Array) -> tuple[PyTree, None]:
            return lax.cond(k < length, run, lambda carry, k: carry, carry, k), None

        return lax.scan(body, carry, ks)[0]

    def run(differentiable: PyTree) -> PyTree:
        step, carry = differentiable
        ks = jnp.arange(max(root, mostly), dtype=length.dtype)

        def one(carry: PyTree, k: Array) -> PyTree:
            return step(k, carry)

        # Without a checkpoint the branch not taken would return zeros for the residuals of this.
        @jax.checkpoint
        def part(carry: PyTree, k: Array) -> PyTree:
            return some(jax.checkpoint(one), carry, k + ks[:root])

        def whole(carry: PyTree) -> PyTree:
            return some(part, carry, root * ks[:root])

        if not mostly:
            return whole(carry)
        return lax.cond(
            length <= mostly,
            lambda carry: some(one, carry, ks[:mostly]),
            jax.checkpoint(whole),
            carry,
        )

    return eqx.filter_jvp(run, primals, tangents)
