"""The iteration of the implicit midpoint rule: when it has converged, and its derivatives."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems

import cfjax

MIDPOINT = cfjax.ImplicitMidpoint()
BODY = np.asarray([0.48, 0.6, 0.64], np.float32)


def test_fixed_point_beside_a_part_at_rest():
    """Its size has no part in whether the others have converged."""

    def body(t, y, args):
        return {"m": cfjax.Rotation(-y["m"] / np.asarray([1, 2, 3.5], np.float32)), "rest": None}

    @jax.jit
    def solve(rest, h):
        start = {"m": jnp.asarray(BODY), "rest": jnp.full(2, rest)}
        term = cfjax.LieTerm(body)
        sol = cfjax.integrate(term, MIDPOINT, 0.0, 10 * h, start, num_steps=10, throw=False)
        return sol.ys["m"][-1], sol.result

    for h in np.asarray([1.5, 40.0], np.float32):
        (alone, expected), (beside, result) = (solve(np.float32(rest), h) for rest in (0.0, 1e4))
        assert result == expected
        # Bit for bit the same iteration.
        np.testing.assert_array_equal(beside, alone)
        failed = diffrax.RESULTS.nonlinear_divergence
        assert expected == (diffrax.RESULTS.successful if h < 2 else failed)


def test_fixed_point_of_small_numbers_beside_large_ones():
    """The forces cancel to a few digits, so the momenta cannot settle to more than these."""

    def chain(t, y, args):
        x = jnp.pad(y["x"], 1, mode="edge")
        return {"x": y["p"], "p": x[2:] + x[:-2] - 2 * x[1:-1]}

    x = 1e4 + np.sin(np.arange(8))
    start = {"x": jnp.asarray(x, jnp.float32), "p": jnp.zeros(8, jnp.float32)}
    solution = cfjax.integrate(
        cfjax.LieTerm(chain), MIDPOINT, 0.0, 100.0, start, num_steps=200, throw=False
    )
    assert solution.result == diffrax.RESULTS.successful
    # No force from outside: each step rounds forces of 1e-3 of the unit of 1e4, at random.
    assert abs(jnp.sum(solution.ys["p"][-1])) < 0.05


def cascade(rate, coupling):
    return -rate * np.eye(4) + coupling * np.eye(4, k=-1)


def test_fixed_point_of_a_cascade_that_is_not_normal():
    """Changes grow a thousandfold before they fall, or for ever."""
    # In steps of length 1, so the spectral radii are half of the rates.
    matrices = np.stack([cascade(0.9, 1.0), cascade(0.9, 20.0), cascade(0.9, 1e3), 4 * np.eye(4)])

    def end(y, matrix):
        term = cfjax.LieTerm(lambda t, y, matrix: matrix @ y)
        y1, *_, result = problems.first_step(MIDPOINT, term, 0.0, 1.0, y, matrix)
        return y1, result

    def all_of(matrix):
        forward, result = jax.jacfwd(end, has_aux=True)(jnp.ones(4), matrix)
        return forward, jax.jacrev(end, has_aux=True)(jnp.ones(4), matrix)[0], result

    program = jax.jit(jax.vmap(all_of), compiler_options=problems.QUICK)
    *jacobians, results = program(matrices)
    failed = jax.vmap(lambda result: result != diffrax.RESULTS.successful)(results)
    np.testing.assert_array_equal(failed, [False, False, False, True])
    for k, half in enumerate(matrices[:3] / 2):
        expected = np.linalg.solve(np.eye(4) - half, np.eye(4) + half)
        for jacobian in jacobians:
            # Some tens of roundings, relative to the largest of numbers up to 6e7.
            np.testing.assert_allclose(
                jacobian[k], expected, rtol=0, atol=1e-14 * np.abs(expected).max()
            )
    for jacobian in jacobians:
        # Not of the members beside it.
        assert np.all(np.isnan(jacobian[3][np.eye(4, dtype=bool)]))


def test_fixed_point_of_several_dtypes_and_its_second_derivatives():
    def field(t, y, args):
        return {"z": 1j * y["z"], "x": -(y["x"] ** 2), "low": -y["low"]}

    def end(y):
        return problems.first_step(MIDPOINT, cfjax.LieTerm(field), 0.0, 0.5, y, None)[0]

    @functools.partial(jax.jit, compiler_options=problems.QUICK)
    def derivatives(start, weights, x):
        def gradient(x):
            return jax.vjp(end, start | {"x": x})[1](weights)[0]

        return jax.jvp(gradient, (x,), (jnp.ones_like(x),))

    start = {"z": jnp.asarray(1.0 + 2.0j), "x": jnp.asarray(0.7), "low": jnp.float32(3.0)}
    weights = {"z": jnp.asarray(1.0 + 0j), "x": jnp.asarray(1.0), "low": jnp.float32(1)}
    found, along = derivatives(start, weights, start["x"])
    # The mean m of y' = -y^2 solves m = x - m^2 / 4, and the end is 2 m - x.
    root = np.sqrt(1 + 0.7)
    # A few roundings.
    np.testing.assert_allclose(found["z"], (1 + 0.25j) / (1 - 0.25j), rtol=1e-14)
    np.testing.assert_allclose(found["x"], 2 / root - 1, rtol=1e-14)
    np.testing.assert_allclose(found["low"], np.float32(0.75 / 1.25), rtol=1e-6)
    np.testing.assert_allclose(along["x"], -1 / root**3, rtol=1e-14)
