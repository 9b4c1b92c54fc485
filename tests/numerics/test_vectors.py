"""Short vectors by their entries, against NumPy's products of arrays."""

import jax.numpy as jnp
import numpy as np

from cfjax._numerics.vectors import cross, dot, entries, pack, placed, plus

A, B = np.random.default_rng(0).normal(size=(2, 3, 5))


def test_products_of_vectors_and_of_columns():
    for a, b in ((A, B), (A[:, 0], B[:, 0])):
        xs, ys = entries(jnp.asarray(a)), entries(jnp.asarray(b))
        np.testing.assert_allclose(cross(xs, ys), np.cross(a, b, axis=0), rtol=0, atol=1e-15)
        np.testing.assert_allclose(dot(xs, ys), np.sum(a * b, axis=0), rtol=0, atol=1e-15)
        np.testing.assert_array_equal(plus(xs, ys), a + b)


def test_entries_put_together_and_at_places():
    for axis in (0, 1):
        np.testing.assert_array_equal(pack(entries(jnp.asarray(A)), axis), np.stack(A, axis))
    places = (3, 0, 1, 2)
    found = placed([10, 11, 12, 13], places)
    assert found == [11, 12, 13, 10]
    assert [found[k] for k in places] == [10, 11, 12, 13]
