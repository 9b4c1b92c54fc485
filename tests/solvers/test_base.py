"""What diffrax sees of a solver: an instance, times that are numbers, and error estimates."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from solver_table import solvers

import cfjax

Y0, ARGS = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)
TERM = cfjax.LieTerm(problems.driven_body)


def test_a_class_in_place_of_a_solver_is_refused():
    for solver in (cfjax.CF4, cfjax.RKMK4, cfjax.CayleyRK4):
        message = rf"must be an instance, {solver.__name__}\(\), got the class"
        with pytest.raises(AttributeError, match=message):
            diffrax.diffeqsolve(TERM, solver, 0.0, 1.0, 0.1, Y0, ARGS)


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("term", "solver", "y0"),
    [
        (cfjax.LieTerm(lambda t, y, args: -y), cfjax.LieEuler(), Y0),
        (TERM, cfjax.Richardson(cfjax.RKMK4()), Y0),
        (
            cfjax.LieTerm(lambda t, y, args: cfjax.LowRankSkew(jnp.zeros_like(y))),
            *(cfjax.CF43(), jnp.eye(3)[:, :2]),
        ),
    ],
    ids=["LieEuler", "Richardson", "Stiefel"],
)
def test_a_time_that_is_nan_is_an_error(term, solver, y0):
    """diffrax makes no step to it, and returns the start as a success."""
    for t0, t1 in ((jnp.nan, 1.0), (0.0, jnp.nan)):
        with pytest.raises(
            eqx.EquinoxRuntimeError, match="t0, t1 and dt0 must be numbers, got NaN"
        ):
            diffrax.diffeqsolve(term, solver, jnp.asarray(t0), jnp.asarray(t1), 0.5, y0, ARGS)


def test_a_solver_with_an_estimate_is_adaptive():
    """That these have one by their step as well is in test_solver_table.py."""
    for row in solvers("commutator-free", "low-storage", "Munthe-Kaas").values():
        is_adaptive = isinstance(row.make(), diffrax.AbstractAdaptiveSolver)
        assert is_adaptive == (row.embedded is not None)


@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
@pytest.mark.parametrize(
    "solver, dtype",
    [
        (cfjax.CF4(), jnp.complex64),
        pytest.param(cfjax.Richardson(cfjax.CF4()), jnp.complex128, marks=pytest.mark.slow),
    ],
    ids=["CF4", "Richardson"],
)
def test_a_step_without_a_value_is_taken_again_where_the_state_is_complex(solver, dtype):
    """A step too long leads to the root of a negative number, in the last stage of CF4."""

    def field(t, y, args):
        return -jax.lax.complex(jnp.sqrt(y.real), jnp.zeros_like(y.real))

    tolerance = 1e-4
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(field),
        solver,
        *(jnp.asarray(t, jnp.finfo(dtype).dtype) for t in (0.0, 1.5, 1.5)),
        jnp.ones(2, dtype),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance),
        max_steps=100,
    )
    assert sol.stats["num_rejected_steps"] > 0
    assert sol.ys.dtype == dtype
    # The root of y falls by half of the time, and errors of earlier steps fall with it. There are
    # about ten steps.
    np.testing.assert_allclose(sol.ys[-1], (1 - 0.75) ** 2, rtol=0, atol=10 * tolerance)
