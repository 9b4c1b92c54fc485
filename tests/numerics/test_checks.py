"""Errors of values: which message, in batches, and what a check leaves of derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfjax._numerics.checks import Fault, differ, error_if, needing

X, ZERO = jnp.asarray([1.0, 2.0]), jnp.zeros(())


def fault_of(x):
    """Two cases, of which the second is worse."""
    return Fault.none().with_case(x > 1, "above one").with_case(x > 2, "above two")


def test_the_worst_case_of_a_fault_is_its_number_and_an_error_with_its_message():
    for x, number, message in ((0.0, 0, None), (1.5, 1, "above one"), (2.5, 2, "above two")):
        assert fault_of(jnp.asarray(x)).number == number
        if message:
            with pytest.raises(eqx.EquinoxRuntimeError, match=message):
                raised(jnp.asarray(x))


raised = eqx.filter_jit(lambda x: fault_of(x).error(ZERO))


def test_no_fault_is_no_error():
    assert Fault.none().error(ZERO) == 0
    assert fault_of(jnp.asarray(0.0)).error(ZERO) == 0


def test_a_batch_has_the_error_of_its_last_case_and_nan_by_itself():
    xs = jnp.asarray([0.0, 1.5, 2.5])
    with pytest.raises(eqx.EquinoxRuntimeError, match="above two"):
        jax.vmap(lambda x: fault_of(x).error(ZERO))(xs)
    found = jax.vmap(lambda x: fault_of(x).nan(ZERO))(xs)
    np.testing.assert_array_equal(found, [0, np.nan, np.nan])


def checked(x):
    return error_if(x, lambda x: jnp.any(x > 3), "above three")


def test_a_check_gives_back_the_same_arrays_or_an_error_alone_and_in_a_batch():
    np.testing.assert_array_equal(eqx.filter_jit(checked)(X), X)
    with pytest.raises(eqx.EquinoxRuntimeError, match="above three"):
        eqx.filter_jit(checked)(2 * X)
    np.testing.assert_array_equal(jax.vmap(checked)(jnp.stack([X, -X])), [X, -X])
    with pytest.raises(eqx.EquinoxRuntimeError, match="above three"):
        jax.vmap(checked)(jnp.stack([X, 2 * X]))


def test_derivatives_and_the_transpose_of_a_check_are_those_of_the_identity():
    np.testing.assert_array_equal(jax.jacfwd(checked)(X), np.eye(2))
    np.testing.assert_array_equal(jax.jacrev(checked)(X), np.eye(2))
    (found,) = jax.linear_transpose(checked, X)(5 * X)
    np.testing.assert_array_equal(found, 5 * X)


def test_arrays_that_need_a_check():
    np.testing.assert_array_equal(needing(ZERO, X), X)
    assert np.isnan(needing(jnp.asarray(np.nan), X)).all()


def test_arrays_that_differ():
    for a, b, expected in (
        ([1.0, 2.0], [1.0, 2.0], False),
        ([1.0, 2.0], [1.0, 3.0], True),
        ([1.0, np.nan], [1.0, np.nan], False),
        ([1.0, np.nan], [1.0, 2.0], True),
    ):
        assert bool(differ(jnp.asarray(a), jnp.asarray(b))) == expected, (a, b)
