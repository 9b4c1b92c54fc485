"""One step of every commutator-free method against an interpreter of its tableau in NumPy.

The order conditions check the coefficients exactly, in methods/test_order_conditions.py. With a
step that is right to rounding the order follows, so observed slopes are for few methods.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from solver_table import COMMUTATOR_FREE, named

import cfjax
from cfjax._methods.continuous_extension import continuous_extension

METHODS = named("commutator-free", "low-storage") | {
    name: COMMUTATOR_FREE[name] for name in ("family A, 1", "family B, 0.1")
}
SOLVERS: dict[str, Any] = {name: row.make() for name, row in METHODS.items()}
# Times, and the place within the step.
T0, H, THETA = 0.3, 0.25, 0.4


class Line(cfjax.AbstractFrozenField):
    """Affine fields `slope y + shift` of a line, entry by entry: two of them do not commute.

    A step is a small program, so that every method can have one.
    """

    slope: jax.Array
    shift: jax.Array

    def flow(self, point):
        return jnp.exp(self.slope) * point + jnp.expm1(self.slope) / self.slope * self.shift

    def tangent(self, point):
        return self.slope * point + self.shift


def line_coefficients(xp, t, y, args):
    return args * xp.cos(y + t), 1 + xp.sin(y * t)


def line(t, y, args):
    return Line(*line_coefficients(jnp, t, y, args))


def driven_coefficients(xp, t, args):
    return args * xp.cos(t), args - 1 + xp.sin(3 * t)


def driven_line(t, y, args):
    """The state has no part in it, so nor has it in what CF4's embedded sees."""
    del y
    return Line(*driven_coefficients(jnp, t, args))


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


class OnLines:
    """The same in NumPy: the field, its velocity and its flow."""

    @staticmethod
    def field(t, y):
        return np.array(line_coefficients(np, t, y, SLOPES))

    @staticmethod
    def velocity(f, y):
        return f[0] * y + f[1]

    @staticmethod
    def flow(f, y):
        flows = (scipy.linalg.expm(np.array([[a, b], [0, 0]])) for a, b in f.T)
        return np.array([m[0, 0] * x + m[0, 1] for m, x in zip(flows, y, strict=True)])


class OnDrivenLines(OnLines):
    @staticmethod
    def field(t, y):
        return np.array(driven_coefficients(np, t, SLOPES))


class FromLeft:
    @staticmethod
    def field(t, y):
        return problems.generator(np, t, y, problems.GENERATORS)

    @staticmethod
    def velocity(f, y):
        return f @ y

    @staticmethod
    def flow(f, y):
        return scipy.linalg.expm(f) @ y


class FromRight(FromLeft):
    @staticmethod
    def velocity(f, y):
        return y @ f

    @staticmethod
    def flow(f, y):
        return y @ scipy.linalg.expm(f)


class OnSphere(FromLeft):
    @staticmethod
    def field(t, y):
        return hat(np.array([np.sin(2 * t), np.cos(t), t]) - y / problems.INERTIA)


# More than the entries of a short vector, which go another way through a step.
_RNG = np.random.default_rng(3)
SLOPES = _RNG.uniform(0.5, 1.5, 9)
LINES = line, _RNG.uniform(-1, 1, 9), SLOPES, OnLines
DRIVEN = driven_line, LINES[1], SLOPES, OnDrivenLines
BODY = problems.driven_body, problems.MOMENTUM, problems.INERTIA, OnSphere
LEFT = problems.left_matrix, problems.ORTHOGONAL, problems.GENERATORS, FromLeft
RIGHT = problems.right_matrix, problems.ORTHOGONAL, problems.GENERATORS, FromRight


class Interpreter:
    """What a tableau says, row by row."""

    def __init__(self, tableau, geometry, t, y, h):
        self.geometry, self.y, self.fields = geometry, y, []
        for rows in tableau.alpha:
            c = float(sum(a for row in rows for a in row))
            self.before = self.end(rows)
            self.fields.append(h * geometry.field(t + c * h, self.before))
        self.y1 = self.end(tableau.beta)
        self.fields.append(h * geometry.field(t + h, self.y1))

    def sum(self, row):
        return sum(float(a) * f for a, f in zip(row, self.fields, strict=False))

    def end(self, rows):
        y = self.y
        for row in rows:
            y = self.geometry.flow(self.sum(row), y)
        return y

    def within(self, powers, theta):
        """The coefficient of every field is a polynomial without a constant term."""
        return self.end(
            [
                [sum(float(a) * theta ** (i + 1) for i, a in enumerate(c)) for c in zip(*p)]  # noqa: B905
                for p in powers
            ]
        )

    def error(self, tableau, estimate):
        embedded = tableau.embedded
        if estimate == "group":
            error = self.y1 - self.end(embedded)
        else:
            # The velocity at the end of what the embedded adds up to more than the step.
            difference = sum(map(self.sum, embedded)) - sum(map(self.sum, tableau.beta))
            error = self.geometry.velocity(difference, self.y1)
        if any(any(row[tableau.num_stages :]) for row in embedded):
            # First same as last: the last stage's distance from the end, where that shows more.
            apart, way = self.y1 - self.before, self.y1 - self.y
            size = np.linalg.norm(apart)
            other = apart * size / (size + np.linalg.norm(way))
            error = max(error, other, key=np.linalg.norm)
        return error


def one_step(solver, problem) -> Any:
    """The end, the error, a point within the step, and what the next step starts with."""
    field, y0, args, _ = problem
    term = cfjax.LieTerm(field)

    @functools.partial(jax.jit, compiler_options=problems.QUICK)
    def step(t0, t1, y0, args):
        state = solver.init(term, t0, t1, y0, args)
        y1, error, info, state, _ = solver.step(term, t0, t1, y0, args, state, made_jump=False)
        path = solver.interpolation_cls(t0=t0, t1=t1, **info)
        return y1, error, path.evaluate(t0 + THETA * (t1 - t0)), state.first

    times = jnp.asarray(T0), jnp.asarray(T0 + H)
    return step(*times, *problems.arrays((y0, args)))


# Coefficients are taken from one place whatever the field is, so every method has one step of
# every estimate on lines. Short vectors, and matrices from each side, go other ways through a step.
ESTIMATES = [
    (name, estimate)
    for name, solver in SOLVERS.items()
    for estimate in ("group", "algebra")
    if estimate == "group" or (solver.tableau.embedded and "family" not in name)
]
QUICK = [
    *((*case, LINES) for case in ESTIMATES),
    *((*case, DRIVEN) for case in [("CF4", "group"), ("CF4", "algebra"), ("CF2", "group")]),
    *((*case, BODY) for case in [("CF4", "group"), ("CF3", "algebra"), ("CK34", "group")]),
    *((*case, LEFT) for case in [("CF4", "group"), ("Luscher3", "group")]),
    ("CF3", "group", RIGHT),
]
SLOW = [
    (*case, problem)
    for problem in (BODY, LEFT, RIGHT)
    for case in ESTIMATES
    if not any((*case, problem) == quick for quick in QUICK)
    # 43 flows of matrices in one program.
    and not (case[0] == "CG5" and problem is not BODY)
]


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    "name, estimate, problem",
    [
        pytest.param(*case, id=f"{case[0]}-{case[1]}-{case[2][0].__name__}", marks=marks)
        for cases, marks in ((QUICK, []), (SLOW, [pytest.mark.slow]))
        for case in cases
    ],
)
def test_a_step_is_what_its_tableau_says(name, estimate, problem):
    tableau = SOLVERS[name].tableau
    solver = SOLVERS[name]
    if estimate == "algebra":
        solver = type(solver)(estimate="algebra")
    expected = Interpreter(tableau, problem[3], T0, problem[1], H)
    end, error, point, first = one_step(solver, problem)
    # At most 43 flows with coefficients up to 1, each wrong by a few roundings of entries of
    # size 1; the coefficients of YRK135 grow to 36 and cancel.
    atol = 1e-13 if name in ("YRK135", "CG5") else 1e-14
    np.testing.assert_allclose(end, expected.y1, rtol=0, atol=atol)
    np.testing.assert_allclose(
        point, expected.within(continuous_extension(tableau), THETA), rtol=0, atol=10 * atol
    )
    if tableau.embedded is None:
        assert error is None
    else:
        right = expected.error(tableau, estimate)
        assert np.linalg.norm(right) > 1e-8
        np.testing.assert_allclose(error, right, rtol=0, atol=2 * atol)
    if first is not None:
        # The value of the last field, without the step size. Another stage's value would be stale.
        last = problem[0](jnp.asarray(T0 + H), *problems.arrays((expected.y1, problem[2])))
        problems.assert_close(first, last, 1e-13)
    assert (first is not None) == solver.first_same_as_last
