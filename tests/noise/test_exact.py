"""Equations with noise whose answers are known: means over many paths, and solutions path by path.

The means have a statistical error, of which five times the standard error are allowed, and the weak
error of the steps, stated for each. All copies are leading axes of one state.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from brownian_paths import GivenStep
from scipy.linalg import expm

import cfjax

NUMBER = 4000


def brownian(shape: tuple[int, ...], seed: int = 0) -> diffrax.UnsafeBrownianPath:
    key = jax.random.key(seed)
    return diffrax.UnsafeBrownianPath(shape, key, levy_area=diffrax.SpaceTimeLevyArea)


def solve(drift: Any, noise: Any, shape: Any, solver: Any, y0: Any, t1: float, n: int, args=None):
    """The end of `n` steps; no drift is None."""
    term: Any = cfjax.LieControlTerm(noise, brownian(shape))
    if drift is not None:
        term = diffrax.MultiTerm(cfjax.LieTerm(drift), term)
    return cfjax.integrate(term, solver, 0.0, t1, y0, args, num_steps=n).ys


def ends(*args: Any) -> Any:
    return jax.tree.map(lambda x: x[-1], solve(*args))


def copies(y: Any, number: int) -> jax.Array:
    y = jnp.asarray(y)
    return jnp.broadcast_to(y, (number, *y.shape))


def assert_mean(samples: Any, expected: Any, weak_error: float) -> None:
    samples = np.asarray(samples)
    mean, n = samples.mean(0), len(samples)
    # The deviation of complex numbers is that of both parts.
    error = np.abs(mean - expected)
    allowed = 5 * samples.std(0) / np.sqrt(n) + weak_error
    assert np.all(error < allowed), (error, allowed)


# Groups


def test_a_qubit_with_two_noises_that_do_not_commute():
    """The mean of the projectors is the solution of Lindblad's equation."""
    h = np.array([[0.5, 0.2 - 0.3j], [0.2 + 0.3j, -0.5]])
    noises = np.array([[[0.6, 0.1], [0.1, -0.6]], [[0.0, -0.5j], [0.5j, 0.2]]])

    def noise(t, y, args, dw):
        total = jnp.einsum("nk,kij->nij", dw.astype(complex), jnp.asarray(noises))
        return cfjax.LeftMatrix(-1j * total)

    start = np.array([[0.6], [0.8j]])
    found = np.asarray(
        ends(
            lambda t, y, args: cfjax.LeftMatrix(jnp.asarray(-1j * h)[None]),
            noise,
            (NUMBER, 2),
            cfjax.WeakOrder2(cfjax.CF3()),
            copies(start, NUMBER),
            1.5,
            8,
        )
    )

    def commutator(a):
        return np.kron(a, np.eye(2)) - np.kron(np.eye(2), a.T)

    squares = sum(commutator(s) @ commutator(s) / 2 for s in noises)
    rho = expm(1.5 * (-1j * commutator(h) - squares)) @ np.ravel(start @ np.conj(start.T))
    assert_mean(found @ np.conj(np.swapaxes(found, 1, 2)), rho.reshape(2, 2), 2e-3)


@pytest.mark.slow
def test_brownian_motion_of_unit_vectors_and_of_orthonormal_columns():
    """`E[Y] = exp(-(n - p) s^2 T / 2) Y(0)` for noise that leaves the span of p columns."""
    s = 0.6

    def off(y, dw):
        along = jnp.einsum("nij,nik->njk", y, dw)
        return s * (dw - jnp.einsum("nij,njk->nik", y, along))

    def noise(t, y, args, dw):
        return {
            "sphere": cfjax.SphereRotation(s * dw["sphere"]),
            "frame": cfjax.LowRankSkew(off(y["frame"], dw["frame"])),
        }

    frame = np.linalg.qr(np.random.default_rng(0).standard_normal((4, 2)))[0]
    start = {"sphere": np.ones(5) / np.sqrt(5), "frame": frame}
    shapes = {name: jax.ShapeDtypeStruct((NUMBER, *x.shape), float) for name, x in start.items()}
    found = ends(
        *(None, noise, shapes, cfjax.CF2()),
        {name: copies(x, NUMBER) for name, x in start.items()},
        *(1.0, 16),
    )
    # The rates are 0.72 and 0.36, and the error of a step is a part of their squares.
    assert_mean(found["sphere"] @ start["sphere"], np.exp(-4 * s**2 / 2), 0.72**2 / 16 / 4)
    assert_mean(found["frame"], np.exp(-2 * s**2 / 2) * frame, 0.36**2 / 16 / 4)


def test_a_bath_in_a_splitting():
    """Friction and noise are one term, between two halves of a turn: an Ornstein-Uhlenbeck step."""
    h, rate, amplitudes = 0.7, 1.3, np.array([0.5, 0.8, 1.1])
    turn, w, start = np.array([0.3, -0.7, 0.5]), np.array([0.4, -0.3, 0.6]), np.array([0.6, 0, 0.8])

    def friction(t, y, args):
        return cfjax.LinearAffine(-rate * jnp.eye(3), jnp.zeros(3))

    def torques(t, y, args, dw):
        return cfjax.LinearAffine(jnp.zeros((3, 3)), amplitudes * dw)

    given = GivenStep(jnp.asarray(w), None)
    bath = diffrax.MultiTerm(cfjax.LieTerm(friction), cfjax.LieControlTerm(torques, given))
    term = diffrax.MultiTerm(cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(turn)), bath)
    step = lambda h, y0: problems.first_step(cfjax.Strang(), term, 0 * h, h, y0, None)[0]  # noqa: E731
    found = jax.jit(step, compiler_options=problems.QUICK)(h, jnp.asarray(start))
    half = expm(h / 2 * problems.hat(turn))
    kept = np.exp(-rate * h)
    expected = half @ (kept * half @ start + (1 - kept) / (rate * h) * amplitudes * w)
    # Three flows of a few roundings.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


# Path by path


def oscillator(s, n=50):
    """Kubo's oscillator, with the Brownian motion itself as a second part of the state."""

    def drift(t, y, s):
        return {"z": cfjax.LeftMatrix(jnp.full((1, 1), 1j, complex)), "w": None}

    def noise(t, y, s, dw):
        return {"z": cfjax.LeftMatrix(1j * (s * dw).astype(complex)[None]), "w": dw}

    y0 = {"z": jnp.ones((1, 1), complex), "w": jnp.zeros(1)}
    ends = solve(drift, noise, (1,), cfjax.CF4(), y0, 2.0, n, s)
    return ends["z"][-1, 0, 0], ends["w"][-1, 0]


def test_kubos_oscillator_and_its_derivative():
    """`z = exp(i (T + s W))`, path by path, and `dz/ds = i W z`."""

    @jax.jit
    def both(s):
        (z, w), (dz, _) = jax.jvp(oscillator, (s,), (jnp.ones_like(s),))
        return z, w, dz

    s = np.asarray(0.8)
    z, w, dz = map(np.asarray, both(s))
    # 50 steps of a few roundings each.
    np.testing.assert_allclose(z, np.exp(1j * (2 + s * w)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(dz, 1j * w * z, rtol=0, atol=3e-14)


def test_geometric_brownian_motion_tells_the_sense_of_the_noise():
    """Itô: `exp((m - s^2 / 2) T + s W)`; Stratonovich: `exp(m T + s W)`. For plain numbers."""
    m, s, number, n = 0.3, 0.6, 200, 400

    def drift(t, y, args):
        return {"x": m * y["x"], "w": jnp.zeros_like(y["w"])}

    def noise(t, y, args, dw):
        return {"x": s * y["x"] * dw, "w": dw}

    y0 = {"x": jnp.ones(number), "w": jnp.zeros(number)}
    for solver, is_ito in ((cfjax.LieEuler(), True), (cfjax.CF2(), False)):
        y = ends(drift, noise, (number,), solver, y0, 1.0, n)
        ito, stratonovich = (np.exp(m - s**2 / 2 * k + s * y["w"]) for k in (1, 0))
        error, other = (
            np.sqrt(np.mean((y["x"] / exact - 1) ** 2))
            for exact in ((ito, stratonovich) if is_ito else (stratonovich, ito))
        )
        # Euler: root mean square s^2 sqrt(T h / 2) = 0.013, and with chords less. The limits are
        # 20 % apart.
        assert error < 0.02
        assert other > 0.1
        assert isinstance(solver, diffrax.AbstractItoSolver) == is_ito
        assert isinstance(solver, diffrax.AbstractStratonovichSolver) != is_ito


def test_the_manifold_is_kept_to_rounding():
    """After 100 000 steps, on spheres and with unit quaternions and attitudes."""

    def drift(t, y, args):
        return {
            "s": cfjax.Rotation(y["s"][::-1]),
            "q": cfjax.QuaternionRotation(y["s"], frame="body", layout="wxyz"),
            "r": cfjax.Rotation(-y["s"]),
        }

    def noise(t, y, args, dw):
        return {
            "s": cfjax.Rotation((1 + y["s"]) * dw),
            "q": cfjax.QuaternionRotation(0.7 * dw, frame="body", layout="wxyz"),
            "r": cfjax.Rotation(dw * y["s"]),
        }

    y0 = {
        "s": jnp.asarray([0.6, 0.0, 0.8]),
        "q": jnp.asarray([1.0, 0.0, 0.0, 0.0]),
        "r": jnp.eye(3),
    }
    y = ends(drift, noise, (3,), cfjax.CF2(), y0, 100.0, 100_000)
    # The sums are compensated, so the rounding of a state does not add up, which would be 0.3 units
    # times the root of the number of steps. What is left is that of the increments, of size 0.04
    # here: 4 units, of which a walk is seldom past three times as many, and that of the entries.
    most = 16 * np.finfo(float).eps
    assert abs(np.linalg.norm(y["s"]) - 1) < most
    assert abs(np.linalg.norm(y["q"]) - 1) < most
    assert np.max(np.abs(y["r"].T @ y["r"] - np.eye(3))) < most
