"""Output at the ends of a step, and the refusal in between."""

from typing import Any

import diffrax
import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest

import cfjax


def interpolation(t0, t1, y0: Any = (1.0, 2.0), y1: Any = (3.0, 5.0), dtype=jnp.float64):
    """That of CG4, made as diffrax makes it."""
    y0, y1 = jnp.asarray(y0, dtype), jnp.asarray(y1, dtype)
    times = jnp.asarray(t0, dtype), jnp.asarray(t1, dtype)
    made = cfjax.CG4().interpolation_cls(t0=times[0], t1=times[1], y0=y0, y1=y1)
    assert isinstance(made, diffrax.AbstractLocalInterpolation)
    return made


REFUSAL = r"no output between steps.*StepTo\(ts\).*root finder"
STEPS = [(0.0, 1.0), (1.0, 0.0), (0.1, 0.1 + 1e-6), (-1e6, -1e6 - 0.1), (0.0, 1e-300), (5.0, 5.5)]


@pytest.mark.parametrize("t0, t1", STEPS)
@pytest.mark.parametrize("as_time", [float, np.float64, jnp.asarray])
def test_both_ends_are_given_back_to_the_bit(t0, t1, as_time):
    found = interpolation(t0, t1)
    for left in (True, False):
        assert found.evaluate(as_time(t0), left=left).tolist() == [1.0, 2.0]
        assert found.evaluate(as_time(t1), left=left).tolist() == [3.0, 5.0]
    assert found.evaluate(as_time(t0), as_time(t1)).tolist() == [2.0, 3.0]
    assert found.evaluate(as_time(t1), as_time(t0)).tolist() == [-2.0, -3.0]
    assert found.evaluate(as_time(t1), as_time(t1)).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("t0, t1", [(0.0, 1.0), (1.0, 0.0), (5.0, 5.5), (-3.0, -2.0)])
def test_an_end_up_to_rounding_is_an_end(t0, t1):
    """Times are sums of step sizes: a last bit or two is no other time."""
    found = interpolation(t0, t1)
    for k in (-2, 2):
        # Around zero the unit is that of the other end: t0 + (t1 - t0) is no better.
        unit = np.spacing(max(abs(t0), abs(t1)))
        assert found.evaluate(t0 + k * unit).tolist() == [1.0, 2.0]
        assert found.evaluate(t1 + k * unit).tolist() == [3.0, 5.0]


@pytest.mark.parametrize("t0, t1", [(0.0, 1.0), (1.0, 0.0), (5.0, 5.5), (0.1, 0.1 + 1e-6)])
@pytest.mark.parametrize("theta", [0.5, 1e-6, 1 - 1e-6, -1e-6, 1 + 1e-6, 2.0])
def test_every_other_time_is_an_error(t0, t1, theta):
    found = interpolation(t0, t1)
    t = t0 + theta * (t1 - t0)
    with pytest.raises(eqx.EquinoxRuntimeError, match=REFUSAL):
        found.evaluate(t)
    with pytest.raises(eqx.EquinoxRuntimeError, match=REFUSAL):
        found.evaluate(t0, t)
    with pytest.raises(eqx.EquinoxRuntimeError, match=REFUSAL):
        found.evaluate(t, t1)


def test_a_time_that_is_no_number_is_an_error():
    for t in (np.nan, np.inf, -np.inf):
        with pytest.raises(eqx.EquinoxRuntimeError, match=REFUSAL):
            interpolation(0.0, 1.0).evaluate(t)


_evaluate = eqx.filter_jit(
    lambda t0, t1, t: interpolation(t0, t1).evaluate(jnp.asarray(t, jnp.float64))
)


@hypothesis.given(
    t0=st.floats(-1e6, 1e6),
    h=st.floats(1e-3, 1e3),
    sign=st.sampled_from([-1, 1]),
    theta=st.floats(0, 1),
)
@hypothesis.settings(deadline=None, max_examples=200)
def test_a_number_comes_only_from_an_end(t0, h, sign, theta):
    """Whatever comes back was asked for within rounding of an end, and is the value there."""
    t1 = t0 + sign * h
    t = t0 + theta * (t1 - t0)
    try:
        value = _evaluate(np.float64(t0), np.float64(t1), np.float64(t)).tolist()
    except eqx.EquinoxRuntimeError:
        assert t not in (t0, t1)
    else:
        near = t0 if value == [1.0, 2.0] else t1
        assert value in ([1.0, 2.0], [3.0, 5.0])
        # Not further than a few units of rounding: far below the step, 1e-3 at least.
        assert abs(t - near) <= 16 * np.spacing(max(abs(t0), abs(t1)))


def test_single_precision():
    found = interpolation(0.0, 0.1, dtype=jnp.float32)
    for t, value in [(0.0, [1.0, 2.0]), (np.float32(0.1), [3.0, 5.0])]:
        y = found.evaluate(jnp.asarray(t, jnp.float32))
        assert y.dtype == jnp.float32 and y.tolist() == value
    with pytest.raises(eqx.EquinoxRuntimeError, match=REFUSAL):
        found.evaluate(jnp.asarray(0.0999, jnp.float32))


def test_a_pytree_in_a_batch():
    def evaluate(t):
        made = cfjax.CG4().interpolation_cls(
            t0=jnp.asarray(0.0),
            t1=jnp.asarray(1.0),
            y0={"a": jnp.zeros(3), "b": (jnp.zeros((2, 2)),)},
            y1={"a": jnp.ones(3), "b": (jnp.ones((2, 2)),)},
        )
        return made.evaluate(t)

    found = jax.vmap(evaluate)(jnp.asarray([0.0, 1.0, 1.0]))
    for leaf in jtu.tree_leaves(found):
        np.testing.assert_array_equal(leaf.reshape(3, -1).max(axis=1), [0, 1, 1])
    # One bad time in a batch is an error for the batch, not a number among numbers.
    with pytest.raises(eqx.EquinoxRuntimeError, match=REFUSAL):
        jax.vmap(evaluate)(jnp.asarray([0.0, 0.5, 1.0]))


def test_a_gradient_passes_through_the_ends():
    def value(y0, y1, t):
        return jnp.sum(interpolation(0.0, 1.0, y0, y1).evaluate(t) ** 2)

    y0, y1 = jnp.asarray([1.0, 2.0]), jnp.asarray([3.0, 5.0])
    for t, expected in [(0.0, (2 * y0, 0 * y1)), (1.0, (0 * y0, 2 * y1))]:
        found = jax.grad(value, (0, 1))(y0, y1, t)
        np.testing.assert_array_equal(found, expected)


def test_the_derivative_in_time_is_an_error_between_the_ends():
    with pytest.raises(eqx.EquinoxRuntimeError, match=REFUSAL):
        interpolation(0.0, 1.0).derivative(0.5)
