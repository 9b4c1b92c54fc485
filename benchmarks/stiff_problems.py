"""The problems of `benchmarks/stiff.py`: `u' = M u + g(t, u)` with a stiff M, on a grid.

A problem is written once, as its M and its g. For cfjax the state is the vector of coefficients in
which M is diagonal. The methods in plain space take the values on the grid, with M as differences
where it is one. The sources of the problems are:

- Heat conduction in `cfjax.scenes.heat`.
- Two problems of Hochbruck & Ostermann, doi:10.1137/040611434, whose g does not vanish at the
  boundary. Both have the exact solution `x (1 - x) exp(t)`, at the points of the grid as well.
- Allen & Cahn, Kuramoto & Sivashinsky, Burgers, and Korteweg & de Vries in the form of Kassam &
  Trefethen, doi:10.1137/S1064827502410633. Gray & Scott's is exponax's.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import on_host
from cfjax.scenes import heat


class Problem(NamedTuple):
    t1: float
    # Coefficients, and their frozen field.
    y0: Any
    field: Callable[[Any, Any, Any], Any]
    # Real values on the grid, from coefficients and back, and their velocity.
    values: Callable[[Any], Any]
    coefficients: Callable[[Any], Any]
    velocity: Callable[[Any, Any, Any], Any]
    # Two numbers of steps between which the order shows.
    counts: tuple[int, int]
    # The exact values on the grid at the end, where they are known.
    exact: np.ndarray | None = None
    # Subtracted from the values at the end: errors are relative to the sum.
    lift: np.ndarray | float = 0.0
    # The class of exponax with the same M, g and dealiasing, less its length of a step.
    exponax: Callable[[Any, Any], Any] | None = None

    def reference(self) -> np.ndarray:
        """The values at the end, by an explicit method that shares nothing with the others."""
        if self.exact is not None:
            return self.exact
        u0 = np.asarray(self.values(self.y0))
        velocity = jax.jit(lambda t, u: self.velocity(t, u, None))
        return on_host.solve(velocity, self.t1, u0)


def dirichlet(
    t1: float, diffusivity: float, length: float, u0: np.ndarray, g: Callable, **options: Any
) -> Problem:
    """Diffusion by central differences, with the value zero at both ends."""
    n, sine = len(u0), cfjax.SineTransform()
    scale = diffusivity * ((n + 1) / length) ** 2
    spectrum = jnp.asarray(scale * sine.second_difference(n))

    def field(t: Any, c: Any, args: Any) -> cfjax.Affine:
        return cfjax.Affine(sine.forward(g(t, sine.inverse(c))), spectrum)

    def velocity(t: Any, u: Any, args: Any) -> Any:
        return scale * jnp.diff(jnp.pad(u, 1), 2) + g(t, u)

    y0 = sine.forward(jnp.asarray(u0))
    return Problem(t1, y0, field, sine.inverse, sine.forward, velocity, **options)


def periodic(t1: float, spectrum: Any, u0: np.ndarray, g: Callable, **options: Any) -> Problem:
    """With g of the real Fourier coefficients; the spectrum has an axis for each that u0 has."""
    shape = u0.shape[-spectrum.ndim :] if u0.ndim == 1 else u0.shape[1:]
    axes = tuple(range(-len(shape), 0))
    spectrum = jnp.asarray(spectrum)

    def values(c: Any) -> Any:
        return jnp.fft.irfftn(c, shape, axes)

    def coefficients(u: Any) -> Any:
        return jnp.fft.rfftn(u, axes=axes)

    def field(t: Any, c: Any, args: Any) -> cfjax.Affine:
        return cfjax.Affine(g(t, c), spectrum)

    def velocity(t: Any, u: Any, args: Any) -> Any:
        c = coefficients(u)
        return values(spectrum * c + g(t, c))

    y0 = coefficients(jnp.asarray(u0))
    return Problem(t1, y0, field, values, coefficients, velocity, **options)


def points(n: int, low: float, high: float) -> np.ndarray:
    """The n inner points of an equidistant grid."""
    return np.linspace(low, high, n + 2)[1:-1]


def dealiasing_mask(k: np.ndarray, n: int, fraction: float) -> np.ndarray:
    """The wave numbers that exponax keeps in g."""
    return np.abs(k) <= fraction * (n // 2) - 1


# One dimension, values given at both ends.


def of_heat(constant: Callable[[np.ndarray], float]) -> Problem:
    """The paper's operator: M has a constant diffusivity, and g all else."""
    mu = heat.diffusivity().mu
    args = heat.Diffusivity(jnp.asarray(mu), jnp.asarray(constant(np.asarray(mu))))
    return Problem(
        heat.t1,
        jnp.asarray(heat.y0()),
        lambda t, c, _: heat.field(t, c, args),
        heat.to_grid,
        heat.from_grid,
        lambda t, u, _: heat.grid_field(t, u, args),
        (300, 800),
        heat.reference(heat.t1, np.asarray(mu)),
    )


def heat_diagonalised() -> Problem:
    """The heat problem with all of its operator in M."""
    problem, n = of_heat(np.mean), len(heat.y0())
    matrix = jax.jacfwd(lambda u: problem.velocity(0.0, u, None))(jnp.zeros(n))
    spectrum, transform = cfjax.diagonalised(np.asarray(matrix))
    return problem._replace(
        y0=transform.forward(problem.values(problem.y0)),
        field=lambda t, c, _: cfjax.Affine(jnp.zeros_like(c), spectrum),
        values=transform.inverse,
        coefficients=transform.forward,
    )


def hochbruck_ostermann() -> Problem:
    x = points(199, 0, 1)
    u0 = x * (1 - x)

    def g(t: Any, u: Any) -> Any:
        exact = jnp.exp(t) * u0
        return 1 / (1 + u**2) + exact + 2 * jnp.exp(t) - 1 / (1 + exact**2)

    return dirichlet(1.0, 1.0, 1.0, u0, g, counts=(10, 80), exact=np.e * u0)


def hochbruck_ostermann_integral() -> Problem:
    x = points(199, 0, 1)
    u0 = x * (1 - x)

    def g(t: Any, u: Any) -> Any:
        return jnp.mean(u) + jnp.exp(t) * (u0 + 2 - np.mean(u0))

    return dirichlet(1.0, 1.0, 1.0, u0, g, counts=(10, 80), exact=np.e * u0)


def allen_cahn() -> Problem:
    x = points(127, -1, 1)
    # The values are -1 and 1 at the ends: the state is u - x.
    u0 = -0.47 * (x + np.sin(1.5 * np.pi * x))

    def g(t: Any, v: Any) -> Any:
        u = v + x
        return u - u**3

    return dirichlet(12.0, 0.01, 2.0, u0, g, counts=(20, 160), lift=x)


def allen_cahn_in_g() -> Problem:
    """The same with the boundary values in g, where they are constant."""
    n = 127
    x = points(n, -1, 1)
    boundary_values = np.zeros(n)
    boundary_values[0], boundary_values[-1] = -1, 1
    boundary_values *= 0.01 * ((n + 1) / 2) ** 2
    u0 = 0.53 * x - 0.47 * np.sin(1.5 * np.pi * x)
    return dirichlet(12.0, 0.01, 2.0, u0, lambda t, u: u - u**3 + boundary_values, counts=(20, 160))


def inflow(t: Any) -> Any:
    return jnp.sin(3 * t) ** 2


def advection_diffusion() -> Problem:
    n = 199
    x = points(n, 0, 1)
    # At x = 0 the value is that of the inflow: the state is u - w.

    def w(t: Any) -> Any:
        return inflow(t) * (1 - x)

    def g(t: Any, v: Any) -> Any:
        _, rate = jax.jvp(w, (t,), (jnp.ones_like(t),))
        return inflow(t) - rate - slope(v)

    lift = np.asarray(w(1.0))
    return dirichlet(1.0, 0.01, 1.0, np.zeros(n), g, counts=(40, 160), lift=lift)


def advection_diffusion_in_g() -> Problem:
    """The same with the boundary value in g, where it varies in time."""
    n = 199
    first_point = np.zeros(n)
    first_point[0] = 1

    def g(t: Any, u: Any) -> Any:
        return (0.01 * (n + 1) ** 2 + (n + 1) / 2) * inflow(t) * first_point - slope(u)

    return dirichlet(1.0, 0.01, 1.0, np.zeros(n), g, counts=(40, 160))


def slope(u: Any) -> Any:
    """By central differences on the unit interval."""
    padded = jnp.pad(u, 1)
    return (len(u) + 1) / 2 * (padded[2:] - padded[:-2])


# Periodic.


def allen_cahn_periodic() -> Problem:
    n = 128
    x = 2 * np.arange(n) / n
    u0 = 0.5 * np.sin(np.pi * x) + 0.3 * np.cos(3 * np.pi * x) + 0.1
    k = np.pi * np.arange(n // 2 + 1)

    def g(t: Any, c: Any) -> Any:
        u = jnp.fft.irfft(c, n)
        return jnp.fft.rfft(u - u**3)

    return periodic(5.0, -0.01 * k**2, u0, g, counts=(20, 160))


def convection(n: int, derivative: np.ndarray, scale: float) -> Callable:
    """The convection of u in its conservative form, with two thirds of the wave numbers kept."""
    mask = dealiasing_mask(np.arange(n // 2 + 1), n, 2 / 3)

    def g(t: Any, c: Any) -> Any:
        u = jnp.fft.irfft(mask * c, n)
        return -scale / 2 * derivative * mask * jnp.fft.rfft(u**2)

    return g


def truncated(u: np.ndarray) -> np.ndarray:
    """Only the wave numbers that g keeps."""
    n = len(u)
    return np.fft.irfft(dealiasing_mask(np.arange(n // 2 + 1), n, 2 / 3) * np.fft.rfft(u), n)


def kuramoto_sivashinsky() -> Problem:
    n, period = 128, 32 * np.pi
    x = period * np.arange(n) / n
    k = 2 * np.pi / period * np.arange(n // 2 + 1)
    return periodic(
        30.0,
        k**2 - k**4,
        np.cos(x / 16) * (1 + np.sin(x / 16)),
        convection(n, 1j * k, 1.0),
        counts=(60, 480),
        exponax=lambda package, dt: package.stepper.KuramotoSivashinskyConservative(
            1, period, n, dt, order=4
        ),
    )


def burgers() -> Problem:
    n, period = 256, 2 * np.pi
    x = period * np.arange(n) / n
    k = np.arange(n // 2 + 1)
    return periodic(
        1.0,
        -0.03 * k**2,
        truncated(np.sin(x) + 0.5 * np.cos(2 * x)),
        convection(n, 1j * k, 1.0),
        counts=(20, 160),
        exponax=lambda package, dt: package.stepper.Burgers(
            1, period, n, dt, diffusivity=0.03, conservative=True, order=4
        ),
    )


def korteweg_de_vries() -> Problem:
    n, period = 256, 2 * np.pi
    x = period * np.arange(n) / n - np.pi
    solitons = (3 * a**2 / np.cosh(a / 2 * (x + at)) ** 2 for a, at in ((25.0, 2.0), (16.0, 1.0)))
    k = np.arange(n // 2 + 1)
    return periodic(
        0.006,
        1j * k**3,
        truncated(sum(solitons)),  # type: ignore
        convection(n, 1j * k, 1.0),
        counts=(600, 1600),
        exponax=lambda package, dt: package.stepper.KortewegDeVries(
            1,
            period,
            n,
            dt,
            convection_scale=1.0,
            hyper_diffusivity=0.0,
            conservative=True,
            order=4,
        ),
    )


def schrodinger() -> Problem:
    """A nonlinear Schrödinger equation with a potential: the values are real and imaginary."""
    n = 256
    x = 2 * np.pi * np.arange(n) / n - np.pi
    k = np.fft.fftfreq(n, 1 / n)
    spectrum = jnp.asarray(-0.5j * k**2)
    psi0 = np.exp(np.cos(x) - 1) * np.exp(1j * np.sin(x))

    def g(psi: Any) -> Any:
        return -1j * (np.cos(x) + jnp.abs(psi) ** 2) * psi

    def field(t: Any, c: Any, args: Any) -> cfjax.Affine:
        return cfjax.Affine(jnp.fft.fft(g(jnp.fft.ifft(c))), spectrum)

    def real_and_imaginary(psi: Any) -> Any:
        return jnp.stack([psi.real, psi.imag])

    def velocity(t: Any, u: Any, args: Any) -> Any:
        psi = u[0] + 1j * u[1]
        return real_and_imaginary(jnp.fft.ifft(spectrum * jnp.fft.fft(psi)) + g(psi))

    return Problem(
        2.5,
        jnp.fft.fft(jnp.asarray(psi0)),
        field,
        lambda c: real_and_imaginary(jnp.fft.ifft(c)),
        lambda u: jnp.fft.fft(u[0] + 1j * u[1]),
        velocity,
        (50, 400),
    )


def gray_scott() -> Problem:
    n, feed, kill = 64, 0.04, 0.06
    x = np.arange(n) / n
    x, y = x[:, None], x[None, :]
    spots = sum(np.exp(-80 * ((x - a) ** 2 + (y - b) ** 2)) for a, b in ((0.4, 0.45), (0.6, 0.6)))
    u0 = np.stack([1 - spots / 2, spots / 4])
    i, j = np.fft.fftfreq(n, 1 / n)[:, None], np.arange(n // 2 + 1)
    laplacian = -((2 * np.pi) ** 2) * (i**2 + j**2)
    mask = dealiasing_mask(i, n, 1 / 2) & dealiasing_mask(j, n, 1 / 2)

    def g(t: Any, c: Any) -> Any:
        u, v = jnp.fft.irfft2(mask * c, (n, n))
        rate = u * v**2
        return mask * jnp.fft.rfft2(jnp.stack([feed * (1 - u) - rate, rate - (feed + kill) * v]))

    return periodic(
        300.0,
        np.multiply.outer([2e-5, 1e-5], laplacian),
        u0,
        g,
        counts=(20, 160),
        exponax=lambda package, dt: package.stepper.reaction.GrayScott(
            2, 1.0, n, dt, feed_rate=feed, kill_rate=kill, order=4
        ),
    )


def nonlinear_diffusion() -> Problem:
    """The linearisation in M, so that an exponential method is one of Rosenbrock's."""
    n = 19
    x = points(n, 0, 1)

    def velocity(t: Any, u: Any, args: Any = None) -> Any:
        padded = jnp.pad(u, 1)
        middle = 1 + ((padded[1:] + padded[:-1]) / 2) ** 2
        return (n + 1) ** 2 * jnp.diff(middle * jnp.diff(padded)) + u - u**3

    def field(t: Any, u: Any, args: Any) -> cfjax.LinearAffine:
        jacobian = jax.jacfwd(lambda u: velocity(t, u))(u)
        return cfjax.LinearAffine(jacobian, velocity(t, u) - jacobian @ u)

    def identity(u: Any) -> Any:
        return u

    u0 = jnp.asarray(np.sin(np.pi * x))
    return Problem(0.2, u0, field, identity, identity, velocity, (20, 80))


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "heat, mean in M": lambda: of_heat(np.mean),
    "heat, largest in M": lambda: of_heat(np.max),
    "Hochbruck-Ostermann": hochbruck_ostermann,
    "the same with an integral": hochbruck_ostermann_integral,
    "Allen-Cahn, Dirichlet": allen_cahn,
    "advection-diffusion": advection_diffusion,
    "Allen-Cahn, periodic": allen_cahn_periodic,
    "Kuramoto-Sivashinsky": kuramoto_sivashinsky,
    "Burgers": burgers,
    "Korteweg-de Vries": korteweg_de_vries,
    "Schrödinger, potential": schrodinger,
    "Gray-Scott, two dimensions": gray_scott,
}
# Only errors of given numbers of steps are measured.
OTHERS = {
    "nonlinear diffusion, linearised": nonlinear_diffusion,
    "heat, 0.8 of the largest in M": lambda: of_heat(lambda mu: 0.8 * np.max(mu)),
    "Allen-Cahn, boundary values in g": allen_cahn_in_g,
    "advection-diffusion, boundary value in g": advection_diffusion_in_g,
}
