"""A tennis racket under a small weight: its terms, its section, and curves that stay closed."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax.scenes import tennis_racket as scene

WHOLE, ARGS = cfjax.LieTerm(scene.field), scene.Racket()
# A state in no special place, and a weight that is not small.
STATE = {"up": jnp.asarray([0.6, 0.0, 0.8]), "m": jnp.asarray([0.3, -1.1, 0.7])}
HEAVY = scene.Racket(weight=np.array([0.3, -0.5, 0.2]))


def solve(term, solver, start, t1, num_steps, save_every=1):
    options = dict(num_steps=num_steps, save_every=save_every)
    ys = cfjax.integrate(term, solver, 0.0, t1, start, ARGS, **options).ys
    return jax.tree.map(np.asarray, ys)


def test_the_terms_are_exact_and_sum_to_the_field():
    cfjax.check_terms(scene.terms, 0.0, STATE, HEAVY)
    omega = np.asarray(STATE["m"]) / [1.0, 1.5, 3.0]
    torque = np.cross(STATE["up"], [0.3, -0.5, 0.2])
    want = {"up": np.cross(STATE["up"], omega), "m": np.cross(STATE["m"], omega) + torque}

    @jax.jit
    def both(y):
        parts = [cfjax.tangent(term.vf(0.0, y, HEAVY), y) for term in scene.terms.terms]
        return jax.tree.map(lambda *x: sum(x), *parts), scene.velocity(0.0, y, HEAVY)

    found, velocity = both(STATE)
    for name, value in want.items():
        # A few numbers of size one.
        np.testing.assert_allclose(found[name], value, rtol=0, atol=1e-15)
        np.testing.assert_allclose(velocity[name], value, rtol=0, atol=1e-15)


def test_invariants_are_constant():
    def both(y):
        return jax.jvp(lambda y: scene.invariants(y, HEAVY), (y,), (scene.velocity(0.0, y, HEAVY),))

    values, rates = jax.jit(both)(STATE)
    for name, value in values.items():
        assert abs(value) > 0.3 and abs(rates[name]) < 1e-15, name


@pytest.mark.parametrize("angle, height", [(np.pi / 2, 0.1), (-2.0, -0.6)])
def test_a_start_is_on_the_section(angle, height):
    y = scene.y0(angle, height)
    kept = scene.invariants(jax.tree.map(jnp.asarray, y), ARGS)
    # To rounding, by 20 iterations that each gain a factor of a hundred.
    wanted = {"energy": 1 / 3, "vertical momentum": 0.5, "length of up": 1.0}
    for name, value in wanted.items():
        np.testing.assert_allclose(kept[name], value, rtol=0, atol=1e-15)
    # From one turn before, with no step that ends on it, the motion comes back to it.
    before = jax.tree.map(lambda x: x[-1], solve(WHOLE, cfjax.CF4(), y, -1.0, 5))
    states = solve(WHOLE, cfjax.CF4(), before, 2.0, 5)
    ((found, part),) = scene.section(states["up"], states["m"])
    # The error of a cubic through steps of 0.4.
    np.testing.assert_allclose([found, part], [angle, height], rtol=0, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, num_steps",
    [(cfjax.CF4(), (160, 320)), (cfjax.BlanesMoan4(), (80, 160))],
    ids=["CF4", "BlanesMoan4"],
)
def test_order(solver, num_steps):
    term = WHOLE if isinstance(solver, cfjax.CF4) else scene.terms
    answer, errors = scene.reference(40.0), []
    for n in num_steps:
        y = solve(term, solver, scene.y0(), 40.0, n, n)
        errors.append(np.linalg.norm([y[name][0] - answer[name] for name in answer]))
    # Far above the error of the reference.
    assert errors[1] > 1e-9 and 13 < errors[0] / errors[1] < 20


@pytest.fixture(scope="module")
def long():
    """A turn about the third axis, with 20 000 steps of 0.4, by Strang and by CF4."""
    found = {}
    for term, solver in ((scene.terms, cfjax.Strang()), (WHOLE, cfjax.CF4())):
        with cfjax.rewriting(False):
            ys = solve(term, solver, scene.y0(np.pi / 2, 0.6), 8000.0, 20_000)
        kept = jax.tree.map(np.asarray, jax.vmap(lambda y: scene.invariants(y, ARGS))(ys))
        found[type(solver).__name__] = SimpleNamespace(ys=ys, kept=kept)
    return found


def test_the_energy_stays_in_a_band_or_drifts(long):
    times = np.linspace(0, 1, 20_000)
    for name, run in long.items():
        line = np.polyfit(times, run.kept["energy"], 1)
        scatter = np.std(run.kept["energy"] - np.polyval(line, times))
        # From the start to the end. The band of Strang is 1e-4 wide.
        drift = abs(line[0])
        assert drift < scatter / 100 if name == "Strang" else drift > 100 * scatter


def test_what_a_splitting_keeps(long):
    # Less than the rounding of each step, as sums over the steps are compensated.
    kept = long["Strang"].kept
    np.testing.assert_allclose(kept["vertical momentum"], 0.5, rtol=0, atol=1e-14)
    np.testing.assert_allclose(kept["length of up"], 1, rtol=0, atol=1e-14)
    assert np.max(np.abs(long["CF4"].kept["vertical momentum"] - 0.5)) > 1e-7


def test_curves_stay_closed_or_are_left(long):
    """A curve through the first half of the crossings goes through the second half too."""
    off = {}
    for name, run in long.items():
        angle, height = scene.section(run.ys["up"], run.ys["m"]).T
        phases = np.multiply.outer(angle, np.arange(20))
        waves = np.concatenate([np.cos(phases), np.sin(phases[:, 1:])], axis=1)
        half = len(angle) // 2
        curve = np.linalg.lstsq(waves[:half], height[:half])[0]
        off[name] = np.max(np.abs(waves @ curve - height)[half:])
    # The error of the cubic that finds a crossing, and a tenth of the picture's width of a line.
    assert off["Strang"] < 1e-4
    assert off["CF4"] > 1e-3
