"""What Rotation refuses: test_contract.py has what it does."""

import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax import Rotation


def test_refuses(no_shape_hook, subtests):
    one = Rotation(np.ones(3))
    shapes = r"acts on shapes \(3,\) and \(3, k\), got"
    cases = [
        *(
            (lambda x=x: Rotation(x), ValueError, r"must have shape \(3,\) or \(\*batch, 3\), got")
            for x in (np.ones(4), np.ones((3, 1)), np.ones(()), np.ones((0,)))
        ),
        *(
            (lambda t=t: Rotation(jnp.ones(3, t)), TypeError, "omega must be float32 or float64, g")
            for t in (np.int32, np.float16, jnp.bfloat16, np.complex128, np.bool_)
        ),
        *(
            (lambda f=f, x=x: f(jnp.ones(x)), ValueError, f"Rotation .* {shapes}")
            for f in (one.flow, one.increment, one.mean, one.tangent)
            for x in [(), (2,), (4,), (2, 3), (3, 2, 2)]
        ),
        (
            lambda: one.flow(jnp.ones(3, complex)),
            TypeError,
            "Rotation acts on real arrays, got complex128",
        ),
        (
            lambda: one.bracket(cfjax.LeftMatrix(np.eye(3))),
            TypeError,
            "Cannot compute the bracket of Rotation and LeftMatrix: both must be of one class",
        ),
    ]
    for k, (call, error, text) in enumerate(cases):
        with subtests.test(case=f"{k}: {text}"), pytest.raises(error, match=text):
            call()
