"""Euler's equations of an ideal fluid on the sphere, with vorticity as a Hermitian matrix.

On the sphere `w_t = -{psi, w}`, where w is the vorticity and psi the stream function, with
`laplacian psi = w`. Here spin matrices S_1, S_2, S_3 of size N replace the coordinates, matrices W
and P replace w and psi, and a commutator replaces the bracket:

`W' = 1j / h (P W - W P)`, with `-sum_k [S_k, [S_k, P]] = W` and `h = 2 / sqrt(N^2 - 1)`.

The Laplacian has the right eigenvalues -l (l + 1) for l = 1 .. N - 1, and its eigenvectors are
matrices for the spherical harmonics. The coordinates themselves are `h S_k`. The radius is one, and
energies are means over the sphere. All quantities are dimensionless.

The frozen field is a conjugation by a unitary matrix. So all N eigenvalues of W are kept to
rounding. They stand for the areas on which the vorticity has each value. Energy and angular
momentum are kept to the order of the method.

Source: Hoppe & Yau, Some properties of matrix harmonics on S^2, Commun. Math. Phys. 195 (1998),
67-77; Zeitlin, Self-consistent finite-mode approximations for the hydrodynamics of an
incompressible fluid on nonrotating and rotating spheres, Phys. Rev. Lett. 93 (2004),
doi:10.1103/PhysRevLett.93.264501; Modin & Viviani, A Casimir preserving scheme for long-time
simulation of spherical ideal hydrodynamics, J. Fluid Mech. 884 (2020), A22.
"""

from functools import lru_cache
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

import cfjax

from . import _figures as figures
from ._scene import PROJECTED, by_dop853, by_name, in_plain_space, solve

t0, t1 = 0.0, 4.0
# In steps as long as those of the picture. Over shorter times than a million its energy is better
# than that of ImplicitMidpoint.
solver = cfjax.CF4()


def y0(n: int = 32, seed: int = 0, degree: int = 6) -> Complex[np.ndarray, "N N"]:
    """Random vorticity of mean square one, with harmonics up to `degree`: the same for every n."""
    real, imaginary = np.random.default_rng(seed).normal(size=(2, degree + 1, degree + 1))
    # Coefficients of order 0 are real, and a fluid has no vorticity on the whole.
    some = np.where(np.arange(degree + 1)[:, None] == 0, real / 2**0.5, (real + 1j * imaginary) / 2)
    coefficients = np.zeros((n, n), complex)
    coefficients[: degree + 1, 1 : degree + 1] = np.triu(some)[:, 1:]
    y = from_harmonics(coefficients)
    return y / np.sqrt(np.sum(np.abs(y) ** 2) / n)


def spins(n: int) -> Complex[np.ndarray, "3 N N"]:
    """The spin matrices of size `n`, with the third one diagonal and falling."""
    i = np.arange(n - 1)
    raising = np.diag(np.sqrt((i + 1.0) * (n - 1 - i)), 1)
    third = np.diag((n - 1) / 2 - np.arange(n))
    return np.stack([(raising + raising.T) / 2, (raising - raising.T) / 2j, third + 0j])


def inverse_laplacian(n: int) -> Float[np.ndarray, "N N N"]:
    """What the fields take as `args`: the inverse for each diagonal of a matrix.

    Element k acts on the k-th diagonal above the main one and the (n - k)-th below it, which
    together have n entries. Takes 8 n^3 bytes.
    """
    inverse = np.zeros((n, n, n))
    for m in range(n):
        values = np.arange(m, n) * np.arange(m + 1.0, n + 1)
        # A constant has no stream function.
        factors = np.where(values > 0, -1 / np.maximum(values, 1), 0)
        block = (_harmonics(n, m) * factors) @ _harmonics(n, m).T
        inverse[m, : n - m, : n - m] = block
        if m > 0:
            inverse[n - m, m:, m:] = block
    return inverse


def stream_function(
    y: Complex[Array | np.ndarray, "N N"], args: Float[Array | np.ndarray, "N N N"]
) -> Complex[Array, "N N"]:
    """The matrix P of vorticity `y`."""
    i, k = np.indices(y.shape)
    # As rows: the k-th holds the diagonals k and k - n.
    rows = jnp.asarray(y)[k, (i + k) % len(y)]
    parts = jnp.stack([jnp.real(rows), jnp.imag(rows)], axis=-1)
    parts = jnp.einsum("kij,kjc->kic", jnp.asarray(args), parts, precision="highest")
    rows = lax.complex(parts[..., 0], parts[..., 1])
    return rows[(k - i) % len(y), i]


def field(
    t: Any, y: Complex[Array, "N N"], args: Float[Array | np.ndarray, "N N N"]
) -> cfjax.Congruence:
    """The frozen field, with `args = inverse_laplacian(N)`."""
    # As it is skew-Hermitian, this is a conjugation that keeps matrices Hermitian to the last bit.
    return cfjax.Congruence((0.5j * (len(y) ** 2 - 1) ** 0.5) * stream_function(y, args))


def velocity(
    t: Any, y: Complex[Array, "N N"], args: Float[Array | np.ndarray, "N N N"]
) -> Complex[Array, "N N"]:
    """The same field in plain space, where methods lose the eigenvalues."""
    return cfjax.tangent(field(t, y, args), y)


def energy(
    y: Complex[Array | np.ndarray, "N N"], args: Float[Array | np.ndarray, "N N N"]
) -> Float[Array, ""]:
    """The kinetic energy, half the mean square of the fluid's velocity."""
    return -jnp.sum(jnp.real(jnp.conj(stream_function(y, args)) * y)) / (2 * len(y))


def angular_momentum(y: Complex[Array | np.ndarray, "N N"]) -> Float[Array, "3"]:
    """The means of the coordinates times the vorticity."""
    n = len(y)
    coordinates = jnp.asarray(2 / (n**2 - 1) ** 0.5 * spins(n), y.dtype)
    return jnp.sum(jnp.real(jnp.conj(coordinates) * jnp.asarray(y)[None]), axis=(1, 2)) / n


def rossby_haurwitz(
    t: float, n: int = 32, degree: int = 4, rotation: float = 1.0
) -> Complex[np.ndarray, "N N"]:
    """An exact solution: a pattern of harmonics of one degree, on a fluid that turns as a whole.

    With the angular velocity `rotation` of the fluid, the pattern turns about the third axis with
    that times `1 - 2 / (degree (degree + 1))`. At 0 it is steady.
    """
    rate = rotation * (1 - 2 / (degree * (degree + 1)))
    coefficients = np.zeros((n, n), complex)
    order = np.arange(degree + 1)
    coefficients[: degree + 1, degree] = np.exp(1j * order * (order - rate * t))
    whole = 4 * rotation / (n**2 - 1) ** 0.5 * spins(n)[2]
    return from_harmonics(coefficients) + whole


def from_harmonics(coefficients: Complex[np.ndarray, "N N"]) -> Complex[np.ndarray, "N N"]:
    """The matrix of vorticity with these spherical harmonics, in element [order, degree].

    The vorticity is the sum over degrees l of `c[0, l] Y_l0` and twice the real parts of
    `c[m, l] Y_lm`, with orthonormal Y that have positive real parts near the north pole.
    """
    n = len(coefficients)
    y = np.zeros((n, n), complex)
    for m in range(n):
        diagonal = _harmonics(n, m) @ coefficients[m, m:] * (n / (4 * np.pi)) ** 0.5
        y += np.diag(diagonal, m)
        if m > 0:
            y += np.diag(diagonal.conj(), -m)
    return y


def to_harmonics(y: Complex[np.ndarray, "N N"]) -> Complex[np.ndarray, "N N"]:
    """The spherical harmonics of a matrix of vorticity. The inverse of `from_harmonics`."""
    n = len(y)
    coefficients = np.zeros((n, n), complex)
    for m in range(n):
        coefficients[m, m:] = np.diagonal(y, m) @ _harmonics(n, m) * (4 * np.pi / n) ** 0.5
    return coefficients


def on_sphere(
    y: Complex[np.ndarray, "N N"],
    latitude: Float[np.ndarray, " rows"],
    longitude: Float[np.ndarray, " columns"],
) -> Float[np.ndarray, "rows columns"]:
    """The vorticity at these latitudes and longitudes, in radians."""
    n, height = len(y), np.sin(latitude)
    coefficients = to_harmonics(y)
    total = np.zeros((len(latitude), len(longitude)))
    # Order by order, the harmonics on a meridian from the lowest degree upwards.
    lowest = np.full_like(height, (4 * np.pi) ** -0.5)
    for m in range(n):
        degrees = np.arange(m, n)
        scale = np.sqrt((degrees**2 - m**2) / (4 * degrees**2 - 1))
        meridian = [np.zeros_like(height), lowest]
        for k in range(1, n - m):
            meridian.append((height * meridian[-1] - scale[k - 1] * meridian[-2]) / scale[k])
        column = coefficients[m, m:] @ np.array(meridian[1:])
        total += (1 + (m > 0)) * np.real(np.multiply.outer(column, np.exp(1j * m * longitude)))
        lowest = lowest * np.cos(latitude) * np.sqrt((2 * m + 3) / (2 * m + 2))
    return total


def reference(t: float, start: Complex[np.ndarray, "N N"]) -> Complex[np.ndarray, "N N"]:
    """The vorticity at time `t`, by SciPy's DOP853 in plain space, with a tolerance of 1e-13.

    The Laplacian is the sum of the double commutators, one sparse matrix that is factorised.
    The error of `y0()` at 4 is about 1e-11.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    n = len(start)
    # Acts on the rows of a matrix, one after the other.
    eye = sparse.eye_array(n)
    turns = [sparse.kron(s, eye) - sparse.kron(eye, s.T) for s in spins(n)]
    laplacian = -sum(np.real(turn @ turn) for turn in turns)
    # A stream function is known but for a constant: of this one the first element is zero.
    laplacian += sparse.coo_array(([1.0], ([0], [0])), shape=(n**2, n**2))
    solve = splu(sparse.csc_array(laplacian)).solve
    scale = 0.5j * np.sqrt(n**2 - 1)

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        # Real and imaginary parts are two right hand sides.
        parts = solve(y.reshape(-1, 1).view(float))
        p = np.ascontiguousarray(parts).view(complex).reshape(n, n)
        return scale * (p @ y - y @ p)

    return by_dop853(rate, start, t)


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    start = y0()
    inverse = jnp.asarray(inverse_laplacian(len(start)))
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=start, args=inverse)


def invariants(y: Complex[Array, "N N"], args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {
        "energy": energy(y, args),
        "angular momentum": angular_momentum(y),
        "eigenvalues": jnp.linalg.eigvalsh(y),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """Vorticity on the sphere, N = 32, to t = 4, 10 to 320 equal steps; Tsit5 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF3(), cfjax.CF4(), cfjax.CF43(), cfjax.CF54())
        | by_name(*PROJECTED)
        | in_plain_space(velocity, diffrax.Dopri5(), diffrax.Tsit5()),
        reference=reference(t1, y0()),
        num_steps=[10 * 2**k for k in range(6)],
        **options,
    )


def picture(n: int = 64) -> figures.Figure:
    """Random vorticity that winds up into a few vortices, to t = 60, and its stream function."""
    start, inverse = y0(n), jnp.asarray(inverse_laplacian(n))
    times, steps = [0, 4, 8, 16, 60], dict(num_steps=600, save_every=40, save_initial=True)
    _, ys = solve(problem(), solver, t1=60.0, y0=start, args=inverse, **steps)
    latitude, longitude = np.linspace(-np.pi / 2, np.pi / 2, 121), np.linspace(-np.pi, np.pi, 241)
    figure = figures.new(2.8 * len(times), 3.2)
    rows: Any = [], []
    for k, t in enumerate(times):
        y = ys[t // 4]
        p = np.asarray(stream_function(y, inverse))
        for row, (matrix, most) in enumerate([(y, 3.0), (p, 0.4)]):
            ax: Any = figure.add_subplot(
                2, len(times), row * len(times) + k + 1, projection="mollweide"
            )
            values = on_sphere(matrix, latitude, longitude)
            options: Any = dict(cmap="RdBu_r", vmin=-most, vmax=most, shading="gouraud")
            shown = ax.pcolormesh(longitude, latitude, values, rasterized=True, **options)
            rows[row].append(ax)
            if k == 0:
                ax.set_ylabel(("vorticity", "stream function")[row])
            elif t == times[-1]:
                figure.colorbar(shown, ax=rows[row])
            ax.set(xticks=[], yticks=[])
            if row == 0:
                ax.set_title(f"t = {t}")
    return figure


@lru_cache(maxsize=256)
def _harmonics(n: int, m: int) -> Float[np.ndarray, "size size"]:
    """The m-th diagonals of the matrices for harmonics of order m, in columns of rising degree.

    They are eigenvectors of the Laplacian, which acts on each diagonal as a symmetric tridiagonal
    matrix with the eigenvalues l (l + 1), l = m .. n - 1.
    """
    from scipy.linalg import eigh_tridiagonal

    third = (n - 1) / 2 - np.arange(n)
    i = np.arange(n - 1)
    raising = np.sqrt((i + 1.0) * (n - 1 - i))
    main = (n**2 - 1) / 2 - 2 * third[: n - m] * third[m:]
    beside = -raising[: n - 1 - m] * raising[m:]
    if n - m == 1:
        return np.ones((1, 1))
    values, vectors = eigh_tridiagonal(main, beside)
    # Near the north pole harmonics are positive, and so is the first element here. It may be less
    # than rounding: its sign comes from the largest one, by the recurrence that leads there.
    peaks = np.argmax(np.abs(vectors), axis=0)
    elements = [np.ones_like(values), (values - main[0]) / beside[0]]
    for i in range(1, n - m - 1):
        middle = (values - main[i]) * elements[i] - beside[i - 1] * elements[i - 1]
        elements.append(middle / beside[i])
    columns = np.arange(n - m)
    return vectors * np.sign(vectors[peaks, columns] * np.array(elements)[peaks, columns])
