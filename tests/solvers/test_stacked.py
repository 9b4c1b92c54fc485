"""Fields stacked for a loop over stages: their combinations, and kinds that cannot be stacked."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg

import cfjax


def test_fields_of_different_kinds_are_an_error_in_words():
    def field(t, y, args):
        kinds.append(1)
        return cfjax.LeftMatrix(a) if len(kinds) < 4 else cfjax.RightMatrix(a)

    kinds, a = [], problems.GENERATORS[0]
    with pytest.raises(TypeError, match="Only fields of one kind can be added"):
        times = jnp.asarray(0.1), jnp.asarray(0.4)
        step = lambda y0: problems.first_step(cfjax.CF4(), cfjax.LieTerm(field), *times, y0, None)  # noqa: E731
        jax.eval_shape(step, jnp.eye(4))


def test_large_fields_are_combined_by_a_product():
    """These fields have 2500 numbers; smaller ones are added up."""
    n = 50
    a = np.random.default_rng(0).normal(size=(n, n)) / n + 0j
    a = a + 1j * a.T
    t0, h = 0.1, 0.3

    def generator(t, y):
        m = a @ y + t * a
        return m - m.conj().T

    def step(unroll):
        term = cfjax.LieTerm(
            lambda t, y, args: cfjax.LeftMatrix(generator(jnp.cos(t).astype(complex), y))
        )
        times = jnp.asarray(t0), jnp.asarray(t0 + h)
        return lambda y0: problems.first_step(cfjax.CF3(unroll=unroll), term, *times, y0, None)[0]

    start = jnp.eye(n, dtype=complex)
    for unroll in (True, False):
        assert ("dot_general" in _combinations(step(unroll), start)) == (not unroll)
    end = jax.jit(step(False), compiler_options=problems.QUICK)(start)

    def after(rows):
        y = np.eye(n)
        for row in rows:
            total = sum(float(b) * f for b, f in zip(row, fields, strict=False))
            y = scipy.linalg.expm(total) @ y
        return y

    fields, tableau = [], cfjax.CF3.tableau
    for rows in tableau.alpha:
        c = sum(float(b) for row in rows for b in row)
        fields.append(h * generator(np.cos(t0 + c * h), after(rows)))
    # Entries of at most 1; products of 50 terms, a few for each flow.
    assert end.dtype == complex
    np.testing.assert_allclose(end, after(tableau.beta), rtol=0, atol=1000 * 2.0**-52)


def _combinations(step, y0):
    """The operations of a program that make a vector of 2500 numbers."""
    text = str(jax.make_jaxpr(step)(y0))
    lines = [line for line in text.splitlines() if re.search(r":(f64|c128)\[2500\] = ", line)]
    return " ".join(lines)
