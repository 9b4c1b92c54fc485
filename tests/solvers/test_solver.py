"""What a solver may tell `cfjax.integrate`: one of a user, and one of diffrax."""

from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax


class ExponentialMidpoint(cfjax.AbstractSolver):
    """`y' = a(t) y` by `exp(h a(t + h/2))`, of a user who tells `integrate` what it asks."""

    length: Any = None
    term_structure = diffrax.ODETerm
    interpolation_cls = diffrax.LocalLinearInterpolation

    @property
    def is_symmetric(self):
        return True

    @property
    def shows_failure(self):
        return True

    def order(self, terms):
        return 2

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def for_equal_steps(self, terms, length, t0, y0, args):
        return ExponentialMidpoint(length)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        # Backwards in time the length has another sign.
        length = t1 - t0 if self.length is None else jnp.sign(t1 - t0) * self.length
        y1 = y0 * jnp.exp(length * terms.vf((t0 + t1) / 2, jnp.ones_like(y0), args))
        return y1, None, dict(y0=y0, y1=y1), None, diffrax.RESULTS.successful


def test_an_abstract_solver_of_a_users_own_in_integrate():
    term = diffrax.ODETerm(lambda t, y, args: args * jnp.cos(t) * y)
    y0, n, h = jnp.array([1.0, -2.0]), 20, 0.05
    # The midpoint rule for the integral of cos, in NumPy.
    middles = h * (np.arange(n) + 0.5)
    factor = np.exp(0.7 * h * np.cos(middles).sum())

    def end(a, step_back):
        sol = cfjax.integrate(
            term, ExponentialMidpoint(), 0.0, 1.0, y0, a, num_steps=n, step_back=step_back
        )
        return jnp.sum(sol.ys)

    for step_back in (False, True):
        run = jax.value_and_grad(partial(end, step_back=step_back))
        value, slope = eqx.filter_jit(run)(0.7)
        # A unit of rounding in each of 20 steps.
        np.testing.assert_allclose(value, -factor, rtol=20 * 2.0**-52)
        expected = -factor * h * np.cos(middles).sum()
        np.testing.assert_allclose(slope, expected, rtol=100 * 2.0**-52)
        # The length of a step was asked for.
        assert "sign" in str(jax.make_jaxpr(partial(end, step_back=step_back))(0.7))
    # It shows that it failed by its state alone.
    with pytest.raises(eqx.EquinoxRuntimeError, match="grows without bound"):
        end(1e6, False)


def test_a_solver_of_diffrax_is_not_symmetric():
    with pytest.raises(ValueError, match=r"step_back takes a symmetric solver.*got Tsit5"):
        cfjax.integrate(
            diffrax.ODETerm(lambda t, y, args: -y),
            diffrax.Tsit5(),
            0.0,
            1.0,
            jnp.ones(2),
            num_steps=3,
            step_back=True,
        )
