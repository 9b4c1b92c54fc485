"""Low-storage methods: loops over their stages, and memory.

Their steps are those of their tableaus in test_step.py.
"""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from solver_table import solvers

import cfjax

METHODS = solvers("low-storage")


def test_the_orders_by_their_conditions(subtests):
    for name, row in METHODS.items():
        tableau = getattr(cfjax, name).tableau
        with subtests.test(name=name):
            assert cfjax.order(tableau) == row.order
            assert tableau.num_flows == tableau.num_evaluations == row.evaluations
            if row.embedded is None:
                assert tableau.embedded is None
            else:
                assert cfjax.order(tableau.embedded_method) == row.embedded
                flows = {"Luscher3": 1, "CFEES25": 1}.get(name, 0)
                assert tableau.num_embedded_flows == flows


def test_a_step_in_a_loop_is_that_of_its_coefficients():
    """In NumPy, by the two arrays of the paper; test_step.py has the tableau's."""
    solver, t0, h = cfjax.BWRRK53(unroll=False), 0.3, 0.2

    @jax.jit
    def step(y0):
        times = jnp.asarray(t0), jnp.asarray(t0 + h)
        return problems.first_step(solver, cfjax.LieTerm(field), *times, y0, problems.INERTIA)[:2]

    field, total, points = problems.driven_body, np.zeros((3, 3)), [problems.MOMENTUM]
    for a, b, c in zip(solver.a, solver.b, solver.tableau.c, strict=True):
        t, y = t0 + float(c) * h, points[-1]
        omega = np.array([np.sin(2 * t), np.cos(t), t]) - y / problems.INERTIA
        total = float(a) * total + h * problems.hat(omega)
        points.append(scipy.linalg.expm(float(b) * total) @ y)
    # Five flows; the embedded method ends before the last of them.
    expected = points[-1], points[-1] - points[-2]
    problems.assert_close(step(problems.MOMENTUM), expected, 1e-15 * 5)


@pytest.mark.slow
def test_the_observed_order(body_problem):
    field, y0, args, answer = body_problem
    for name, steps in {"BWRRK33": [16, 32, 64, 128], "YRK135": [6, 8, 12, 16]}.items():
        found = problems.errors(field, getattr(cfjax, name)(), 1.0, y0, args, answer, steps)
        assert found.min() > 10 * problems.REFERENCE_ERROR
        assert abs(problems.slope(steps, found) - METHODS[name].order) < 0.15


@pytest.mark.slow
def test_a_frame_in_coordinates_of_its_own_takes_every_stage(no_shape_hook):
    """Such a step changes its structure from stage to stage, so it cannot be a loop."""
    y0 = jnp.asarray(np.linalg.qr(np.random.default_rng(1).standard_normal((8, 2)))[0])

    def field(t, y, args):
        return cfjax.LowRankSkew(jnp.roll(y, 1, axis=0) * (1 + t))

    ends = [
        cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 0.2, y0, num_steps=1).ys[-1]
        for solver in (cfjax.CK54(), cfjax.CommutatorFree(cfjax.CK54.tableau))
    ]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-14)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", METHODS)
def test_memory_is_that_of_two_states(name):
    """As the compiler plans it: the point and the sum, and what one evaluation needs."""
    n = 1_000_000

    def field(t, y, args):
        # Not entry by entry, so the stages cannot be computed one entry after another.
        return jnp.cumsum(y) / n - y

    def end(y0):
        solver = getattr(cfjax, name)()
        return cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 1.0, y0, num_steps=10).ys

    compiled = jax.jit(end, donate_argnums=0).lower(jnp.zeros(n)).compile()
    assert compiled.memory_analysis().temp_size_in_bytes / (8 * n) < 4.5
