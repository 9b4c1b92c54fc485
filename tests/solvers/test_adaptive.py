"""Solvers with an error estimate are what diffrax calls adaptive, and no others."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solver_table import solvers

import cfjax


def test_a_solver_with_an_estimate_is_adaptive():
    """That these have one by their step as well is in test_solver_table.py."""
    for row in solvers("commutator-free", "low-storage", "Munthe-Kaas").values():
        is_adaptive = isinstance(row.make(), diffrax.AbstractAdaptiveSolver)
        assert is_adaptive == (row.embedded is not None)


@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
@pytest.mark.parametrize(
    "solver, dtype",
    [
        (cfjax.CF54(), jnp.complex64),
        (cfjax.Richardson(cfjax.CF4()), jnp.complex128),
        pytest.param(cfjax.RKMK5(), jnp.complex128, marks=pytest.mark.slow),
        pytest.param(cfjax.RKMK5(coordinates="projected"), jnp.complex64, marks=pytest.mark.slow),
    ],
    ids=["CF54", "Richardson", "RKMK5", "projected"],
)
def test_a_step_without_a_value_is_taken_again_where_the_state_is_complex(solver, dtype):
    """A step too long leads to the root of a negative number."""

    def field(t, y, args):
        return -jax.lax.complex(jnp.sqrt(y.real), jnp.zeros_like(y.real))

    tolerance = 1e-4
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(field),
        solver,
        *(0.0, 1.5, 1.5, jnp.ones(2, dtype)),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance),
        max_steps=100,
    )
    assert sol.stats["num_rejected_steps"] > 0
    # The root of y falls by half of the time, and errors of earlier steps fall with it. There are
    # about ten steps.
    np.testing.assert_allclose(sol.ys[-1], (1 - 0.75) ** 2, rtol=0, atol=10 * tolerance)
