"""The Wilson flow: action and gradient in NumPy, unitarity, and a reference in plain space."""

import jax
import numpy as np
import problems

import cfjax
from cfjax.scenes import wilson_flow

TERM = cfjax.LieTerm(wilson_flow.field)
START = wilson_flow.y0(3, dimensions=3)


def action(y):
    """Plaquette by plaquette, link by link."""
    d, sides = len(y), y.shape[1:-2]
    total = 0.0
    for x in np.ndindex(*sides):
        for mu in range(d):
            for nu in range(mu + 1, d):
                after = {
                    k: tuple((np.array(x) + np.eye(d, dtype=int)[k]) % sides) for k in (mu, nu)
                }
                loop = y[mu][x] @ y[nu][after[mu]] @ y[mu][after[nu]].conj().T @ y[nu][x].conj().T
                total += 3 - np.trace(loop).real
    return total


def from_unitary(y):
    return np.abs(y @ np.conj(np.swapaxes(y, -1, -2)) - np.eye(3)).max()


def test_the_start_is_in_the_group():
    assert from_unitary(START) < 1e-14
    np.testing.assert_allclose(np.linalg.det(START), 1, rtol=0, atol=1e-14)
    # A third of the trace has mean zero and variance 1/9 for uniform links: 81 of them here.
    assert abs(np.trace(START, axis1=-2, axis2=-1).mean() / 3) < 4 / 3 / 9


def test_the_action_against_numpy():
    found = jax.jit(wilson_flow.action)(START)
    # 81 plaquettes, each a sum of three.
    np.testing.assert_allclose(found, action(START), rtol=1e-13)


def test_the_generator_is_minus_the_gradient():
    # Along exp(h a) V for some a in su(3) the action changes by -2 <a, Z>, with Re tr(a^H Z) / 2.
    rng = np.random.default_rng(1)
    a = rng.normal(size=START.shape) + 1j * rng.normal(size=START.shape)
    a = a - np.conj(np.swapaxes(a, -1, -2))
    a = a - np.trace(a, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) / 3
    h = 1e-5
    # The exponentials, but for powers of h that are less than rounding.
    there = [(np.eye(3) + s * h * a + h**2 / 2 * a @ a) @ START for s in (1, -1)]
    slope = (action(there[0]) - action(there[1])) / (2 * h)
    z = np.asarray(jax.jit(wilson_flow.generator)(START))
    # Truncation h^2 times a third derivative of a thousand, rounding 1e-16 * 200 / h.
    np.testing.assert_allclose(slope, -np.sum(np.conj(a) * z).real, rtol=0, atol=1e-6)
    np.testing.assert_allclose(z, -np.conj(np.swapaxes(z, -1, -2)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.trace(z, axis1=-2, axis2=-1), 0, rtol=0, atol=1e-14)


def flow(y, pieces):
    return np.asarray(problems.in_pieces(TERM, cfjax.Luscher3(), 0.0, 0.3, y, None, 12, pieces))


def test_order_and_unitarity():
    reference, errors = wilson_flow.reference(0.3, START), []
    for pieces in (1, 2):
        y = flow(START, pieces)
        # Sums over the steps are compensated.
        assert from_unitary(y) < 1e-14
        errors.append(np.abs(y - reference).max())
    assert 0.75 * 2**3 < errors[0] / errors[1] < 1.35 * 2**3


def test_a_gauge_transformation_commutes_with_the_flow():
    g = wilson_flow.y0(3, seed=5, dimensions=3)[0]

    def transformed(y):
        ends = [np.roll(g, -1, mu) for mu in range(3)]
        return np.stack([g @ y[mu] @ np.conj(np.swapaxes(ends[mu], -1, -2)) for mu in range(3)])

    found, want = flow(transformed(START), 1), transformed(flow(START, 1))
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-13)
