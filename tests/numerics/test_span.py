"""Spans of columns and orthonormal columns, against products of whole matrices in NumPy."""

import jax.numpy as jnp
import numpy as np
from matrices import random
from xla.interpreter import run

from cfjax._numerics.span import (
    Corner,
    Span,
    correction,
    inner,
    joined,
    orthonormal_defect,
    plus_product,
    square,
)

N, P = 7, 2
FIRST, SECOND, THIRD = (jnp.asarray(random((N, P), seed)) for seed in range(3))
BLOCKS = {"columns": (FIRST, SECOND), "corner": (Corner(P), FIRST, SECOND), "vectors": None}
BLOCKS["vectors"] = (FIRST[:, :1], SECOND[:, :1])


def whole(blocks):
    """The columns as one matrix."""
    columns = [np.eye(N, x.p) if isinstance(x, Corner) else np.asarray(x) for x in blocks]
    return np.concatenate(columns, axis=1)


def made(*blocks):
    w = whole(blocks)
    return Span(blocks, jnp.asarray(w.T @ w))


def test_products_with_the_columns_and_extended_spans(subtests):
    for kind, blocks in BLOCKS.items():
        w, x = whole(blocks), random((N, P), 5)
        z = random((w.shape[1], P), 6)
        both = lambda x, z, b=blocks: (inner(b, x), plus_product(x, b, z))  # noqa: E731
        products, moved = run(both, x, z)
        span = made(*blocks).extended(THIRD)
        wider = whole(span.blocks)
        with subtests.test(case=kind):
            # Sums of seven products of numbers of size two.
            np.testing.assert_allclose(products, w.T @ x, rtol=0, atol=1e-14)
            np.testing.assert_allclose(moved, x + w @ z, rtol=0, atol=1e-14)
            np.testing.assert_array_equal(joined(blocks), w[:, P:] if kind == "corner" else w)
            np.testing.assert_array_equal(wider[:, -P:], THIRD)
            np.testing.assert_allclose(span.gram, wider.T @ wider, rtol=0, atol=1e-14)


def test_a_joint_span_has_each_block_once_and_the_corner_in_front():
    span = Span.joint([made(FIRST, SECOND), made(Corner(P), SECOND), made(THIRD)])
    assert isinstance(span.blocks[0], Corner)
    assert len(span.blocks) == 4
    assert {span.index(x) for x in (FIRST, SECOND, THIRD)} == {1, 2, 3}
    w = whole(span.blocks)
    np.testing.assert_allclose(span.gram, w.T @ w, rtol=0, atol=1e-14)
    # Another array with the same values is another block.
    assert span.index(FIRST + 0) == -1
    other = made(SECOND, FIRST)
    np.testing.assert_array_equal(w[:, span.column_indices(other)], whole(other.blocks))


def test_the_square_of_many_rows():
    y = random((1000, 3))
    np.testing.assert_allclose(square(jnp.asarray(y)), y.T @ y, rtol=0, atol=1e-11)


def test_the_correction_leads_to_the_nearest_orthonormal_columns():
    """The polar factor, from the singular values; one step leaves the square of the defect."""
    q = np.linalg.qr(random((N, 3)))[0]
    y = q + 1e-4 * random((N, 3), 1)
    u, _, v = np.linalg.svd(y, full_matrices=False)
    gram = jnp.asarray(y.T @ y)
    np.testing.assert_allclose(orthonormal_defect(gram), np.eye(3) - y.T @ y, rtol=0, atol=1e-15)
    found = y + y @ np.asarray(correction(gram))
    assert 1e-5 < np.abs(y - u @ v).max()
    np.testing.assert_allclose(found, u @ v, rtol=0, atol=1e-6)


def test_far_from_orthonormal_there_is_no_correction():
    assert np.isnan(correction(jnp.eye(2) * 1.2)).all()
