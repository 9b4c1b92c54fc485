"""What all coordinates of a Munthe-Kaas step share: how they are chosen, and what is refused."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from matrix_checks import product
from matrix_problems import PROBLEMS

import cfjax
from cfjax.scenes import zeitlin

SOLVERS = {
    "projected": cfjax.Projected,
    "cayley": lambda method, **options: cfjax.RKMK(method.tableau, coordinates="cayley", **options),
}
NAMES = list(SOLVERS)


def test_coordinates_are_part_of_the_method(no_shape_hook):
    message = "coordinates must be 'exponential' or 'cayley', got"
    for name in ("caley", "projected", None):
        with pytest.raises(ValueError, match=message):
            cfjax.RKMK8(coordinates=name)
    solver = cfjax.RKMK5(coordinates="cayley")
    assert cfjax.RKMK5() == cfjax.RKMK5(coordinates="exponential") != solver
    assert solver == cfjax.RKMK5(coordinates="cayley")
    projected = cfjax.Projected(diffrax.Tsit5())
    assert projected == cfjax.Projected(diffrax.Tsit5()) != cfjax.Projected(diffrax.Bosh3())
    for row in ("a", "b", "b_error", "c"):
        for other in (solver, projected):
            assert getattr(other, row) == getattr(cfjax.RKMK5(), row)


CLOSED = r'coordinates="exponential", the default'
OTHERS = r"commutator-free method.*cfjax\.CF4\(\)"


REFUSED = {
    "Rotation": (lambda y: cfjax.Rotation(-y), jnp.ones(3), CLOSED),
    "QuaternionRotation": (
        lambda y: cfjax.QuaternionRotation(y[1:], frame="body", layout="wxyz"),
        jnp.eye(4)[0],
        CLOSED,
    ),
    "RigidMotion": (
        lambda y: cfjax.RigidMotion(omega=y[:3], v=y[:3], frame="body", layout="wxyz_xyz"),
        jnp.eye(7)[0],
        CLOSED,
    ),
    "Congruence": (lambda y: cfjax.Congruence(-y, y), jnp.eye(2), OTHERS),
    "Affine": (lambda y: cfjax.Affine(y, -jnp.ones(3)), jnp.ones(3), OTHERS),
    "Rotation of a part": (
        lambda y: {"a": -y["a"], "b": cfjax.Rotation(y["b"])},
        {"a": jnp.ones(2), "b": jnp.ones(3)},
        CLOSED,
    ),
    "Elementwise": (
        lambda y: cfjax.elementwise(problems.Growth(y[:, 0])),
        jnp.ones((2, 3)),
        OTHERS,
    ),
}


def test_fields_without_these_coordinates_are_refused(subtests):
    for name, (field, y0, advice) in REFUSED.items():
        term = cfjax.LieTerm(lambda t, y, args, field=field: field(y))
        message = f'^{name.split()[0]} has no coordinates for coordinates="cayley".*{advice}'
        with subtests.test(case=name), pytest.raises(TypeError, match=message):
            cfjax.integrate(term, cfjax.RKMK5(coordinates="cayley"), 0.0, 1.0, y0, num_steps=2)


NOT_PROJECTED = {
    name: (REFUSED[name][0], REFUSED[name][1], "`projected` returns None.*cfjax.CF4")
    for name in ("Congruence", "Affine", "Elementwise")
} | {
    "Scaling": (lambda y: cfjax.Scaling(-y), jnp.ones(3), r"signs.*cfjax\.RKMK5"),
    "Lindblad": (lambda y: cfjax.Lindblad(y, [y]), jnp.eye(2, dtype=complex), r"cfjax\.Kraus4"),
}


def test_what_projected_refuses(subtests, no_shape_hook):
    for name, (field, y0, advice) in NOT_PROJECTED.items():
        term = cfjax.LieTerm(lambda t, y, args, field=field: field(y))
        message = f"^cfjax.Projected does not take {name}.*{advice}"
        with subtests.test(case=name), pytest.raises(TypeError, match=message):
            cfjax.integrate(term, cfjax.Projected(diffrax.Heun()), 0.0, 1.0, y0, num_steps=2)
    for method, error, message in [
        (diffrax.Tsit5, TypeError, r"an instance, Tsit5\(\), got the class"),
        (diffrax.Kvaerno5(), ValueError, "must be explicit, got the implicit one Kvaerno5"),
        (diffrax.KenCarp4(), TypeError, "explicit Runge-Kutta solver of diffrax, such as"),
        (diffrax.SPaRK(), TypeError, "explicit Runge-Kutta solver of diffrax, such as"),
        (diffrax.Euler(), TypeError, "explicit Runge-Kutta solver of diffrax, such as"),
        (cfjax.CF4(), TypeError, "explicit Runge-Kutta solver of diffrax, such as"),
        ("Tsit5", TypeError, "explicit Runge-Kutta solver of diffrax, such as"),
    ]:
        with subtests.test(method=method), pytest.raises(error, match=message):
            cfjax.Projected(method)
    with pytest.raises(TypeError, match="invariants must be a function or None, got 3"):
        cfjax.Projected(diffrax.Heun(), invariants=3)
    path = diffrax.LinearInterpolation(jnp.arange(2.0), jnp.arange(2.0)[:, None])
    term = cfjax.LieControlTerm(lambda t, y, args, dx: cfjax.Rotation(dx[0] * y), path)
    with pytest.raises(TypeError, match=r"path-driven terms.*cfjax\.WeakOrder2"):
        cfjax.integrate(term, cfjax.Projected(diffrax.Heun()), 0.0, 1.0, jnp.ones(3), num_steps=2)


class Turn(cfjax.AbstractFrozenField):
    """A class of a user's own that stands for a matrix."""

    angle: jnp.ndarray

    @property
    def _matrix(self):
        return cfjax.LeftMatrix(self.angle * jnp.asarray([[0.0, -1.0], [1.0, 0.0]]))

    def flow(self, point):
        return self._matrix.flow(point)

    def tangent(self, point):
        return self._matrix.tangent(point)

    def projected(self, point):
        return self._matrix.projected(point)

    def cayley(self, point):
        return self._matrix.cayley(point)


def test_the_field_at_the_end_of_a_step_is_the_first_of_the_next():
    """So a step of three stages takes as many evaluations, with its estimate."""
    given = product({x: PROBLEMS[x] for x in ("Toda", "orthonormal columns, low rank")})
    (y0, args), count = problems.arrays((given.y0, given.args)), []

    def field(t, y, args):
        count.append(None)
        return given.field(t, y, args)

    def step(solver):
        term, times = cfjax.LieTerm(field), (jnp.asarray(0.0), jnp.asarray(0.1))
        state = solver.init(term, *times, y0, args)
        count.clear()
        return solver.step(term, *times, y0, args, state, made_jump=False)[0]

    for coordinates in NAMES:
        solver = SOLVERS[coordinates](diffrax.Bosh3(), unroll=True)
        jax.eval_shape(lambda: step(solver))  # noqa: B023
        assert len(count) == 3


one_of_both = pytest.mark.parametrize(
    "coordinates", [NAMES[0], pytest.param(NAMES[1], marks=pytest.mark.slow)]
)


@one_of_both
def test_products_with_arrays_parts_at_rest_and_a_field_of_a_users_own(coordinates):
    """A frame with orthonormal columns, a lattice, and how far the frame's first column leads."""
    frame, lattice = PROBLEMS["SO(5)"], PROBLEMS["Toda"]

    def field(t, y, args):
        return {
            "frame": frame.field(t, y["frame"], args),
            "lattice": (lattice.field(t, y["lattice"][0], None), None),
            "path": y["frame"][:, 0],
            "turn": Turn(jnp.cos(t)),
        }

    y0 = {
        "frame": frame.y0,
        "lattice": (lattice.y0, np.ones(2)),
        "path": np.zeros(5),
        "turn": np.eye(2)[0],
    }
    y0, args = problems.arrays((y0, frame.args))
    term, solver = cfjax.LieTerm(field), SOLVERS[coordinates](diffrax.Dopri8(), unroll=False)
    ys: Any = cfjax.integrate(term, solver, 0.0, 2.0, y0, args, num_steps=20).ys
    times, weights = np.polynomial.legendre.leggauss(20)
    path = sum(w * frame.exact(1 + t)[:, 0] for t, w in zip(times, weights, strict=True))
    expected = {
        "frame": frame.exact(2.0),
        "path": path,
        "turn": [np.cos(np.sin(2)), np.sin(np.sin(2))],
    }
    found = {name: ys[name][-1] for name in expected} | {"lattice": ys["lattice"][0][-1]}
    for name, exact in (expected | {"lattice": lattice.exact(2.0)}).items():
        # The error of the method, as tests of each of the coordinates find.
        np.testing.assert_allclose(found[name], exact, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(ys["lattice"][1][-1], np.ones(2))
    assert abs(np.linalg.norm(found["turn"]) - 1) < 4e-16


@pytest.mark.parametrize("coordinates", [pytest.param(NAMES[0], marks=pytest.mark.slow), NAMES[1]])
def test_rossby_haurwitz_waves(coordinates):
    """Vorticity on a sphere as a Hermitian matrix: the eigenvalues stay, and the pattern turns.

    Multiples of the identity move nothing: whatever their size, they are no turn and no error.
    """
    n, t1 = 8, 2.0
    start, end = (jnp.asarray(zeitlin.rossby_haurwitz(t, n)) for t in (0.0, t1))
    unit = jnp.eye(n, dtype=complex)

    def field(t, y, args):
        s, inverse = args
        a, b = (zeitlin.field(t, x, inverse).a for x in (y[0][0], y[1]))
        # With a skew-Hermitian matrix both are the same. One of them has a leading axis.
        return cfjax.Conjugation((a + s * unit)[None]), cfjax.Congruence(b + s * (1j * unit))

    term, solver = cfjax.LieTerm(field), SOLVERS[coordinates](diffrax.Dopri8(), unroll=False)

    def solve(size):
        args = jnp.asarray(size, complex), jnp.asarray(zeitlin.inverse_laplacian(n))
        y0 = start[None], start
        ys: Any = cfjax.integrate(term, solver, 0.0, t1, y0, args, num_steps=40).ys
        return np.concatenate([ys[0][-1], ys[1][-1:]])

    found = solve(0.0)
    assert np.abs(start - end).max() > 0.5
    np.testing.assert_array_equal(found[1], found[1].conj().T)
    for y in found:
        spectra = [np.linalg.eigvalsh(x) for x in (y, start)]
        # Some roundings of eigenvalues up to 10.
        np.testing.assert_allclose(*spectra, rtol=0, atol=4e-14)
        np.testing.assert_allclose(y, end, rtol=0, atol=1e-8)
    # Rounding of a matrix with such entries.
    np.testing.assert_allclose(solve(50.0), found, rtol=0, atol=5e-14)
