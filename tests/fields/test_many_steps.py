"""Rounding over many steps of constant fields, at small and large angles: it does not grow."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax

NUM_STEPS = 2000
# From a tenth of a radian a step to several turns, with half and full turns.
ANGLES = np.sort(np.concatenate([np.geomspace(0.1, 20, 12), np.pi * np.arange(1, 7), [12.5]]))
AXIS = np.array([2.0, -3.0, 6.0]) / 7
V = np.array([0.3, -0.2, 0.5])
Q = np.array([1.0, -3.0, 5.0, 1.0]) / 6
PLACE = np.array([1.0, 2.0, 3.0])
EDGE = np.array([0.0, 0.6, 0.8])
TURN = np.array([[0.6, -0.8], [0.8, 0.6]])
RNG = np.random.default_rng(0)
COLUMNS = np.linalg.qr(RNG.normal(size=(5, 2)))[0]
G = RNG.normal(size=(5, 2))
G /= np.linalg.norm(G, 2)


def pose(rotation: Any, place: Any) -> Any:
    n = len(place)
    matrix = np.eye(n + 1)
    matrix[:n, :n], matrix[:n, n] = rotation, place
    return matrix


def motion(angle: Any, y: Any) -> Any:
    return cfjax.RigidMotion(omega=angle * AXIS, v=V, frame="body", layout="wxyz_xyz")


def extended(angle: Any, y: Any) -> Any:
    return cfjax.ExtendedMotion(omega=angle * AXIS, a=V, v=EDGE, frame="fixed", layout="wxyz_v_p")


def inertial(angle: Any, y: Any) -> Any:
    return cfjax.InertialMotion(omega=angle * AXIS, force=V, gravity=-V, layout="wxyz_v_p")


def planar(frame: Any) -> Any:
    return lambda angle, y: cfjax.PlanarMotion(
        omega=angle, v=V[:2], frame=frame, layout="unit_complex_xy"
    )


def quaternion(angle: Any, y: Any) -> Any:
    return cfjax.QuaternionRotation(angle * AXIS, frame="body", layout="wxyz")


def sphere(angle: Any, y: Any) -> Any:
    # Along a great circle through the start.
    g = jnp.asarray(COLUMNS[:, 1])
    g = g - (g @ y) * y
    return cfjax.SphereRotation(angle * g / jnp.sqrt(g @ g))


def orthonormal(x: Any) -> Any:
    return jnp.max(jnp.abs(x.T @ x - jnp.eye(x.shape[1])))


def length(x: Any) -> Any:
    return jnp.abs(x @ x - 1)


class Case(NamedTuple):
    field: Any
    start: np.ndarray
    off: Any
    # By what the columns of a step's span, which are not orthonormal, multiply a rounding.
    condition: float = 1
    # Units of rounding that are added in each step, the same in every step, where nothing leads
    # back: a vector may have any length, and a matrix would need products of matrices.
    per_step: float = 0


CASES = {
    "quaternion": Case(quaternion, Q, length),
    "pose": Case(motion, np.r_[Q, PLACE], lambda x: length(x[:4])),
    "extended pose": Case(extended, np.r_[Q, EDGE, PLACE], lambda x: length(x[:4])),
    "inertial": Case(inertial, np.r_[Q, EDGE, PLACE], lambda x: length(x[:4])),
    "inertial matrix": Case(
        inertial,
        np.r_[np.c_[np.eye(3), EDGE, PLACE], np.eye(5)[3:]],
        lambda x: orthonormal(x[:3, :3]),
        per_step=8,
    ),
    "planar pose": Case(planar("fixed"), np.r_[0.6, 0.8, PLACE[:2]], lambda x: length(x[:2])),
    "planar matrix": Case(
        planar("body"), pose(TURN, PLACE[:2]), lambda x: orthonormal(x[:2, :2]), per_step=8
    ),
    "sphere": Case(sphere, COLUMNS[:, 0], length),
    "Stiefel": Case(
        lambda angle, y: cfjax.LowRankSkew(angle * G), COLUMNS, orthonormal, condition=10
    ),
    "bordered": Case(lambda angle, y: cfjax.BorderedSkew(angle * G), COLUMNS, orthonormal),
    # The two coefficients of Rodrigues' formula are rounded to one unit each.
    "vector": Case(lambda angle, y: cfjax.Rotation(angle * AXIS), EDGE, length, per_step=8),
    "matrix": Case(motion, pose(np.eye(3), PLACE), lambda x: orthonormal(x[:3, :3]), per_step=8),
}


def test_rounding_does_not_grow_whatever_the_angle(subtests):
    """In one solve of all of them, of which none depends on another."""

    def field(t, y, angle):
        return {name: case.field(angle, y[name]) for name, case in CASES.items()}

    @jax.jit
    @jax.vmap
    def off(angle):
        ys: Any = cfjax.integrate(
            cfjax.LieTerm(field),
            cfjax.LieEuler(),
            0.0,
            float(NUM_STEPS),
            {name: jnp.asarray(case.start) for name, case in CASES.items()},
            angle,
            num_steps=NUM_STEPS,
            save_every=NUM_STEPS // 20,
            throw=False,
        ).ys
        return {name: jax.vmap(case.off)(ys[name]) for name, case in CASES.items()}

    steps = np.arange(1, 21) * (NUM_STEPS // 20)
    for name, found in off(jnp.asarray(ANGLES)).items():
        case = CASES[name]
        # Some roundings of a flow of norm 20.
        bound = case.condition * 1e-13 + case.per_step * np.finfo(np.float64).eps * steps
        with subtests.test(case=name):
            np.testing.assert_array_less(found, np.broadcast_to(bound, found.shape))


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [cfjax.CF4(), cfjax.Magnus2(), cfjax.ImplicitMidpoint()], ids=repr
)
def test_lengths_in_other_methods(solver):
    """One flow of a fast spin turns a quaternion by more than half a turn."""
    term = cfjax.LieTerm(lambda t, q, angle: quaternion(angle, q))
    for angle in (4.0, 7.0):
        y = cfjax.integrate(term, solver, 0.0, 500.0, jnp.asarray(Q), angle, num_steps=500).ys[-1]
        # Some roundings.
        assert abs(y @ y - 1) < 1e-14
