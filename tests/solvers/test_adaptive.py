"""Solvers with an error estimate are what diffrax calls adaptive, and no others."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import problems
import pytest

import cfjax

NAMES = """LieEuler CF2 CF3 CF4 CF43 CF54 CG3 CG4 CG5 BWRRK33 BWRRK53 CFEES25 CFEES27 CK34 CK54
    Luscher3 Williamson3 YRK135 RKMK3 RKMK4 RKMK5 RKMK8"""
SOLVERS: dict[str, Any] = {name: getattr(cfjax, name)() for name in NAMES.split()}
SOLVERS["CommutatorFree"] = cfjax.CommutatorFree(cfjax.CF3().tableau)
SOLVERS["RKMK"] = cfjax.RKMK(diffrax.Heun.tableau)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_with_an_estimate_is_adaptive(name):
    def error(y):
        term, times = cfjax.LieTerm(problems.rigid_body), (jnp.asarray(0.0), jnp.asarray(0.1))
        return problems.first_step(SOLVERS[name], term, *times, y, jnp.ones(3))[1]

    has_estimate = jax.eval_shape(error, jnp.ones(3)) is not None
    assert isinstance(SOLVERS[name], diffrax.AbstractAdaptiveSolver) == has_estimate
