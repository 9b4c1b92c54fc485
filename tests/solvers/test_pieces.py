"""Methods for noise: a step follows pieces of a path, and what such methods refuse.

Their strong and weak orders are in noise/.
"""

from typing import Any

import brownian_paths as paths
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from solver_table import solvers

import cfjax

PIECES: Any = [row.make() for row in solvers("noise").values()]
Y0 = paths.SPHERE_START
W, H = np.array([0.4, -0.3]), np.array([0.05, 0.12])
GIVEN = paths.GivenStep(jnp.asarray(W), jnp.asarray(H))


def step(solver, term, y0=Y0, h=0.25):
    end = lambda h: problems.first_step(solver, term, 0.0 * h, h, y0, None)[0]  # noqa: E731
    with cfjax.rewriting(False):
        return problems.op_by_op(end, h)


# The parts of the time, of the increment W and of the area H in each piece, as published.
PUBLISHED = {
    "WeakOrder2": [(0.5, 0.5, np.sqrt(6)), (0.5, 0.5, -np.sqrt(6))],
    "ShiftedNoise": [
        (0.0, 0.0, np.sqrt(3) + 1),
        (1.0, 1.0, -2 * np.sqrt(3)),
        (0.0, 0.0, np.sqrt(3) - 1),
    ],
}


def test_a_step_along_constant_fields_is_a_product_of_exponentials(subtests):
    """Along a piece the field is constant, so every method follows it exactly."""
    drift, noise = np.array([0.5, -0.2, 0.7]), np.array([[0.3, -0.8], [1.1, 0.4], [-0.6, 0.9]])
    term = diffrax.MultiTerm(
        cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.asarray(drift))),
        cfjax.LieControlTerm(lambda t, y, args, dw: cfjax.Rotation(noise @ dw), GIVEN),
    )
    y0, h = np.array([0.6, 0.0, 0.8]), 0.25
    for solver in PIECES:
        name = type(solver).__name__
        expected = y0
        for time, increment, area in PUBLISHED[name]:
            omega = time * h * drift + noise @ (increment * W + area * H)
            expected = scipy.linalg.expm(np.cross(omega, np.eye(3)).T) @ expected
        with subtests.test(solver=name):
            # Ten flows of a few roundings.
            found = step(solver, term, jnp.asarray(y0), h)
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_wrong_solvers_terms_and_paths(no_shape_hook, subtests):
    plain = diffrax.UnsafeBrownianPath((2,), jax.random.key(0))
    smooth = diffrax.LinearInterpolation(jnp.arange(2.0), jnp.ones((2, 2)))
    for solver in PIECES:
        cls = type(solver)
        name = cls.__name__
        wrong = diffrax.Heun(), cfjax.Magnus4(), cfjax.Richardson(cfjax.CF4()), solver, None
        cases: list[Any] = [
            (solver, cfjax.LieTerm(paths.drift), f"{name} is for equations with noise, and no ter"),
            (solver, paths.terms(plain), "got levy_area=BrownianIncrement: write"),
            (solver, paths.terms(smooth), "got LinearInterpolation"),
            (cls(cfjax.CF3()), paths.terms(GIVEN), f"{name} needs a solver of order 4 where the n"),
        ]
        for made, term, message in cases:
            with subtests.test(case=(name, message)), pytest.raises(TypeError, match=message):
                cfjax.integrate(term, made, 0.0, 1.0, Y0, num_steps=2)
        with pytest.raises(ValueError, match="solver must have order 3 or more, got CF2"):
            cls(cfjax.CF2())
        for inner in wrong:
            with (
                subtests.test(case=(name, repr(inner))),
                pytest.raises(TypeError, match="solver must be a commutator-free or Munthe-Kaas"),
            ):
                cls(inner)


def test_the_noise_solver_of_shifted_noise(no_shape_hook):
    with pytest.raises(TypeError, match="noise_solver must be a commutator-free or Munthe-Kaas"):
        cfjax.ShiftedNoise(noise_solver=diffrax.Heun())
    low = cfjax.ShiftedNoise(noise_solver=cfjax.LieEuler())
    with pytest.raises(TypeError, match="ShiftedNoise needs a noise_solver of order 4 where"):
        step(low, paths.terms(GIVEN))

    def constant(t, y, args, dw):
        return {"y": cfjax.Rotation(jnp.concatenate([dw, dw[:1]]))}

    # One flow is exact for fields that do not depend on the state.
    term = diffrax.MultiTerm(cfjax.LieTerm(paths.drift), cfjax.LieControlTerm(constant, GIVEN))
    found, expected = step(low, term), step(cfjax.ShiftedNoise(noise_solver=cfjax.CF4()), term)
    np.testing.assert_allclose(found["y"], expected["y"], rtol=0, atol=1e-14)
