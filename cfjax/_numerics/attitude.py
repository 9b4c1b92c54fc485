"""Attitudes as unit quaternions and as matrices.

A solver of linear spaces lets a quaternion drift off length 1. Its direction still determines one
rotation, so these functions divide by its length. A length far off 1 is an error, and so is a
matrix that is not orthogonal, which determines no rotation.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from .quaternion import Layout, check_choice, from_parts, parts
from .vectors import Vector, cross, dot, pack, smooth


def quaternion_to_matrix(
    q: Float[Array | np.ndarray, "*batch 4"], *, layout: Layout
) -> Float[Array, "*batch 3 3"]:
    """The rotation matrix of a quaternion: with `x_fixed = matrix @ x_body` for an attitude.

    It is the matrix of `q / |q|`, as a solver of linear spaces lets the length of q drift. So the
    derivative along q is zero. q and -q give the same matrix.

    **Arguments:** `q`, shape `(*batch, 4)`, float32 or float64; `layout`, `"wxyz"` or `"xyzw"`, how
    q is stored, where w is its scalar part.

    **Returns:** shape `(*batch, 3, 3)`.

    **Raises** `ValueError` for another shape or layout, `TypeError` for another dtype. A squared
    length that differs from 1 by more than 0.1 (q = 0 is such a case) is an error; in a compiled
    program, and so in a solve, it gives NaN. Divide such a q by its length.
    """
    (w, x, y, z), c = _quaternion(q, layout)
    rows = [
        [1 - c * (y * y + z * z), c * (x * y - w * z), c * (x * z + w * y)],
        [c * (x * y + w * z), 1 - c * (x * x + z * z), c * (y * z - w * x)],
        [c * (x * z - w * y), c * (y * z + w * x), 1 - c * (x * x + y * y)],
    ]
    return pack([pack(row, axis=w.ndim) for row in rows], axis=w.ndim)


def quaternion_rotate(
    q: Float[Array | np.ndarray, "*#batch 4"],
    x: Float[Array | np.ndarray, "*#batch 3"],
    *,
    layout: Layout,
) -> Float[Array, "*#batch 3"]:
    """A vector turned by a quaternion: `(0, x)` becomes `q (0, x) / q`.

    An attitude turns body coordinates into fixed ones, and its conjugate does the reverse. The
    length of x stays the same even if the length of q has drifted, as in `quaternion_to_matrix`.

    **Arguments:** `q`, shape `(*batch, 4)`, float32 or float64; `x`, shape `(*batch, 3)` and of the
    same dtype, with as many axes; an axis of 1 is broadcast. `layout` as in `quaternion_to_matrix`.

    **Returns:** shape `(*batch, 3)`.

    **Raises** as `quaternion_to_matrix`.
    """
    q, x = jnp.asarray(q), _checked_array("x", x, (3,))
    (w, *v), factor = _quaternion(q, layout)
    if x.dtype != q.dtype:
        raise TypeError(f"x must have the dtype of q, {q.dtype}, got {x.dtype}.")
    if x.ndim != q.ndim or any(
        m != n and 1 not in (m, n) for m, n in zip(q.shape[:-1], x.shape[:-1], strict=True)
    ):
        raise ValueError(
            f"The leading axes of q and x must agree or be 1, got q {q.shape} and x {x.shape}."
        )
    x0, x1, x2 = (x[..., k] for k in range(3))
    product = [factor * t for t in cross(v, (x0, x1, x2))]
    terms = zip((x0, x1, x2), product, cross(v, product), strict=True)
    return pack([a + (w * b + c) for a, b, c in terms], axis=w.ndim)


def quaternion_from_matrix(
    matrix: Float[Array | np.ndarray, "*batch 3 3"], *, layout: Layout
) -> Float[Array, "*batch 4"]:
    """The unit quaternion of a rotation matrix, with a scalar part that is not negative.

    Exact to rounding for every rotation. Its derivatives are exact too, for changes of the matrix
    that keep it orthogonal. Only at half turns, where the scalar part is zero and q jumps to -q,
    there is no derivative; cfjax returns the derivative from one side.

    **Arguments:** `matrix`, shape `(*batch, 3, 3)`, float32 or float64; `layout` as in
    `quaternion_to_matrix`.

    **Returns:** shape `(*batch, 4)`, of length 1 to rounding.

    **Raises** `ValueError` for another shape or layout, `TypeError` for another dtype. A matrix
    that is not orthogonal, by more than 1e-6 (float32: 3.5e-4) in an entry of `matrix.T @ matrix`,
    or has determinant -1 is an error; in a compiled program, and so in a solve, it gives NaN. A
    solver of linear spaces lets the matrix drift. The nearest rotation is then `u @ vh` for
    `u, _, vh = jnp.linalg.svd(matrix)`.

    Source: Shepperd, Quaternion from rotation matrix, J. Guid. Control 1 (1978),
    doi:10.2514/3.55767b.
    """
    check_choice("layout", layout)
    m = _checked_matrix(_checked_array("matrix", matrix, (3, 3)))
    (a, b, c), (d, e, f), (g, h, i) = ([m[..., j, k] for k in range(3)] for j in range(3))
    # The rows of 4 q q^T: each is q times four times one of its entries.
    candidates = [
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    ]
    # The row of the largest entry has length 2 at least: no cancellation, no division by zero.
    row, largest = candidates[0], candidates[0][0]
    for k in range(1, 4):
        candidate, entry = candidates[k], candidates[k][k]
        is_larger = entry > largest
        row = tuple(jnp.where(is_larger, x, y) for x, y in zip(candidate, row, strict=True))
        largest = jnp.where(is_larger, entry, largest)
    w, x, y, z = row
    length = jnp.sqrt(w * w + x * x + y * y + z * z)
    scale = jnp.where(w < 0, -1, 1).astype(m.dtype) / length
    return from_parts((w * scale, x * scale, y * scale, z * scale), layout)


@smooth
def _quaternion(q: Array | np.ndarray, layout: Layout) -> tuple[Vector, Array]:
    """The parts of q, and `2 / |q|^2`."""
    check_choice("layout", layout)
    w, x, y, z = parts(_checked_array("q", q, (4,)), layout)
    # Without a division, at which XLA breaks a step of a small system into several functions: it
    # took 2.4 times as long. The product of all `1 + d^(2^k)` is `1 / (1 - d)`. That of these four
    # is so to rounding, and its derivative to 2e-14.
    d = 1 - ((w * w + x * x) + (y * y + z * z))
    d2 = d * d
    d4 = d2 * d2
    inverse = (1 + d) * (1 + d2) * (1 + d4) * (1 + d4 * d4)
    is_near = jnp.abs(d) <= 0.1
    inverse = _error_unless(
        is_near,
        inverse,
        "q must have length 1, and is off by more than 0.1 in q @ q. Divide it by its length.",
    )
    return [w, x, y, z], 2 * inverse


def _checked_matrix(matrix: Array) -> Array:
    # Not jnp.matmul, whose default precision is less on GPU and TPU.
    gram = jnp.sum(matrix[..., :, None] * matrix[..., None, :], axis=-3)
    eye = jnp.broadcast_to(jnp.eye(3, dtype=matrix.dtype), matrix.shape)
    defect = jnp.max(jnp.abs(gram - eye), axis=(-2, -1))
    atol = max(1e-6, float(jnp.finfo(matrix.dtype).eps) ** 0.5)
    matrix = _error_unless(
        defect <= atol,
        matrix,
        "matrix must be orthogonal, and is off by more than "
        f"{atol:.2g} in an entry of matrix.T @ matrix. The nearest rotation is u @ vh for "
        "u, _, vh = jnp.linalg.svd(matrix).",
    )
    first, second, third = ([matrix[..., j, k] for k in range(3)] for j in range(3))
    return _error_unless(
        dot(first, cross(second, third)) > 0,
        matrix,
        "matrix must be a rotation, of determinant 1, and is a reflection, of determinant -1.",
    )


def _error_unless(is_valid: Bool[Array, "*batch"], x: Array, message: str) -> Array:
    if not isinstance(is_valid, Tracer):
        x = eqx.error_if(x, ~jnp.all(is_valid), message)
    # In a compiled program the error would call the host, which takes longer than a small step.
    shape = *is_valid.shape, *[1] * (x.ndim - is_valid.ndim)
    return jnp.where(is_valid.reshape(shape), x, jnp.nan)


def _checked_array(name: str, x: Array | np.ndarray, core: tuple[int, ...]) -> Array:
    array = jnp.asarray(x)
    if array.shape[-len(core) :] != core:
        batch = ", ".join(("*batch", *map(str, core)))
        raise ValueError(f"{name} must have shape {core} or ({batch}), got {array.shape}.")
    if array.dtype not in (jnp.float32, jnp.float64):
        raise TypeError(f"{name} must be float32 or float64, got {array.dtype}.")
    return array
