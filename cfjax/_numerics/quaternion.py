"""Products of quaternions with vectors, and their exponentials."""

from functools import partial
from typing import Any, Literal

import jax
from jax import lax
from jaxtyping import Array, Float

from .stumpff import stumpff_1_2_apart
from .vectors import cross, dot, pack

# In which frame a vector is given, and where the scalar part of a quaternion is stored.
Frame = Literal["body", "fixed"]
Order = Literal["wxyz", "xyzw"]
_Parts = tuple[Float[Array, "*batch"], ...]
_CHOICES = {"frame": ("body", "fixed"), "order": ("wxyz", "xyzw")}


def check_choice(name: str, value: Any) -> None:
    """Raises `ValueError` if `value` is not a frame or an order; `name` says which it should be."""
    choices = _CHOICES[name]
    if value not in choices:
        raise ValueError(f"{name} must be {choices[0]!r} or {choices[1]!r}, got {value!r}.")


def parts(q: Float[Array, "*batch 4"], order: Order) -> _Parts:
    """The scalar part and the three others."""
    w, x, y, z = (q[..., k] for k in ((0, 1, 2, 3) if order == "wxyz" else (3, 0, 1, 2)))
    return w, x, y, z


def from_parts(q: _Parts, order: Order) -> Float[Array, "*batch 4"]:
    """The reverse of `parts`."""
    w, x, y, z = q
    return pack((w, x, y, z) if order == "wxyz" else (x, y, z, w), axis=w.ndim, sums=True)


def times(
    omega: Float[Array, "3"], q: Float[Array, "4"], frame: Frame, order: Order
) -> Float[Array, "4"]:
    """The product of `omega / 2` with q from the left ("fixed") or from the right ("body")."""
    return from_parts(_times(_half(omega), parts(q, order), frame), order)


@partial(jax.jit, static_argnames=("frame", "order"))  # One trace for the many flows of a step.
def turn(
    omega: Float[Array, "3"], q: Float[Array, "4"], frame: Frame, order: Order
) -> Float[Array, "4"]:
    """The product of `exp(omega / 2)` with q, from the side that `times` says."""
    p = parts(q, order)
    return q + from_parts(_change(_half(omega), p, frame), order)


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
    return from_parts(_change(_half(omega), p, frame, off / 2), order)


def _change(
    a: _Parts, p: _Parts, frame: Frame, correction: float | Float[Array, ""] = 0.0
) -> _Parts:
    """`exp(a) - 1` times a quaternion, less `correction * (1 - cos|a|)` times it.

    For the linear map u, multiplication by a, is `u^2 = -s` with `s = |a|^2`, and so
    `exp(u) = 1 + c_1 u - s c_2` with Stumpff functions of s. As in `rotate.py` what these are at
    zero is kept apart.
    """
    s = dot(a, a)
    near, d1, d2 = stumpff_1_2_apart(s)
    d2 = d2 + correction * (near / 2 + d2)
    return tuple(
        near * (u - s / 2 * x) + (d1 * u - (s * d2) * x)
        for u, x in zip(_times(a, p, frame), p, strict=True)
    )


def _half(omega: Array) -> _Parts:
    return omega[0] / 2, omega[1] / 2, omega[2] / 2


def _times(a: _Parts, q: _Parts, frame: Frame) -> _Parts:
    w, *v = q
    across = cross(a, v) if frame == "fixed" else cross(v, a)
    return (-dot(a, v), *(w * x + y for x, y in zip(a, across, strict=True)))
