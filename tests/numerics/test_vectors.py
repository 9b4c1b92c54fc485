"""Short vectors by their entries, against NumPy's products of arrays."""

import numpy as np
from xla.interpreter import run

from cfjax._numerics.vectors import cross, dot, entries, pack, placed, plus

A, B = np.random.default_rng(0).normal(size=(2, 3, 5))


def test_products_of_vectors_and_of_columns():
    for a, b in ((A, B), (A[:, 0], B[:, 0])):
        found = run(lambda a, b: [f(entries(a), entries(b)) for f in (cross, dot, plus)], a, b)
        wants = np.cross(a, b, axis=0), np.sum(a * b, axis=0), a + b
        for got, want in zip(found, wants, strict=True):
            np.testing.assert_allclose(got, want, rtol=0, atol=1e-15)


def test_entries_put_together_and_at_places():
    for axis in (0, 1):
        found = run(lambda a, axis=axis: pack(entries(a), axis), A)
        np.testing.assert_array_equal(found, np.stack(A, axis))
    places = (3, 0, 1, 2)
    found = placed([10, 11, 12, 13], places)
    assert found == [11, 12, 13, 10]
    assert [found[k] for k in places] == [10, 11, 12, 13]
