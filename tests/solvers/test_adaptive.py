"""Solvers with an error estimate are what diffrax calls adaptive, and no others."""

import diffrax
import jax
import jax.numpy as jnp
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
        field, y0 = lambda t, y, args: cfjax.LowRankSkew(args[:2] * y), jnp.eye(3)[:, :2]

    def error(y):
        term, times = cfjax.LieTerm(field), (jnp.asarray(0.0), jnp.asarray(0.1))
        return problems.first_step(solver, term, *times, y, jnp.ones(3))[1]

    has_estimate = jax.eval_shape(error, y0) is not None
    assert has_estimate == (row.embedded is not None)
    assert isinstance(solver, diffrax.AbstractAdaptiveSolver) == has_estimate
