"""Attitudes as unit quaternions and as matrices."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._xla import is_rewritten, pack
from .quaternion import Order, check_choice, from_parts, parts


def quaternion_to_matrix(
    q: Float[Array | np.ndarray, "*batch 4"], *, order: Order
) -> Float[Array, "*batch 3 3"]:
    """The rotation matrix of a unit quaternion: with `x_fixed = matrix @ x_body` for an attitude.

    It has the products of two entries of q, so q and -q give one matrix.

    **Arguments:** `q`, shape `(*batch, 4)`, float32 or float64; `order`, `"wxyz"` or `"xyzw"`, how
    q is stored, where w is its scalar part.

    **Returns:** shape `(*batch, 3, 3)`.

    **Raises** `ValueError` for another shape or order, `TypeError` for another dtype. A length that
    is off 1 by more than 1e-6 (float32: 3.5e-4) is an error; within a step of a small system, where
    the solve has checked its start, it is not looked at.
    """
    w, x, y, z = parts(_checked_quaternion(q, order), order)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return pack([pack(row, axis=w.ndim) for row in rows], axis=w.ndim)


def quaternion_rotate(
    q: Float[Array | np.ndarray, "*#batch 4"],
    x: Float[Array | np.ndarray, "*#batch 3"],
    *,
    order: Order,
) -> Float[Array, "*#batch 3"]:
    """A vector turned by a unit quaternion: `(0, x)` becomes `q (0, x) / q`.

    An attitude turns body coordinates into fixed ones, and its conjugate does the reverse.

    **Arguments:** `q`, shape `(*batch, 4)`, float32 or float64; `x`, shape `(*batch, 3)` and of the
    same dtype, with as many axes; an axis of 1 is broadcast. `order` as in `quaternion_to_matrix`.

    **Returns:** shape `(*batch, 3)`.

    **Raises** as `quaternion_to_matrix`.
    """
    q, x = _checked_quaternion(q, order), _array("x", x, (3,))
    if x.dtype != q.dtype:
        raise TypeError(f"x must have the dtype of q, {q.dtype}, got {x.dtype}.")
    fits = x.ndim == q.ndim and all(
        1 in pair or pair[0] == pair[1] for pair in zip(q.shape[:-1], x.shape[:-1], strict=True)
    )
    if not fits:
        raise ValueError(
            f"The leading axes of q and x must agree or be 1, got q {q.shape} and x {x.shape}."
        )
    w, *v = parts(q, order)
    x0, x1, x2 = (x[..., k] for k in range(3))
    twice = [2 * t for t in _cross(v, (x0, x1, x2))]
    turned = zip((x0, x1, x2), twice, _cross(v, twice), strict=True)
    return pack([a + (w * b + c) for a, b, c in turned], axis=w.ndim, sums=True)


def quaternion_from_matrix(
    matrix: Float[Array | np.ndarray, "*batch 3 3"], *, order: Order
) -> Float[Array, "*batch 4"]:
    """The unit quaternion of a rotation matrix, with a scalar part that is not negative.

    Exact to rounding for every rotation. Its derivatives are exact too, for changes of the matrix
    that keep it orthogonal. Only at half turns, where the scalar part is zero and q jumps to -q, is
    there none; what is returned there is that of one side.

    **Arguments:** `matrix`, shape `(*batch, 3, 3)`, float32 or float64; `order` as in
    `quaternion_to_matrix`.

    **Returns:** shape `(*batch, 4)`, of length 1 to rounding.

    **Raises** `ValueError` for another shape or order, `TypeError` for another dtype. A matrix that
    is not orthogonal, by more than 1e-6 (float32: 3.5e-4) in an entry of
    `matrix.T @ matrix`, or has determinant -1 is an error; not so within a step of a small system.

    Source: Shepperd, Quaternion from rotation matrix, J. Guid. Control 1 (1978),
    doi:10.2514/3.55767b.
    """
    check_choice("order", order)
    m = _checked_matrix(_array("matrix", matrix, (3, 3)))
    (a, b, c), (d, e, f), (g, h, i) = ([m[..., j, k] for k in range(3)] for j in range(3))
    # The rows of 4 q q^T: each is q times four times one of its entries.
    candidates = [
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    ]
    # That of the largest entry, of length 2 at least: nothing cancels, nothing is divided by zero.
    row, size = candidates[0], candidates[0][0]
    for k in range(1, 4):
        other, its_size = candidates[k], candidates[k][k]
        is_larger = its_size > size
        row = tuple(jnp.where(is_larger, x, y) for x, y in zip(other, row, strict=True))
        size = jnp.where(is_larger, its_size, size)
    w, x, y, z = row
    length = jnp.sqrt(w * w + x * x + y * y + z * z)
    scale = jnp.where(w < 0, -1, 1).astype(m.dtype) / length
    return from_parts((w * scale, x * scale, y * scale, z * scale), order)


def _cross(a: Sequence[Array], b: Sequence[Array]) -> list[Array]:
    return [a[k - 2] * b[k - 1] - a[k - 1] * b[k - 2] for k in range(3)]


def _checked_quaternion(q: Array | np.ndarray, order: Order) -> Array:
    check_choice("order", order)
    q = _array("q", q, (4,))
    off = jnp.abs(jnp.sum(q * q, axis=-1) - 1)
    least = _tolerance(q)
    return _error_unless(
        off <= 2 * least, q, f"q must have length 1, and is off by more than {least:.2g}."
    )


def _checked_matrix(matrix: Array) -> Array:
    # Written out, as products of matrices may come in less than full precision.
    square = jnp.sum(matrix[..., :, None] * matrix[..., None, :], axis=-3)
    one = jnp.broadcast_to(jnp.eye(3, dtype=matrix.dtype), matrix.shape)
    off = jnp.max(jnp.abs(square - one), axis=(-2, -1))
    least = _tolerance(matrix)
    matrix = _error_unless(
        off <= least,
        matrix,
        "matrix must be orthogonal, and is off by more than "
        f"{least:.2g} in an entry of matrix.T @ matrix.",
    )
    (a, b, c), *others = ([matrix[..., j, k] for k in range(3)] for j in range(3))
    x, y, z = _cross(*others)
    return _error_unless(
        a * x + b * y + c * z > 0,
        matrix,
        "matrix must be a rotation, of determinant 1, and is a reflection, of determinant -1.",
    )


def _tolerance(x: Array) -> float:
    return max(1e-6, float(jnp.finfo(x.dtype).eps) ** 0.5)


def _error_unless(holds: Bool[Array, "*batch"], x: Array, message: str) -> Array:
    # A step of a small system would feel the check more than all else, and the flow keeps lengths.
    return x if is_rewritten() else eqx.error_if(x, ~jnp.all(holds), message)


def _array(name: str, x: Array | np.ndarray, core: tuple[int, ...]) -> Array:
    array = jnp.asarray(x)
    if array.shape[-len(core) :] != core:
        batch = ", ".join(("*batch", *map(str, core)))
        raise ValueError(f"{name} must have shape {core} or ({batch}), got {array.shape}.")
    if array.dtype not in (jnp.float32, jnp.float64):
        raise TypeError(f"{name} must be float32 or float64, got {array.dtype}.")
    return array
