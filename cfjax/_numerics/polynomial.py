"""Evaluation of polynomials with constant coefficients."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Inexact


def polynomial(
    coefficients: Sequence[float], x: Inexact[Array, "*batch"]
) -> Inexact[Array, "*batch"]:
    """`sum_j coefficients[j] x^j` by Estrin's scheme: its chains of dependent operations are
    shorter than those of Horner's."""
    terms: list = [jnp.asarray(a, x.dtype) for a in coefficients]
    while len(terms) > 1:
        pairs = [terms[i] + terms[i + 1] * x for i in range(0, len(terms) - 1, 2)]
        terms = pairs + terms[len(pairs) * 2 :]
        x = x * x
    return terms[0]
