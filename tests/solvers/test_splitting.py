"""Splittings: a body in three terms, with and without a bath of friction and noise."""

from typing import Any

import brownian_paths as paths
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.linalg import expm

import cfjax

# A symmetric top, of moments of inertia J, J and J3: the kinetic energy of a spherical body, and
# what turns it about its own axis. These two commute, and neither does with the torque. (A body in
# four terms is in problems.py.)
J, J3 = 1.0, 0.4
FRICTION = 0.8
START = {"q": np.array([0.6, 0.0, 0.48, 0.64]), "m": np.array([0.5, -0.8, 1.1])}


def turn(w):
    return cfjax.QuaternionRotation(w, frame="body", layout="wxyz")


def kick(t, y, args):
    """A torque that depends on attitude and time."""
    frame = cfjax.quaternion_to_matrix(y["q"], layout="wxyz")
    strength = (1.5 + jnp.sin(3 * t)).astype(frame.dtype)
    return {"q": None, "m": strength * jnp.cross(frame[2], jnp.asarray([0.3, 0, 1], frame.dtype))}


def spherical(t, y, args):
    return {"q": turn(y["m"] / J), "m": None}


def axial(t, y, args):
    w = y["m"] * np.array([0, 0, 1 / J3 - 1 / J], y["m"].dtype)
    return {"q": turn(w), "m": cfjax.Rotation(-w)}


def friction(t, y, args):
    a = -FRICTION * jnp.eye(3, dtype=y["m"].dtype)
    return {"q": None, "m": cfjax.LinearAffine(a, jnp.zeros_like(y["m"]))}


def torques(t, y, args, dw):
    return {"q": None, "m": cfjax.LinearAffine(jnp.zeros((3, 3)), dw * np.array([0.5, 0.8, 0.6]))}


def all_terms(*fields: Any) -> diffrax.MultiTerm:
    return diffrax.MultiTerm(*map(cfjax.LieTerm, fields))


TOP = all_terms(kick, spherical, axial)
BODY: Any = tuple(TOP.terms)


def with_bath(path):
    bath = diffrax.MultiTerm(cfjax.LieTerm(friction), cfjax.LieControlTerm(torques, path))
    return diffrax.MultiTerm(*BODY, bath)


def solve(term, solver, n, t1=1.0, y0=START, t0=0.0):
    y = cfjax.integrate(term, solver, t0, t1, problems.arrays(y0), num_steps=n).ys
    return jax.tree.map(lambda x: x[-1], y)


# Steps by hand.


def torque_of_driven_top(t, q):
    return (1 + 0.3 * np.sin(t)) * np.cross([0.2, 0.3, 1.0], q[:, 2])


def flows_of_driven_top(stages, y, t, h):
    """The flows of a step in their order; the clock advances while the last term acts."""
    q, m = y["q"], y["m"]
    for k, s in enumerate(stages):
        for term in range(4) if k % 2 == 0 else reversed(range(4)):
            if term == 0:
                m = m + s * h * torque_of_driven_top(t, q)
                continue
            turn = s * h * np.cross(np.eye(3), np.eye(3)[term - 1] * m / problems.INERTIA)
            q, m = q @ expm(turn), m @ expm(turn)
            if term == 3:
                t = t + s * h
    return {"q": q, "m": m}


def test_a_step_is_its_flows(subtests):
    t0, h = 0.3, 0.4
    # Suzuki's composition, doi:10.1016/0375-9601(90)90962-N: five steps of these lengths.
    s = 1 / (4 - 4 ** (1 / 3))
    suzuki = np.repeat([s, s, 1 - 4 * s, s, s], 2) / 2
    for name, solver, stages in (
        ("Splitting", cfjax.Splitting((0.3, 0.7)), (0.3, 0.7)),
        ("Composition", cfjax.Composition(cfjax.Strang(), 4), suzuki),
    ):

        def step(y, args, solver=solver):
            found = problems.first_step(solver, problems.DRIVEN_TOP, t0, t0 + h, y, args)
            return found[0], found[3].first["m"]

        with subtests.test(name=name):
            start = problems.DRIVEN_TOP_START
            y, first = problems.op_by_op(step, start, problems.INERTIA)
            expected = flows_of_driven_top(stages, start, t0, h)
            # Up to 40 flows of a few roundings of numbers of size two.
            problems.assert_close(y, expected, 2e-14)
            # With this the next step starts.
            problems.assert_close(first, torque_of_driven_top(t0 + h, expected["q"]), 2e-14)


# Orders: the numbers of the methods are published ones, as test_long_times.py shows.


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, order, num_steps",
    [
        (cfjax.Splitting((0.0, 1.0)), 1, (64, 128)),
        (cfjax.Strang(), 2, (16, 32)),
        (cfjax.BlanesMoan6(), 6, (4, 8)),
    ],
)
def test_the_order_for_four_terms(solver, order, num_steps, driven_top_answer):
    problems.assert_order_of_driven_top(solver, order, num_steps, driven_top_answer)


def yoshida(w):
    return tuple(x / 2 for x in (w, w, 1 - 2 * w, 1 - 2 * w, w, w))


def test_the_order_of_stages(subtests):
    fourth = 1 / (2 - 2 ** (1 / 3))
    for stages, order in (
        ((1.0, 0.0), 1),
        ((0.3, 0.7), 1),
        ((0.5, 0.5), 2),
        ((0.25,) * 4, 2),
        (yoshida(fourth), 4),
        (yoshida(fourth + 1e-9), 2),
        (cfjax.BlanesMoan4.stages, 4),
        (cfjax.BlanesMoan6.stages, 6),
    ):
        with subtests.test(stages=str(stages)):
            solver = cfjax.Splitting(stages)
            assert solver.order(TOP) == order
            assert solver.is_symmetric == (stages == pytest.approx(stages[::-1]))


def test_rounding_does_not_add_up():
    """In float32 after 30 000 steps: the length of q, and that of m without torques."""
    y0 = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), START)
    y = solve(all_terms(spherical, axial), cfjax.Strang(), 30_000, 300.0, y0)
    unit = np.finfo(np.float32).eps
    lengths = np.array([np.linalg.norm(np.asarray(y[k], float)) for k in y])
    starts = np.array([np.linalg.norm(np.asarray(y0[k], float)) for k in y])
    # The sums over the steps are compensated. A random walk of roundings would be some 100 units.
    assert np.all(np.abs(lengths / starts - 1) < 4 * unit)


# Noise


@pytest.mark.slow
def test_a_bath_has_strong_order_1():
    path = paths.drawn(6, 100, (3,), 512)
    y0 = problems.arrays(START)
    end = paths.ends(with_bath, cfjax.Strang(), path, y0, jnp.asarray(512))
    steps = [8, 16, 32, 64]
    errors = paths.strong_errors(with_bath, cfjax.Strang(), path, y0, steps, end)
    # The reference is eight times as good as the last of them, which adds 0.05 to the slope.
    assert 0.85 < problems.slope(steps, errors) < 1.25


@pytest.mark.slow
def test_output_within_a_step_with_noise():
    solver, y0 = cfjax.Strang(), problems.arrays(START)
    term = with_bath(paths.GivenStep(jnp.asarray([0.3, -0.5, 0.4]), None))

    def step(times):
        y1, error, dense_info, _, _ = problems.first_step(solver, term, 0.0, 0.5, y0, None)
        # For adaptive steps there is no estimate.
        assert error is None
        output = solver.interpolation_cls(t0=0.0, t1=0.5, **dense_info)
        return y1, jax.vmap(output.evaluate)(times)

    end, ys = problems.op_by_op(step, jnp.linspace(0.0, 0.5, 5))
    for name in ("q", "m"):
        # Ten flows of a few roundings of entries of size one.
        np.testing.assert_allclose(ys[name][0], y0[name], rtol=0, atol=1e-14)
        np.testing.assert_allclose(ys[name][-1], end[name], rtol=0, atol=1e-14)
    np.testing.assert_allclose(jnp.linalg.norm(ys["q"], axis=1), 1, rtol=0, atol=2e-15)


# Errors


def test_wrong_stages(no_shape_hook, subtests):
    for stages in (
        *((), (1.0,), (0.5, 0.5, 0.5), (0.5, 0.4), (0.5, 0.6)),
        *((0.5, "a"), ("ab", None)),
    ):
        with (
            subtests.test(stages=str(stages)),
            pytest.raises(ValueError, match="stages must be an even number of numbers"),
        ):
            cfjax.Splitting(stages)  # pyright: ignore[reportArgumentType]


def test_terms_that_a_splitting_refuses(no_shape_hook):
    path = diffrax.UnsafeBrownianPath((3,), jax.random.key(0))
    noise = cfjax.LieControlTerm(torques, path)

    def fails(term, kind, match):
        with pytest.raises(kind, match=match):
            solve(term, cfjax.Strang(), 2)

    fails(
        all_terms(kick), TypeError, "Strang takes a diffrax.MultiTerm of two or more terms, got 1"
    )
    fails(BODY[0], TypeError, "Strang takes a term of the form")
    fails(
        diffrax.MultiTerm(noise, *BODY),
        TypeError,
        "supports noise and other path-driven terms only as its last term",
    )
    fails(diffrax.MultiTerm(BODY[0], noise, BODY[1]), TypeError, "only as its last term: move them")
    fails(all_terms(axial, spherical, kick), TypeError, "last term of Strang must not depend on t")

    def on_host(t, y, args):
        strength = jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), t.dtype), t)
        return {"q": None, "m": strength * jnp.ones_like(y["m"])}

    match = "must not depend on time.* The field gives t to a function of the host"
    fails(all_terms(spherical, on_host), TypeError, match)
    # A last term that rests takes the time: translations at the start and at the end of a step.
    both = all_terms(lambda t, y, _: {"m": jnp.cos(t) * jnp.ones(2)}, lambda t, y, _: {"m": None})
    times, y0 = (jnp.asarray(0.3), jnp.asarray(0.7)), {"m": jnp.asarray([0.2, -0.5])}
    found = jax.jit(lambda y0: problems.first_step(cfjax.Strang(), both, *times, y0, None)[0])(y0)
    expected = y0["m"] + 0.2 * (np.cos(0.3) + np.cos(0.7))
    np.testing.assert_allclose(found["m"], expected, rtol=0, atol=1e-15)
