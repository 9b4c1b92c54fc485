"""Products of quaternions with vectors, and their exponentials."""

from functools import partial
from typing import Any, Literal

import jax
from jaxtyping import Array, Float

from .stumpff import stumpff_1_to_3_apart
from .vectors import Vector, cross, dot, pack

# The frame of a vector, and where the scalar part of a quaternion is stored.
Frame = Literal["body", "fixed"]
Layout = Literal["wxyz", "xyzw"]
_CHOICES = {"frame": ("body", "fixed"), "layout": ("wxyz", "xyzw")}


def check_choice(name: str, value: Any) -> None:
    """Raises `ValueError` if `value` is not a frame or a layout; `name` says which it should be."""
    choices = _CHOICES[name]
    if value not in choices:
        raise ValueError(f"{name} must be {choices[0]!r} or {choices[1]!r}, got {value!r}.")


def parts(q: Float[Array, "*batch 4"], layout: Layout) -> Vector:
    """The scalar part, then the three entries of the vector part."""
    return [q[..., k] for k in ((0, 1, 2, 3) if layout == "wxyz" else (3, 0, 1, 2))]


def from_parts(q: Vector, layout: Layout) -> Float[Array, "*batch 4"]:
    """The inverse of `parts`."""
    w, x, y, z = q
    return pack((w, x, y, z) if layout == "wxyz" else (x, y, z, w), axis=w.ndim)


def times(
    omega: Float[Array, "3"], q: Float[Array, "4"], frame: Frame, layout: Layout
) -> Float[Array, "4"]:
    """The product of `omega / 2` with q from the left ("fixed") or from the right ("body")."""
    return from_parts(product(half(omega), parts(q, layout), frame), layout)


# One trace for the many flows of a step.
@partial(jax.jit, static_argnames=("frame", "layout", "leads_back"))
def increment(
    omega: Float[Array, "3"], q: Float[Array, "4"], frame: Frame, layout: Layout, leads_back: bool
) -> Float[Array, "4"]:
    """The product of `exp(omega / 2)` with q, from the same side as in `times`, less q.

    Its rounding error is as small as it is. If `leads_back`, it also corrects the length of q
    towards 1.
    """
    a, p = half(omega), parts(q, layout)
    s = dot(a, a)
    exponential = stumpff_1_to_3_apart(s)
    return from_parts(exponential.turned(s, p, product(a, p, frame), leads_back), layout)


def half(omega: Any) -> Vector:
    return [omega[k] / 2 for k in range(3)]


def product(a: Vector, q: Vector, frame: str) -> Vector:
    """The quaternion `a q` in the fixed frame or `q a` in the body's, for a vector a."""
    w, *v = q
    across = cross(a, v) if frame == "fixed" else cross(v, a)
    return [-dot(a, v), *(w * x + y for x, y in zip(a, across, strict=True))]
