"""Fields stacked for a loop over stages: their combinations, and kinds that cannot be stacked."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax


def test_fields_of_different_kinds_are_an_error_in_words():
    def field(t, y, args):
        kinds.append(1)
        return cfjax.LeftMatrix(a) if len(kinds) < 4 else cfjax.RightMatrix(a)

    kinds, a = [], problems.GENERATORS[0]
    with pytest.raises(TypeError, match="Only fields of one kind can be added"):
        times = jnp.asarray(0.1), jnp.asarray(0.4)
        problems.first_step(cfjax.CF4(), cfjax.LieTerm(field), *times, jnp.eye(4), None)


def test_large_fields_are_combined_by_a_product():
    """These fields have 2500 numbers; smaller ones are added up."""
    n = 50
    a = jnp.asarray(np.random.default_rng(0).normal(size=(n, n)) / n, complex)
    a = a + 1j * a.T

    def field(t, y, args):
        m = a @ y + jnp.cos(t).astype(complex) * a
        return cfjax.LeftMatrix(m - m.conj().T)

    def end(solver):
        times = jnp.asarray(0.1), jnp.asarray(0.4)
        step = lambda y0: problems.first_step(solver, cfjax.LieTerm(field), *times, y0, None)[0]  # noqa: E731
        y0 = jnp.eye(n, dtype=complex)
        assert ("dot_general" in _combinations(step, y0)) == (solver.unroll is False)
        return step(y0)

    # Entries of at most 1; products of 50 terms, a few for each flow.
    rolled, plain = end(cfjax.CF4(unroll=False)), end(cfjax.CF4(unroll=True))
    assert rolled.dtype == plain.dtype == complex
    np.testing.assert_allclose(rolled, plain, rtol=0, atol=1000 * 2.0**-52)


def _combinations(step, y0):
    """The operations of a program that make a vector of 2500 numbers."""
    text = str(jax.make_jaxpr(step)(y0))
    lines = [line for line in text.splitlines() if re.search(r":(f64|c128)\[2500\] = ", line)]
    return " ".join(lines)
