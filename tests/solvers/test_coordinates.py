"""What all coordinates of a Munthe-Kaas step share: how they are chosen, and what is refused."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from matrix_problems import PROBLEMS, skew

import cfjax

NAMES = ["projected", "cayley"]


@pytest.mark.parametrize("make", [cfjax.RKMK5, cfjax.RKMK8])
@pytest.mark.parametrize("name", ["caley", "Projected", None])
def test_other_coordinates_are_refused(make, name, no_shape_hook):
    message = "coordinates must be 'exponential', 'projected' or 'cayley', got"
    with pytest.raises(ValueError, match=message):
        make(coordinates=name)


@pytest.mark.parametrize("coordinates", NAMES)
def test_coordinates_are_part_of_the_method(coordinates):
    solver = cfjax.RKMK5(coordinates=coordinates)
    assert cfjax.RKMK5() == cfjax.RKMK5(coordinates="exponential") != solver
    assert solver == cfjax.RKMK5(coordinates=coordinates)
    for name in ("a", "b", "b_error", "c"):
        assert getattr(solver, name) == getattr(cfjax.RKMK5(), name)


CLOSED = r'coordinates="exponential", the default'
OTHERS = r"commutator-free method.*cfjax\.CF4\(\)"


@pytest.mark.parametrize("coordinates", NAMES)
@pytest.mark.parametrize(
    "field, y0, name, advice",
    [
        (lambda y: cfjax.Rotation(-y), np.ones(3), "Rotation", CLOSED),
        (
            lambda y: cfjax.QuaternionRotation(y[1:], frame="body", layout="wxyz"),
            np.eye(4)[0],
            "QuaternionRotation",
            CLOSED,
        ),
        (
            lambda y: cfjax.RigidMotion(omega=y[:3], v=y[:3], frame="body", layout="wxyz_xyz"),
            np.eye(7)[0],
            "RigidMotion",
            CLOSED,
        ),
        (lambda y: cfjax.Congruence(-y, y), np.eye(2), "Congruence", OTHERS),
        (
            lambda y: cfjax.Affine(y, -jnp.ones(3)),
            np.ones(3),
            "Affine",
            OTHERS,
        ),
        (lambda y: {"a": -y["a"], "b": cfjax.Rotation(y["b"])}, None, "Rotation", CLOSED),
        (
            lambda y: cfjax.elementwise(problems.Growth(y[:, 0])),
            np.ones((2, 3)),
            "Elementwise",
            OTHERS,
        ),
    ],
)
def test_fields_without_these_coordinates_are_refused(coordinates, field, y0, name, advice):
    y0 = {"a": jnp.ones(2), "b": jnp.ones(3)} if y0 is None else jnp.asarray(y0)
    term = cfjax.LieTerm(lambda t, y, args: field(y))
    solver = cfjax.RKMK5(coordinates=coordinates)
    message = f'^{name} has no coordinates for coordinates="{coordinates}".*{advice}'
    with pytest.raises(TypeError, match=message):
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


@pytest.mark.parametrize("coordinates", NAMES)
@pytest.mark.parametrize("problem", ["SU(3)", "Toda", "orthonormal columns, low rank"])
def test_the_field_at_the_end_of_a_step_is_the_first_of_the_next(coordinates, problem):
    """So a step takes six evaluations, with its estimate."""
    given, count = PROBLEMS[problem], []

    def field(t, y, args):
        count.append(None)
        return given.field(t, y, args)

    solver = cfjax.RKMK5(coordinates=coordinates, unroll=True)
    y0, args = problems.arrays((given.y0, given.args))
    term = cfjax.LieTerm(field)
    t0, t1 = jnp.asarray(0.0), jnp.asarray(0.1)
    state = solver.init(term, t0, t1, y0, args)
    count.clear()
    jax.eval_shape(lambda: solver.step(term, t0, t1, y0, args, state, made_jump=False))
    assert len(count) == 6


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
    term, solver = cfjax.LieTerm(field), cfjax.RKMK8(coordinates=coordinates)
    ys: Any = cfjax.integrate(term, solver, 0.0, 2.0, y0, args, num_steps=20).ys
    times, weights = np.polynomial.legendre.leggauss(20)
    path = sum(w * frame.exact(1 + t)[:, 0] for t, w in zip(times, weights, strict=True))
    # The error of the method, as tests of each of the coordinates find.
    np.testing.assert_allclose(ys["frame"][-1], frame.exact(2.0), rtol=0, atol=1e-11)
    np.testing.assert_allclose(ys["lattice"][0][-1], lattice.exact(2.0), rtol=0, atol=1e-11)
    np.testing.assert_allclose(ys["path"][-1], path, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(ys["lattice"][1][-1], np.ones(2))


@pytest.mark.parametrize("coordinates", NAMES)
@pytest.mark.parametrize("cls, factor", [(cfjax.Conjugation, 1.0), (cfjax.Congruence, 1.0j)])
def test_multiples_of_the_identity_that_move_nothing(coordinates, cls, factor):
    """They are no turn, whatever their size, and no error."""
    a, y0 = skew(3, True), jnp.diag(jnp.arange(3.0)).astype(complex)
    unit = factor * jnp.eye(3, dtype=complex)
    term = cfjax.LieTerm(lambda t, y, s: cls(jnp.cos(t).astype(complex) * a + s * unit))

    def end(size):
        s = jnp.asarray(size, complex)
        solver = cfjax.RKMK5(coordinates=coordinates)
        return cfjax.integrate(term, solver, 0.0, 1.0, y0, s, num_steps=4).ys[-1]

    # Rounding of a matrix with such entries.
    np.testing.assert_allclose(end(50.0), end(0.0), rtol=0, atol=5e-14)
