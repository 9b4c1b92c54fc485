"""Matrix fields: mixed dtypes, orthogonality, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from matrices import of_norm, random

from cfjax import LeftMatrix, RightMatrix

BOTH = (LeftMatrix, RightMatrix)


def act(cls, matrix, point):
    return matrix @ point if cls is LeftMatrix else point @ matrix


def test_real_matrices_act_on_vectors_and_complex_points():
    real, wide = (np.float32, np.float64), (np.complex64, np.complex128)
    a = {dtype: of_norm("general", 4, 2.0, dtype=dtype) for dtype in real}
    points = {
        (cls, dtype, is_complex, shape[:k]): random(
            shape[:k], 1, dict(zip(real, wide, strict=True))[dtype] if is_complex else dtype
        )
        for cls, shape in ((LeftMatrix, (4, 2)), (RightMatrix, (4, 4)))
        # The others are in test_contract.py.
        for dtype, is_complex in ((np.float32, True), (np.float64, True), (np.float64, False))
        for k in (1, 2)
        if cls is RightMatrix or is_complex
    }

    @jax.jit
    def motions(matrices, points):
        return [
            (cls(a).flow(x), cls(a).tangent(x))
            for (cls, *_), a, x in zip(keys, matrices, points, strict=True)
        ]

    keys = list(points)
    found = motions([a[dtype] for _, dtype, *_ in keys], list(points.values()))
    for (key, point), (end, tangent) in zip(points.items(), found, strict=True):
        cls, dtype, *_ = key
        assert end.dtype == tangent.dtype == point.dtype
        want = act(cls, scipy.linalg.expm(a[dtype].astype(float)), point)
        # The condition of exp at norm 2 is below e^4 = 55 relative to the result. A backward error
        # of one unit, and as much for the product.
        atol = 8 * np.finfo(dtype).eps * np.exp(2.0) * np.linalg.norm(point)
        np.testing.assert_allclose(end, want, rtol=0, atol=atol, err_msg=str(key))
        want = act(cls, a[dtype], point)
        np.testing.assert_allclose(tangent, want, rtol=0, atol=atol, err_msg=str(key))


def test_skew_is_orthogonal_and_inverse_is_exact():
    flows = jax.jit(lambda a, x: [cls(a).flow(x) for cls in BOTH])
    for norm in (0.0, 1e-9, 1.0, 30.0):
        a = of_norm("skew", 4, norm)
        there = flows(a, np.eye(4))
        # Normal matrices: each of at most five squarings of norm 1 doubles the error.
        atol = 2**6 * 4 * 2.0**-52
        for k, q in enumerate(map(np.asarray, there)):
            np.testing.assert_allclose(q.T @ q, np.eye(4), rtol=0, atol=atol)
            np.testing.assert_allclose(flows(-a, q)[k], np.eye(4), rtol=0, atol=atol)


def test_refuses(no_shape_hook, subtests):
    shapes = r"a must have shape \(n, n\) or \(\*batch, n, n\), got"
    dtypes = "a must be float32, float64, complex64 or complex128, got"
    cases = [
        *((lambda c, x=x: c(jnp.ones(x)), ValueError, shapes) for x in [(), (3,), (2, 3)]),
        (lambda c: c(jnp.ones((2, 2, 3))), ValueError, shapes),
        *(
            (lambda c, t=t: c(jnp.ones((2, 2), t)), TypeError, dtypes)
            for t in (np.int32, np.float16, np.bool_)
        ),
        *(
            (lambda c, x=x: c(np.eye(3)).tangent(jnp.ones(x)), ValueError, "Matrix with a of shape")
            for x in [(), (2,), (2, 2), (3, 3, 3)]
        ),
        *(
            (lambda c, t=t: c(np.eye(3)).flow(jnp.ones(3, t)), Exception, "promotion")
            for t in (np.complex64, np.float32)
        ),
    ]
    for cls in BOTH:
        for k, (call, error, text) in enumerate(cases):
            with subtests.test(case=(cls.__name__, k, text)), pytest.raises(error, match=text):
                call(cls)
