"""Heat conduction in a rod of variable diffusivity: a stiff semidiscrete system.

`u_t = (mu(x) u_x)_x` on [-1, 1] with `u(-1, t) = u(1, t) = 0`, `u(x, 0) = 1 - |x|` and
`mu(x) = 1 - x^2`, by central differences on N intervals of width dx. All quantities are
dimensionless. The state y has the N - 1 orthonormal sine coefficients of the grid values
u_1..u_{N-1}, so its 2-norm is theirs. The frozen field keeps the part with constant diffusivity,
which the sine transform diagonalises, and freezes the rest.

Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
Section 3.3, doi:10.1016/S0167-739X(02)00161-9.
"""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import (
    CF4,
    CF43,
    RKMK4,
    Affine,
    LieTerm,
    Richardson,
    SineTransform,
    WorkPrecision,
    work_precision,
)

t0, t1 = 0.0, 0.5


class Diffusivity(NamedTuple):
    """What the fields take as `args`."""

    mu: Float[Array | np.ndarray, " N"]  # at the midpoints of the intervals
    constant: Float[Array | np.ndarray, ""]  # the part that the flows solve exactly


def diffusivity(num_intervals: int = 100) -> Diffusivity:
    """The paper's `mu(x) = 1 - x^2`, and its mean."""
    mu = 1 - _midpoints(num_intervals) ** 2
    return Diffusivity(mu, np.asarray(np.mean(mu)))


def y0(num_intervals: int = 100) -> Float[np.ndarray, " n"]:
    """The sine coefficients of the initial temperature `1 - |x|`."""
    # Not at import: few who import the package need it.
    from scipy.fft import dst

    return np.asarray(dst(1 - np.abs(_points(num_intervals)), type=1, norm="ortho"))


def field(t: Any, y: Float[Array, " n"], args: Diffusivity) -> Affine:
    """The frozen field at sine coefficients `y`. Costs two sine transforms."""
    n = len(y)
    k = np.arange(1, n + 1)
    second_difference = -(((n + 1) * np.sin(k * np.pi / (2 * (n + 1)))) ** 2)
    mu, constant = jnp.asarray(args.mu), jnp.asarray(args.constant)
    b = _operator(mu - constant, to_grid(y))
    return Affine(1.0, from_grid(b), constant * jnp.asarray(second_difference, y.dtype))


def grid_field(t: Any, u: Float[Array, " n"], args: Diffusivity) -> Float[Array, " n"]:
    """The velocity of the grid values `u`, for methods of a linear space.

    As a translation: with it CF4 is the classical Runge-Kutta method.
    """
    return _operator(jnp.asarray(args.mu), u)


def to_grid(y: Float[Array, " n"]) -> Float[Array, " n"]:
    """The grid values of sine coefficients."""
    return SineTransform().inverse(y)


def from_grid(u: Float[Array, " n"]) -> Float[Array, " n"]:
    """The sine coefficients of grid values."""
    return SineTransform().forward(u)


def reference(
    t: float | Float[Array | np.ndarray, "*times"], mu: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "*times n"]:
    """The exact grid values of the semidiscrete system at times `t`, in NumPy's float64.

    By the eigenvectors of its symmetric matrix. The error is that of the eigenvalues, a few units
    of rounding of the largest, times t.
    """
    from scipy.linalg import eigh_tridiagonal

    scale = (len(mu) / 2) ** 2
    rates, vectors = eigh_tridiagonal(-scale * (mu[:-1] + mu[1:]), scale * mu[1:-1])
    modes = vectors.T @ (1 - np.abs(_points(len(mu))))
    return (np.exp(np.asarray(t, float)[..., None] * rates) * modes) @ vectors.T


def chart(**options: Any) -> WorkPrecision:
    """Heat conduction, N = 100, tolerances 1e-2 to 1e-7. CF4, RKMK4 and RK4 double steps."""
    args = diffusivity()

    def velocity(t, y, args):
        return from_grid(grid_field(t, to_grid(y), args))

    return work_precision(
        LieTerm(field),
        t0,
        t1,
        y0(),
        args,
        methods={
            "CF4": Richardson(CF4()),
            "CF43": CF43(),
            "RKMK4": Richardson(RKMK4()),
            # On translations CF4 is the classical Runge-Kutta method.
            "RK4": (LieTerm(velocity), Richardson(CF4())),
            "Tsit5": (diffrax.ODETerm(velocity), diffrax.Tsit5()),
            "Kvaerno5": (diffrax.ODETerm(velocity), diffrax.Kvaerno5()),
        },
        reference=np.asarray(from_grid(jnp.asarray(reference(t1, np.asarray(args.mu))))),
        tolerances=[10.0**-k for k in range(2, 8)],
        **options,
    )


def _points(num_intervals: int) -> Float[np.ndarray, " n"]:
    return 2 * np.arange(1, num_intervals) / num_intervals - 1


def _midpoints(num_intervals: int) -> Float[np.ndarray, " N"]:
    return (2 * np.arange(num_intervals) + 1) / num_intervals - 1


def _operator(mu: Float[Array, " N"], u: Float[Array, " n"]) -> Float[Array, " n"]:
    """Central differences of the flux `mu u_x`."""
    flux = mu * jnp.diff(jnp.pad(u, 1))
    return (len(mu) / 2) ** 2 * jnp.diff(flux)
