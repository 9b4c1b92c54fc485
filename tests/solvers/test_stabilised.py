"""Stabilised methods: their polynomials, orders, stages, control and exact answers."""

import diffrax
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import problems
import pytest
from solver_table import solvers

import cfjax

SOLVERS = {name: getattr(cfjax, name) for name in solvers("stabilised")}
names = pytest.mark.parametrize("name", SOLVERS)
# Twice the index of the Gegenbauer polynomials.
INDEX = {"RKL2": 1, "RKG2": 3, "RKL3": 1}


def reach(s, l):  # noqa: E741
    """The range of s stages on the negative axis."""
    return 2 * (s - 1) * (s + l + 1) / (l + 3)


def stages_for(z, l):  # noqa: E741
    """The least odd number whose range has z in it."""
    return next(s for s in range(3, 1000, 2) if reach(s, l) >= z)


# Stability polynomials


def gegenbauer(n, a, x):
    """By its finite sum, so from another formula than the recursion of the methods."""
    return mpmath.fsum(
        (-1) ** k * mpmath.rf(a, n - k) / mpmath.factorial(k) / mpmath.factorial(n - 2 * k)
        * (2 * x) ** (n - 2 * k)
        for k in range(n // 2 + 1)
    )  # fmt: skip


def polynomial(s, l, z):  # noqa: E741
    a = mpmath.mpf(l) / 2
    b = mpmath.mpf((l + 1) * (s - 1) * (s + l + 1)) / ((l + 3) * s * (s + l))
    w = mpmath.mpf(l + 3) / ((s - 1) * (s + l + 1))
    return 1 - b + b * gegenbauer(s, a, 1 + w * z) / gegenbauer(s, a, 1)


def exact_growth(name, s, z):
    """What a step with s stages multiplies the state by, where `h lambda` is z."""
    l = INDEX[name]  # noqa: E741
    with mpmath.workdps(50):
        z = mpmath.mpmathify(z)
        value = polynomial(s, l, z)
        if name == "RKL3":
            half = polynomial(stages_for(reach(s, l) / 2, l), l, z / 2)
            value = (4 * half**2 - value) / 3
        return complex(value)


def points_of_stability(s, l):  # noqa: E741
    """Along the negative axis to the end of the range, and in a wedge about it."""
    axis = -reach(s, l) * np.array([1e-3, 0.03, 0.2, 0.5, 0.8, 0.97])
    wedge = -(reach(s, l) ** 0.5) * np.exp(1j * np.array([0.1, 0.5, -1.0]))
    return np.concatenate([axis, wedge])


def growth(solver, z, radius=None, dtype=complex):
    """Of one step, for numbers z, all in one program."""

    def step(z, radius):
        term = cfjax.LieTerm(lambda t, y, args: args[0] * y)
        t = jnp.zeros((), jnp.finfo(dtype).dtype)
        return problems.first_step(solver, term, t, t + 1, jnp.ones((), dtype), (z, radius))[0]

    # Within the range in the rounding of float32 too.
    z, radius = jnp.asarray(z, dtype), jnp.asarray(radius, jnp.finfo(dtype).dtype)
    return np.asarray(jax.jit(jax.vmap(step))(z, radius))


def radius_of_args(t, y, args):
    return args[1]


@pytest.mark.parametrize("dtype", [complex, np.complex64])
@names
def test_stability_polynomials_of_chosen_stages(name, dtype):
    """3 to 31 stages by the radius, in one program."""
    cases = [(s, z) for s in range(3, 32, 2) for z in points_of_stability(s, INDEX[name])]
    # Between the range of two stages fewer and that of s.
    radius = [reach(s, INDEX[name]) * (1 - 1e-3) for s, _ in cases]
    solver = SOLVERS[name](spectral_radius=radius_of_args)
    found = growth(solver, [z for _, z in cases], radius, dtype)
    expected = np.array([exact_growth(name, s, z) for s, z in cases])
    # Internal errors grow like the square of the stages.
    tolerance = 2e-13 if dtype is complex else 2e-4
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("stages", [3, 4, 5, 9, 16, 31])
@names
def test_stability_polynomials_of_given_stages(name, stages):
    z = points_of_stability(stages, INDEX[name])
    found = growth(SOLVERS[name](stages), z, np.zeros(len(z)))
    expected = [exact_growth(name, stages, x) for x in z]
    # As above.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-13)


@names
def test_stability_on_the_whole_range_and_damping_at_its_end(name):
    """Odd stages damp what is stiffest to a third or less; even ones would leave it as it is."""
    l = INDEX[name]  # noqa: E741
    size = np.geomspace(0.1, 1000, 400)
    found = growth(SOLVERS[name](spectral_radius=radius_of_args), -size, size)
    assert (np.abs(found) < 1).all()
    # Below one also away from the origin: what a step leaves of stiff parts.
    assert np.abs(found[size > 4]).max() < {"RKL2": 0.75, "RKG2": 0.5, "RKL3": 0.95}[name]
    if name != "RKL3":
        ends = np.array([reach(s, l) for s in range(3, 32, 2)])
        found = growth(SOLVERS[name](spectral_radius=radius_of_args), -ends, ends * (1 - 1e-9))
        # There the polynomial is 1 - 2 b.
        expected = [float(exact_growth(name, s, -reach(s, l)).real) for s in range(3, 32, 2)]
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-13)
        assert np.abs(found).max() < 0.34
        even = [abs(exact_growth(name, s, -reach(s, l)) - 1) for s in (4, 10, 30)]
        assert max(even) < 1e-12
        # Beyond it grows at once.
        found = growth(
            SOLVERS[name](spectral_radius=radius_of_args), -1.1 * ends, ends * (1 - 1e-9)
        )
        assert (np.abs(found[5:]) > 10).all()


def test_a_real_plane_is_a_complex_number():
    def field(t, y, args):
        return jnp.stack([-3 * y[0] - 40 * y[1], 40 * y[0] - 3 * y[1]])

    solver = cfjax.RKG2(9)
    y0, term, t = jnp.array([1.0, 0.0]), cfjax.LieTerm(field), jnp.zeros(())
    y = jax.jit(lambda y0: problems.first_step(solver, term, t, t + 0.1, y0, None)[0])(y0)
    expected = exact_growth("RKG2", 9, -0.3 + 4j)
    np.testing.assert_allclose(y, [expected.real, expected.imag], rtol=0, atol=1e-13)
