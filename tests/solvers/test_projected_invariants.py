"""`Projected(..., invariants=...)`: quantities that stay what they were at the start."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax

INERTIA = np.array([1.0, 2.0, 3.0])
MOMENTUM = np.array([0.3, 0.5, 0.8])
BODY = cfjax.LieTerm(lambda t, m, inertia: cfjax.Rotation(-m / inertia))
# A heavy top: its momentum, and the direction of gravity in the body, which turns with it.
WEIGHT = np.array([0.0, 0.0, 0.7])
TOP = {"m": np.array([0.2, 0.1, 1.5]), "up": np.array([0.6, 0.0, 0.8])}


def top(t, y, inertia):
    omega = y["m"] / inertia
    return {
        "m": jnp.cross(y["m"], omega) + jnp.cross(y["up"], WEIGHT),
        "up": cfjax.Rotation(-omega),
    }


def energy(t, m, inertia):
    return m @ (m / inertia) / 2


def of_top(t, y, inertia):
    """Its energy, and the momentum along gravity."""
    return energy(t, y["m"], inertia) + y["up"] @ WEIGHT, {"along": y["m"] @ y["up"]}


CASES = {
    "body": (BODY, energy, MOMENTUM, INERTIA),
    "top": (cfjax.LieTerm(top), of_top, TOP, np.array([2.0, 2.0, 1.0])),
}


@eqx.filter_jit
def solve(case, solver, t1, num_steps, arrays):
    return cfjax.integrate(CASES[case][0], solver, 0.0, t1, *arrays, num_steps=num_steps).ys


def end(case, solver, t1, num_steps):
    ys = solve(case, solver, t1, num_steps, problems.arrays(CASES[case][2:]))
    return jax.tree.map(lambda y: np.asarray(y[-1]), ys)


def values(case, y):
    _, invariants, _, args = CASES[case]
    return problems.flat(invariants(0.0, problems.arrays(y), args))


@pytest.mark.parametrize("case", ["body", pytest.param("top", marks=pytest.mark.slow)])
def test_they_stay_and_the_order_too(case):
    _, invariants, y0, _ = CASES[case]
    solver = cfjax.Projected(diffrax.Bosh3(), invariants=invariants)
    plain = cfjax.Projected(diffrax.Bosh3())
    exact = problems.flat(end(case, cfjax.RKMK8(), 4.0, 400))
    ends = [end(case, solver, 4.0, n) for n in (40, 80)]
    errors = [np.abs(problems.flat(y) - exact).max() for y in ends]
    assert 2.7 < np.log2(errors[0] / errors[1]) < 3.6
    for y in ends:
        # Newton's method ends at some roundings of values up to 2.
        np.testing.assert_allclose(values(case, y), values(case, y0), rtol=0, atol=4e-15)
    off = values(case, end(case, plain, 4.0, 40)) - values(case, y0)
    assert np.abs(off).max() > 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_they_stay_over_many_steps(case):
    solver = cfjax.Projected(diffrax.Bosh3(), invariants=CASES[case][1])
    y0, y = CASES[case][2], end(case, solver, 5e3, 100_000)
    np.testing.assert_allclose(values(case, y), values(case, y0), rtol=0, atol=1e-13)
    part, start = (y["up"], y0["up"]) if case == "top" else (y, y0)
    assert abs(part @ part / (start @ start) - 1) < 1e-13


def test_derivatives():
    """In both modes those of difference quotients, also of what is kept."""
    solver = cfjax.Projected(diffrax.Heun(), invariants=energy)

    def end(arrays):
        y = cfjax.integrate(BODY, solver, 0.0, 2.0, *arrays, num_steps=10).ys[-1]
        return jnp.append(y, energy(0.0, y, arrays[1]))

    arrays = problems.arrays((MOMENTUM, INERTIA))
    direction = problems.random_like(arrays, 0)
    forward = jax.jit(lambda x, d: jax.jvp(end, (x,), (d,))[1])(arrays, direction)
    weights = jnp.asarray([0.3, -0.5, 0.8, 1.0])
    backward = jax.jit(jax.grad(lambda x: end(x) @ weights))(arrays)
    np.testing.assert_allclose(problems.inner(backward, direction), forward @ weights, rtol=1e-12)
    quotient = problems.central_difference(jax.jit(end), arrays, direction, 1e-4)
    # The square of the step and rounding over the step.
    np.testing.assert_allclose(forward, quotient, rtol=0, atol=1e-7)
    of_start = jax.jvp(lambda x: energy(0.0, *x), (arrays,), (direction,))[1]
    np.testing.assert_allclose(forward[-1], of_start, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_with_control_and_in_a_batch():
    solver = cfjax.Projected(diffrax.Tsit5(), invariants=energy)
    controller = diffrax.PIDController(rtol=1e-6, atol=1e-6)

    @jax.jit
    @jax.vmap
    def solve(m):
        sol = diffrax.diffeqsolve(
            BODY, solver, 0.0, 20.0, 0.1, m, jnp.asarray(INERTIA), stepsize_controller=controller
        )
        return sol.ys[-1]

    starts = np.stack([MOMENTUM, MOMENTUM[::-1], 2 * MOMENTUM])
    for y, start in zip(solve(starts), starts, strict=True):
        np.testing.assert_allclose(values("body", y), values("body", start), rtol=1e-14)
        np.testing.assert_allclose(y @ y, start @ start, rtol=1e-14)


def test_what_cannot_be_kept(subtests):
    """The length, which the field keeps anyway, or one quantity twice; and what is no number."""
    cases = {
        "length": lambda t, m, args: m @ m,
        "twice": lambda t, m, args: (energy(t, m, args), 2 * energy(t, m, args)),
    }
    for name, invariants in cases.items():
        solver = cfjax.Projected(diffrax.Heun(), invariants=invariants)
        with subtests.test(case=name), pytest.raises(RuntimeError, match="must be independent"):
            cfjax.integrate(BODY, solver, 0.0, 1.0, MOMENTUM, INERTIA, num_steps=3)
    solver = cfjax.Projected(diffrax.Heun(), invariants=lambda t, m, args: jnp.round(m).astype(int))
    with pytest.raises(TypeError, match="invariants must return floating numbers, got int"):
        cfjax.integrate(BODY, solver, 0.0, 1.0, MOMENTUM, INERTIA, num_steps=3)
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Conjugation(jnp.triu(y, 1) - jnp.tril(y, -1)))
    solver = cfjax.Projected(diffrax.Heun(), invariants=lambda t, y, args: y[0, 0])
    with pytest.raises(TypeError, match="invariants with Conjugation or Congruence"):
        cfjax.integrate(term, solver, 0.0, 1.0, jnp.eye(2), num_steps=3)
