"""Products of quaternions with vectors, and their exponentials."""

from functools import partial
from typing import Any, Literal

import jax
from jax import lax
from jaxtyping import Array, Float

from .stumpff import stumpff_1_to_3_apart
from .vectors import Vector, cross, dot, pack

# In which frame a vector is given, and where the scalar part of a quaternion is stored.
Frame = Literal["body", "fixed"]
Order = Literal["wxyz", "xyzw"]
_CHOICES = {"frame": ("body", "fixed"), "order": ("wxyz", "xyzw")}


def check_choice(name: str, value: Any) -> None:
    """Raises `ValueError` if `value` is not a frame or an order; `name` says which it should be."""
    choices = _CHOICES[name]
    if value not in choices:
        raise ValueError(f"{name} must be {choices[0]!r} or {choices[1]!r}, got {value!r}.")


def parts(q: Float[Array, "*batch 4"], order: Order) -> Vector:
    """The scalar part and the three others."""
    return [q[..., k] for k in ((0, 1, 2, 3) if order == "wxyz" else (3, 0, 1, 2))]


def from_parts(q: Vector, order: Order) -> Float[Array, "*batch 4"]:
    """The reverse of `parts`."""
    w, x, y, z = q
    return pack((w, x, y, z) if order == "wxyz" else (x, y, z, w), axis=w.ndim, sums=True)


def times(
    omega: Float[Array, "3"], q: Float[Array, "4"], frame: Frame, order: Order
) -> Float[Array, "4"]:
    """The product of `omega / 2` with q from the left ("fixed") or from the right ("body")."""
    return from_parts(product(half(omega), parts(q, order), frame), order)


@partial(jax.jit, static_argnames=("frame", "order"))  # One trace for the many flows of a step.
def turn(
    omega: Float[Array, "3"], q: Float[Array, "4"], frame: Frame, order: Order
) -> Float[Array, "4"]:
    """The product of `exp(omega / 2)` with q, from the side that `times` says."""
    p = parts(q, order)
    return q + from_parts(_change(half(omega), p, frame), order)


@partial(jax.jit, static_argnames=("frame", "order"))
def increment(
    omega: Float[Array, "3"], q: Float[Array, "4"], frame: Frame, order: Order
) -> Float[Array, "4"]:
    """`turn(omega, q) - q`, with a rounding as small as it is, for a q of length 1 to rounding.

    Roundings that are the same in every step would make the length drift with the number of steps.
    So it leads back: it takes the part `1 - cos(|omega| / 2)` off what the length is off 1.
    """
    p = parts(q, order)
    w, x, y, z = p
    off = lax.stop_gradient((w * w + x * x) + (y * y + z * z) - 1)
    return from_parts(_change(half(omega), p, frame, off / 2), order)


def _change(
    a: Vector, p: Vector, frame: Frame, correction: float | Float[Array, ""] = 0.0
) -> Vector:
    """`exp(a) - 1` times a quaternion, less `correction * (1 - cos|a|)` times it.

    For the linear map u, multiplication by a, is `u^2 = -s` with `s = |a|^2`, and so
    `exp(u) = 1 + c_1 u - s c_2` with Stumpff functions of s.
    """
    s = dot(a, a)
    near, d1, d2, _ = stumpff_1_to_3_apart(s)
    d2 = d2 + correction * (near / 2 + d2)
    return [
        near * (u - s / 2 * x) + (d1 * u - (s * d2) * x)
        for u, x in zip(product(a, p, frame), p, strict=True)
    ]


def half(omega: Any) -> Vector:
    return [omega[k] / 2 for k in range(3)]


def product(a: Vector, q: Vector, frame: str) -> Vector:
    """The quaternion `a q` in the fixed frame or `q a` in the body's, for a vector a."""
    w, *v = q
    across = cross(a, v) if frame == "fixed" else cross(v, a)
    return [-dot(a, v), *(w * x + y for x, y in zip(a, across, strict=True))]
