"""Small arrays as single numbers."""

import jax
import jax.numpy as jnp
import numpy as np

from cfjax._xla.numbers import Numbers, array_of, join, split, static_value


def test_split_and_join():
    given = [jnp.arange(3.0), jnp.ones((4, 3)), jnp.ones(200), jnp.asarray(2.0), jnp.zeros(0)]
    parts = split(given)
    assert [isinstance(x, Numbers) for x in parts] == [True, True, False, False, False]
    assert len(jax.tree.leaves(parts[1])) == 12
    assert all(x is y for x, y in zip(parts[2:], given[2:], strict=True))
    jax.tree.map(np.testing.assert_array_equal, join(parts), given)


def test_what_is_known():
    known = array_of([np.asarray(3), np.asarray(5)], (2, 1))
    np.testing.assert_array_equal(static_value(known), [[3], [5]])
    assert static_value(array_of([np.asarray(3), jnp.asarray(5)], (2,))) is None
    assert static_value(jnp.asarray(5)) is None
    # The dtype of no entries is not known, and no indices would be numbers with a fraction.
    assert static_value(array_of([], (0,))) is None
