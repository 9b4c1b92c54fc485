"""The start of a solve: an instance of a solver, and times that are numbers."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import problems
import pytest

import cfjax

Y0, ARGS = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)
TERM = cfjax.LieTerm(problems.driven_body)


def test_a_class_in_place_of_a_solver_is_refused():
    for solver in (cfjax.CF4, cfjax.RKMK4, cfjax.CayleyRK4):
        message = rf"must be an instance, {solver.__name__}\(\), got the class"
        with pytest.raises(AttributeError, match=message):
            diffrax.diffeqsolve(TERM, solver, 0.0, 1.0, 0.1, Y0, ARGS)


def still(t, y, args):
    return cfjax.LowRankSkew(jnp.zeros_like(y))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("bad", ["t0", "t1"])
@pytest.mark.parametrize(
    ("term", "solver", "y0"),
    [
        (TERM, cfjax.CF4(), Y0),
        (TERM, cfjax.Richardson(cfjax.RKMK4()), Y0),
        (cfjax.LieTerm(lambda t, y, args: -y), cfjax.CF4(), Y0),
        (cfjax.LieTerm(lambda t, y, args: -y), cfjax.RKMK3(), Y0),
        (cfjax.LieTerm(still), cfjax.CF43(), jnp.eye(3)[:, :2]),
    ],
    ids=["CF4", "Richardson", "same as last", "plain", "Stiefel"],
)
def test_a_time_that_is_nan_is_an_error(bad, term, solver, y0):
    """diffrax makes no step to it, and returns the start as a success."""
    t0, t1 = (jnp.nan if name == bad else t for name, t in (("t0", 0.0), ("t1", 1.0)))
    with pytest.raises(eqx.EquinoxRuntimeError, match="t0, t1 and dt0 must be numbers, got NaN"):
        diffrax.diffeqsolve(term, solver, t0, t1, 0.5, y0, ARGS)
