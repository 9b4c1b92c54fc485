"""Reference answers, computed once for all solver tests."""

import numpy as np
import problems
import pytest


@pytest.fixture(scope="session")
def matrix_problems():
    """Field, initial value, args and the answer at t = 1, for both sides of the action."""

    def left(t, y):
        y = y.reshape(4, 4)
        return (problems.generator(np, t, y, problems.GENERATORS) @ y).ravel()

    def right(t, y):
        y = y.reshape(4, 4)
        return (y @ problems.generator(np, t, y, problems.GENERATORS)).ravel()

    start = problems.ORTHOGONAL
    return {
        name: (
            field,
            start,
            problems.GENERATORS,
            problems.reference(ode, 0.0, 1.0, start.ravel()),
        )
        for name, field, ode in [
            ("left", problems.left_matrix, left),
            ("right", problems.right_matrix, right),
        ]
    }


@pytest.fixture(scope="session")
def flight_problem():
    """The same for a product of manifolds."""
    answer = problems.reference(
        lambda t, y: problems.body_in_flight_ode(t, y, problems.FLIGHT_ARGS),
        0.0,
        1.0,
        problems.flat(problems.FLIGHT_START),
    )
    return problems.body_in_flight, problems.FLIGHT_START, problems.FLIGHT_ARGS, answer


@pytest.fixture(scope="session")
def body_problem():
    """The same for a driven rigid body, on the sphere."""
    answer = problems.reference(
        lambda t, y: problems.driven_body_ode(t, y, problems.INERTIA), 0.0, 1.0, problems.MOMENTUM
    )
    return problems.driven_body, problems.MOMENTUM, problems.INERTIA, answer


@pytest.fixture(scope="session")
def driven_top_answer():
    """Angular momentum and attitude of the driven top at t = 1."""
    start = np.concatenate([problems.DRIVEN_TOP_START["m"], np.eye(3).ravel()])
    return problems.reference(problems.driven_top_ode, 0.0, 1.0, start)
