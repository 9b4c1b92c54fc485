"""What all coordinates of a Munthe-Kaas step share: how they are chosen, and what is refused."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from matrix_checks import product
from matrix_problems import PROBLEMS, Problem, skew

import cfjax
from cfjax.scenes import zeitlin

NAMES = ["projected", "cayley"]


def test_coordinates_are_part_of_the_method(no_shape_hook):
    message = "coordinates must be 'exponential', 'projected' or 'cayley', got"
    for name in ("caley", "Projected", None):
        with pytest.raises(ValueError, match=message):
            cfjax.RKMK8(coordinates=name)
    for name in NAMES:
        solver = cfjax.RKMK5(coordinates=name)
        assert cfjax.RKMK5() == cfjax.RKMK5(coordinates="exponential") != solver
        assert solver == cfjax.RKMK5(coordinates=name)
        for row in ("a", "b", "b_error", "c"):
            assert getattr(solver, row) == getattr(cfjax.RKMK5(), row)


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
        for coordinates in NAMES:
            solver = cfjax.RKMK5(coordinates=coordinates)
            message = f'^{name.split()[0]} has no coordinates for coordinates="{coordinates}"'
            with subtests.test(case=(name, coordinates)):
                with pytest.raises(TypeError, match=f"{message}.*{advice}"):
                    cfjax.integrate(term, solver, 0.0, 1.0, y0, num_steps=2)


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


@pytest.mark.parametrize("coordinates", NAMES)
def test_a_field_of_a_users_own_can_take_those_of_its_matrix(coordinates):
    term = cfjax.LieTerm(lambda t, y, args: Turn(jnp.cos(t)))
    solver = cfjax.RKMK8(coordinates=coordinates)
    y = cfjax.integrate(term, solver, 0.0, 2.0, jnp.eye(2)[0], num_steps=10).ys[-1]
    # The error of order 8 of steps of 0.2.
    np.testing.assert_allclose(y, [np.cos(np.sin(2)), np.sin(np.sin(2))], rtol=0, atol=1e-11)
    assert abs(np.linalg.norm(y) - 1) < 4e-16


def test_the_field_at_the_end_of_a_step_is_the_first_of_the_next():
    """So a step of three stages takes as many evaluations, with its estimate."""
    given = product({x: PROBLEMS[x] for x in ("SU(3)", "Toda", "orthonormal columns, low rank")})
    (y0, args), count = problems.arrays((given.y0, given.args)), []

    def field(t, y, args):
        count.append(None)
        return given.field(t, y, args)

    term, times = cfjax.LieTerm(field), (jnp.asarray(0.0), jnp.asarray(0.1))
    for coordinates in NAMES:
        solver = cfjax.RKMK(diffrax.Bosh3.tableau, coordinates=coordinates, unroll=True)
        state = solver.init(term, *times, y0, args)
        count.clear()
        jax.eval_shape(
            lambda: solver.step(term, *times, y0, args, state, made_jump=False)  # noqa: B023
        )
        assert len(count) == 3


@pytest.mark.parametrize("coordinates", NAMES)
def test_products_with_arrays_and_parts_at_rest(coordinates):
    """A frame with orthonormal columns, a lattice, and how far the frame's first column leads."""
    frame, lattice = PROBLEMS["SO(5)"], PROBLEMS["Toda"]

    def field(t, y, args):
        return {
            "frame": frame.field(t, y["frame"], args),
            "lattice": (lattice.field(t, y["lattice"][0], None), None),
            "path": y["frame"][:, 0],
        }

    y0 = {
        "frame": frame.y0,
        "lattice": (lattice.y0, np.ones(2)),
        "path": np.zeros(5),
    }
    y0, args = problems.arrays((y0, frame.args))
    term, solver = cfjax.LieTerm(field), cfjax.RKMK8(coordinates=coordinates, unroll=False)
    ys: Any = cfjax.integrate(term, solver, 0.0, 2.0, y0, args, num_steps=20).ys
    times, weights = np.polynomial.legendre.leggauss(20)
    path = sum(w * frame.exact(1 + t)[:, 0] for t, w in zip(times, weights, strict=True))
    # The error of the method, as tests of each of the coordinates find.
    np.testing.assert_allclose(ys["frame"][-1], frame.exact(2.0), rtol=0, atol=1e-11)
    np.testing.assert_allclose(ys["lattice"][0][-1], lattice.exact(2.0), rtol=0, atol=1e-11)
    np.testing.assert_allclose(ys["path"][-1], path, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(ys["lattice"][1][-1], np.ones(2))


@pytest.mark.parametrize("coordinates", NAMES)
def test_multiples_of_the_identity_that_move_nothing(coordinates):
    """They are no turn, whatever their size, and no error."""
    a, y0 = skew(3, True), jnp.diag(jnp.arange(3.0)).astype(complex)
    unit = jnp.eye(3, dtype=complex)

    def field(t, y, s):
        moved = jnp.cos(t).astype(complex) * a
        return cfjax.Conjugation(moved + s * unit), cfjax.Congruence(moved + s * (1j * unit))

    term, solver = cfjax.LieTerm(field), cfjax.RKMK5(coordinates=coordinates, unroll=False)

    def end(size):
        s = jnp.asarray(size, complex)
        return cfjax.integrate(term, solver, 0.0, 1.0, (y0, y0), s, num_steps=4).ys

    # Rounding of a matrix with such entries.
    problems.assert_close(end(50.0), end(0.0), 5e-14)


@pytest.mark.parametrize("coordinates", NAMES)
def test_rossby_haurwitz_waves(coordinates):
    """Vorticity on a sphere as a Hermitian matrix: the eigenvalues stay, and the pattern turns."""
    n, t1 = 8, 2.0
    args = zeitlin.inverse_laplacian(n)
    start, end = (zeitlin.rossby_haurwitz(t, n) for t in (0.0, t1))
    solver = cfjax.RKMK8(coordinates=coordinates, unroll=False)
    y = np.asarray(Problem(zeitlin.field, start, args, None).end(solver, t1, 40))
    np.testing.assert_array_equal(y, y.conj().T)
    spectra = [np.linalg.eigvalsh(x) for x in (y, start)]
    # Some roundings of eigenvalues up to 10.
    np.testing.assert_allclose(*spectra, rtol=0, atol=4e-14)
    assert np.abs(start - end).max() > 0.5
    np.testing.assert_allclose(y, end, rtol=0, atol=1e-8)
