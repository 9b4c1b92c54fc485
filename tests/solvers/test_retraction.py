"""The Cayley retraction: one step against full matrices, linear spaces, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax

RNG = np.random.default_rng(6)
A, B = RNG.standard_normal((7, 7)) / 3, RNG.standard_normal((7, 2)) / 3
Q = np.linalg.qr(RNG.standard_normal((7, 2)))[0]


def low_rank(t, y, args):
    return cfjax.LowRankSkew(jnp.cos(t) * A @ y + B)


def skew(t, y):
    g = np.cos(t) * A @ y + B
    return g @ y.T - y @ g.T


def cayley(a):
    one = np.eye(len(a))
    return np.linalg.solve(one - a / 2, one + a / 2)


def a_of(v):
    g = v - Q @ (Q.T @ v) / 2
    return g @ Q.T - Q @ g.T


def rate(t, v):
    """V' with `d/dt cay(a_Q(V)) Q = F`, by linear least squares over the tangent space at Q."""
    a = a_of(v)
    middle = np.linalg.inv(np.eye(7) - a / 2)
    y = cayley(a) @ Q
    # Tangent vectors: Q w + x with w skew and Q^T x = 0.
    complement = np.linalg.svd(np.eye(7) - Q @ Q.T)[0][:, :5]
    basis = [Q @ np.array([[0.0, 1.0], [-1.0, 0.0]])]
    basis += [np.outer(u, e) for u in complement.T for e in np.eye(2)]
    columns = [(middle @ a_of(b) @ middle @ Q).ravel() for b in basis]
    target = (skew(t, y) @ y).ravel()
    weights, _, rank, _ = np.linalg.lstsq(np.stack(columns, 1), target)
    assert rank == len(basis) == 11
    return sum(w * b for w, b in zip(weights, basis, strict=True))


def test_a_step_is_rk4_in_the_tangent_space():
    t, h = 0.3, 0.4
    k1 = rate(t, 0 * Q)
    k2 = rate(t + h / 2, h / 2 * k1)
    k3 = rate(t + h / 2, h / 2 * k2)
    k4 = rate(t + h, h * k3)
    expected = cayley(a_of(h * (k1 + 2 * k2 + 2 * k3 + k4) / 6)) @ Q
    term = cfjax.LieTerm(low_rank)
    step = jax.jit(lambda y: problems.first_step(cfjax.CayleyRK4(), term, t, t + h, y, None)[0])
    # Small solves of condition 10.
    np.testing.assert_allclose(step(jnp.asarray(Q)), expected, rtol=0, atol=1e-13)


def test_in_a_linear_space_it_is_the_classical_method():
    """With a part on the manifold beside it, which does not act on it."""

    def field(t, y, args):
        return {"place": jnp.sin(y["place"]) * t, "frame": cfjax.LowRankSkew(A @ y["frame"])}

    start = {"place": jnp.arange(3.0), "frame": jnp.asarray(Q)}
    alone = cfjax.LieTerm(lambda t, y, args: jnp.sin(y) * t)
    found = cfjax.integrate(
        cfjax.LieTerm(field), cfjax.CayleyRK4(), 0.0, 1.0, start, num_steps=4
    ).ys
    # CF4 is the classical method in a linear space.
    expected = cfjax.integrate(alone, cfjax.CF4(), 0.0, 1.0, jnp.arange(3.0), num_steps=4).ys
    np.testing.assert_allclose(found["place"], expected, rtol=0, atol=1e-15 * 10)


def test_a_field_that_reads_a_part_at_rest():
    """It is a sum of nothing, and its state is the same at all stages."""

    def field(t, y, args):
        return {"q": cfjax.LowRankSkew(y["scale"] * (jnp.cos(t) * A @ y["q"] + B)), "scale": None}

    y0 = {"q": jnp.asarray(Q), "scale": jnp.asarray(0.7)}
    t1 = 0.4
    found = cfjax.integrate(cfjax.LieTerm(field), cfjax.CayleyRK4(), 0.0, t1, y0, num_steps=20).ys
    # The same with a number.
    alone = cfjax.LieTerm(lambda t, y, args: cfjax.LowRankSkew(0.7 * (jnp.cos(t) * A @ y + B)))
    expected = cfjax.integrate(alone, cfjax.CayleyRK4(), 0.0, t1, jnp.asarray(Q), num_steps=20).ys
    assert float(found["scale"][-1]) == 0.7
    # The same operations, which XLA may fuse otherwise: some units of rounding in each step.
    np.testing.assert_allclose(found["q"], expected, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_gradients():
    weight = np.arange(14.0).reshape(7, 2)

    def fun(y0):
        y0 = problems.orthonormal(y0)
        ys = cfjax.integrate(
            cfjax.LieTerm(low_rank), cfjax.CayleyRK4(), 0.0, 1.0, y0, num_steps=3
        ).ys
        return jnp.sum(jnp.sin(weight / 4 * ys[-1]))

    y0, v = jnp.asarray(Q), jnp.asarray(A @ Q)
    found = jax.jit(jax.grad(fun))(y0)
    # Fifth derivatives of 1e4 times 1e-12 / 30, and rounding of 1e-15 over 1e-3.
    expected = problems.central_difference(jax.jit(fun), y0, v, 1e-3)
    np.testing.assert_allclose(jnp.vdot(found, v), expected, rtol=0, atol=2e-9)


def test_other_fields_are_refused():
    for field, y in [
        (lambda t, y, args: cfjax.Rotation(y), np.ones(3)),
        (lambda t, y, args: cfjax.LeftMatrix(y), np.eye(3)),
    ]:
        with pytest.raises(TypeError, match="CayleyRK4 works on points with orthonormal columns"):
            cfjax.integrate(cfjax.LieTerm(field), cfjax.CayleyRK4(), 0.0, 1.0, y, num_steps=1)
