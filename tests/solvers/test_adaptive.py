"""Solvers with an error estimate are what diffrax calls adaptive, and no others."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from solver_table import solvers

import cfjax

METHODS = solvers("commutator-free", "low-storage", "Munthe-Kaas")


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", METHODS)
def test_a_solver_with_an_estimate_is_adaptive(name):
    row = METHODS[name]
    solver, field, y0 = row.make(), problems.rigid_body, jnp.ones(3)
    if row.takes == "columns":
        field, y0 = lambda t, y, args: cfjax.LowRankSkew(args[:2][None] * y), jnp.eye(3)[:, :2]

    def error(y):
        term, times = cfjax.LieTerm(field), (jnp.asarray(0.0), jnp.asarray(0.1))
        return problems.first_step(solver, term, *times, y, jnp.ones(3))[1]

    has_estimate = jax.eval_shape(error, y0) is not None
    assert has_estimate == (row.embedded is not None)
    assert isinstance(solver, diffrax.AbstractAdaptiveSolver) == has_estimate


@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
@pytest.mark.parametrize("dtype", [jnp.complex64, jnp.complex128])
@pytest.mark.parametrize(
    "solver",
    [
        cfjax.CF54(),
        cfjax.RKMK5(),
        cfjax.RKMK5(coordinates="projected"),
        cfjax.Richardson(cfjax.CF4()),
    ],
    ids=["CF54", "RKMK5", "projected", "Richardson"],
)
def test_a_step_without_a_value_is_taken_again_where_the_state_is_complex(solver, dtype):
    """A step too long leads to the root of a negative number."""

    def field(t, y, args):
        return -jax.lax.complex(jnp.sqrt(y.real), jnp.zeros_like(y.real))

    tolerance = 1e-4
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(field),
        solver,
        0.0,
        1.5,
        1.5,
        jnp.ones(2, dtype),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance),
        max_steps=100,
    )
    assert sol.stats["num_rejected_steps"] > 0
    # The root of y falls by half of the time, and errors of earlier steps fall with it. There are
    # about ten steps.
    np.testing.assert_allclose(sol.ys[-1], (1 - 0.75) ** 2, rtol=0, atol=10 * tolerance)
