"""One step of every commutator-free and Munthe-Kaas method against an interpreter in NumPy.

The order conditions check the coefficients exactly, in methods/test_order_conditions.py. With a
step that is right to rounding the order follows, so observed slopes are for few methods.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from solver_table import (
    COMMUTATOR_FREE,
    MUNTHE_KAAS,
    Row,
    continuous_extension,
    named,
    runge_kutta_extension,
)

import cfjax

COMMUTATOR_FREE = named("commutator-free", "low-storage") | {
    name: COMMUTATOR_FREE[name] for name in ("family A, 1", "family B, 0.1")
}
# RKMK5 and RKMK8 are those of Tsit5 and Dopri8.
METHODS: dict[str, Row] = COMMUTATOR_FREE | {
    name: row
    for name, row in (named("Munthe-Kaas") | MUNTHE_KAAS).items()
    if row.takes == "brackets" and name not in ("Tsit5", "Dopri8")
}
# Times, and the place within the step.
T0, H, THETA = 0.3, 0.25, 0.4


class Line(cfjax.AbstractAlgebraElement):
    """Affine fields `slope y + shift` of a line, entry by entry: two of them do not commute.

    A step is a small program, so that every method can have one.
    """

    slope: jax.Array
    shift: jax.Array

    def flow(self, point):
        return jnp.exp(self.slope) * point + jnp.expm1(self.slope) / self.slope * self.shift

    def tangent(self, point):
        return self.slope * point + self.shift

    def bracket(self, other):
        return Line(0 * self.slope, self.slope * other.shift - other.slope * self.shift)


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


class OnLines:
    """The same in NumPy: the field, its velocity, its flow and its bracket."""

    # How many brackets the inverse derivative of the exponential has at most.
    most_brackets = 0

    @staticmethod
    def field(t, y):
        return np.array(line_coefficients(np, t, y, SLOPES))

    @staticmethod
    def velocity(f, y):
        return f[0] * y + f[1]

    @staticmethod
    def flow(f, y):
        return np.exp(f[0]) * y + np.expm1(f[0]) / f[0] * f[1]

    @staticmethod
    def bracket(f, g):
        return np.array([0 * f[0], f[0] * g[1] - g[0] * f[1]])


class OnDrivenLines(OnLines):
    @staticmethod
    def field(t, y):
        return np.array(driven_coefficients(np, t, SLOPES))


class FromLeft:
    most_brackets = 0

    @staticmethod
    def field(t, y):
        return problems.generator(np, t, y, problems.GENERATORS)

    @staticmethod
    def velocity(f, y):
        return f @ y

    @staticmethod
    def flow(f, y):
        return scipy.linalg.expm(f) @ y

    @staticmethod
    def bracket(f, g):
        return f @ g - g @ f


class FromRight(FromLeft):
    @staticmethod
    def velocity(f, y):
        return y @ f

    @staticmethod
    def flow(f, y):
        return y @ scipy.linalg.expm(f)

    @staticmethod
    def bracket(f, g):
        return g @ f - f @ g


class OnSphere(FromLeft):
    # In place of a closed form: a step turns by less than 1, which leaves out (1 / 2 pi)^20.
    most_brackets = 18

    @staticmethod
    def field(t, y):
        return problems.hat(np.array([np.sin(2 * t), np.cos(t), t]) - y / problems.INERTIA)


# More than the entries of a short vector, which go another way through a step.
_RNG = np.random.default_rng(3)
SLOPES = _RNG.uniform(0.5, 1.5, 9)
LINES = line, _RNG.uniform(-1, 1, 9), SLOPES, OnLines
DRIVEN = driven_line, LINES[1], SLOPES, OnDrivenLines
BODY = problems.driven_body, problems.MOMENTUM, problems.INERTIA, OnSphere
LEFT = problems.left_matrix, problems.ORTHOGONAL, problems.GENERATORS, FromLeft
RIGHT = problems.right_matrix, problems.ORTHOGONAL, problems.GENERATORS, FromRight


class Interpreter:
    """What the coefficients of a commutator-free method say, row by row."""

    def __init__(self, solver, geometry, y):
        self.geometry, self.y, self.fields = geometry, y, []
        self.tableau = solver.tableau
        for rows in self.tableau.alpha:
            self.before = self.end(rows)
            self.fields.append(self.field(sum(a for row in rows for a in row), self.before))
        self.y1 = self.end(self.tableau.beta)
        self.fields.append(self.field(1, self.y1))

    def field(self, c, point):
        return H * self.geometry.field(T0 + float(c) * H, point)

    def sum(self, row):
        return sum(float(a) * f for a, f in zip(row, self.fields, strict=False))

    def end(self, rows):
        y = self.y
        for row in rows:
            y = self.geometry.flow(self.sum(row), y)
        return y

    def within(self):
        """The coefficient of every field is a polynomial without a constant term."""
        return self.end(
            [
                [sum(float(a) * THETA ** (i + 1) for i, a in enumerate(c)) for c in zip(*powers)]  # noqa: B905
                for powers in self.powers()
            ]
        )

    def powers(self) -> Any:
        return continuous_extension(self.tableau)

    def error(self, estimate):
        embedded = self.tableau.embedded
        if embedded is None:
            return None
        if estimate == "group":
            error = self.y1 - self.end(embedded)
        else:
            # The velocity at the end of what the embedded adds up to more than the step.
            difference = sum(map(self.sum, embedded)) - sum(map(self.sum, self.tableau.beta))
            error = self.geometry.velocity(difference, self.y1)
        if any(any(row[self.tableau.num_stages :]) for row in embedded):
            # First same as last: the last stage's distance from the end, where that shows more.
            apart, way = self.y1 - self.before, self.y1 - self.y
            size = np.linalg.norm(apart)
            other = apart * size / (size + np.linalg.norm(way))
            error = max(error, other, key=np.linalg.norm)
        return error


# B_k / k!
BERNOULLI = {0: 1, 1: -1 / 2, 2: 1 / 12, 4: -1 / 720, 6: 1 / 30240, 8: -1 / 1209600}
BERNOULLI |= {k: -2 * (-1) ** (k / 2) / (2 * math.pi) ** k for k in range(10, 20, 2)}


class MuntheKaasInterpreter(Interpreter):
    """What the coefficients of a Munthe-Kaas method say: the step is one flow."""

    def __init__(self, solver, geometry, y):
        self.geometry, self.y, self.fields = geometry, y, []
        self.solver = solver
        self.most_brackets = max(geometry.most_brackets, solver.order(None) - 2)
        self.v, self.difference = self.elements()
        self.y1 = geometry.flow(self.v, y)

    def stage(self, c, u):
        """How u changes where the point to which it leads moves with the field."""
        term = self.field(c, self.geometry.flow(u, self.y))
        total = 0
        for k in range(self.most_brackets + 1):
            total = total + BERNOULLI.get(k, 0) * term
            term = self.geometry.bracket(u, term)
        return total

    def elements(self) -> Any:
        """The element of the step, and by how much that of the embedded method differs."""
        solver, n = self.solver, len(self.solver.b)
        self.fields.append(self.field(0, self.y))
        for row, c in zip(solver.a[1:], solver.c[1:], strict=True):
            self.fields.append(self.stage(c, self.sum(row)))
        v, difference = self.sum(solver.b), self.sum(solver.b_error)
        self.extension = runge_kutta_extension(solver.a[:n], solver.b, solver.order(None))
        self.fields = self.fields[:n]
        for row, c in zip(self.extension.rows, self.extension.times, strict=True):
            self.fields.append(self.stage(c, self.sum(row)))
        return v, difference

    def powers(self):
        return self.extension.weights

    def error(self, estimate):
        if self.difference is None:
            return None
        if estimate == "group":
            return self.y1 - self.geometry.flow(self.v - self.difference, self.y)
        return self.geometry.velocity(self.difference, self.y1)


class PublishedInterpreter(MuntheKaasInterpreter):
    """The methods of orders 3 and 4 with few brackets, as in the paper."""

    def stage(self, c, u):
        return self.field(c, self.geometry.flow(u, self.y))

    def elements(self):
        bracket = self.geometry.bracket
        k1 = self.field(0, self.y)
        k2 = self.stage(1 / 2, k1 / 2)
        q1, q2 = k1, k2 - k1
        if isinstance(self.solver, cfjax.RKMK3):
            k3 = self.stage(1, -k1 + 2 * k2)
            q3 = k3 - 2 * k2 + k1
            self.fields = [k1, k2, k3, bracket(k1, k2)]
            v = q1 + q2 + q3 / 6 - bracket(q1, q2) / 6
            # Of the midpoint rule.
            return v, v - k2
        k3 = self.stage(1 / 2, q1 / 2 + q2 / 2 - bracket(q1, q2) / 8)
        q3 = k3 - k2
        k4 = self.stage(1, q1 + q2 + q3)
        q4 = k4 - 2 * k2 + k1
        self.fields = [k1, k2, k3, k4, bracket(k1, k4)]
        return q1 + q2 + q3 / 3 + q4 / 6 - bracket(q1, q2) / 6 - bracket(q1, q4) / 12, None

    def powers(self):
        return self.solver.continuous_extension


def interpreter_of(name, solver, problem) -> Any:
    cls = Interpreter if name in COMMUTATOR_FREE else MuntheKaasInterpreter
    if name in ("RKMK3", "RKMK4"):
        cls = PublishedInterpreter
    return cls(solver, problem[3], problem[1])


def one_step(solver, field):
    """The end, the error, a point within the step, and what the next step starts with."""
    term = cfjax.LieTerm(field)

    def step(t0, t1, y0, args):
        state = solver.init(term, t0, t1, y0, args)
        y1, error, info, state, _ = solver.step(term, t0, t1, y0, args, state, made_jump=False)
        path = solver.interpolation_cls(t0=t0, t1=t1, **info)
        return y1, error, path.evaluate(t0 + THETA * (t1 - t0)), state.first

    return step


def assert_step(name, estimate, problem, found_by) -> None:
    """`found_by(step, *args)` runs the step."""
    solver = METHODS[name].make()._with(estimate=estimate)
    expected = interpreter_of(name, solver, problem)
    field, y0, args, _ = problem
    times = jnp.asarray(T0), jnp.asarray(T0 + H)
    end, error, point, first = found_by(one_step(solver, field), *times, y0, args)
    # At most 43 flows with coefficients up to 1, each wrong by a few roundings of entries of
    # size 1; the coefficients of YRK135 and RKMK8 grow to 36 and 100 and cancel.
    atol = 1e-13 if name in ("YRK135", "CG5", "RKMK8") else 1e-14
    np.testing.assert_allclose(end, expected.y1, rtol=0, atol=atol)
    np.testing.assert_allclose(point, expected.within(), rtol=0, atol=10 * atol)
    right = expected.error(estimate)
    if right is None:
        assert error is None
    else:
        assert np.linalg.norm(right) > 1e-8
        np.testing.assert_allclose(error, right, rtol=0, atol=2 * atol)
    if first is not None:
        # The value of the last field, without the step size. Another stage's value would be stale.
        last = field(jnp.asarray(T0 + H), *problems.arrays((expected.y1, args)))
        problems.assert_close(first, last, 1e-13)
    assert (first is not None) == solver.first_same_as_last


# Coefficients are taken from one place whatever the field is, so every method has one step of
# every estimate on lines. Short vectors, and matrices from each side, go other ways through a step.
ESTIMATES = [
    (name, estimate)
    for name, row in METHODS.items()
    for estimate in ("group", "algebra")
    if estimate == "group" or (row.embedded and "family" not in name)
]
QUICK = [
    ("CF3", "algebra", BODY),
    ("RKMK4", "group", BODY),
    ("RKMK3", "algebra", LEFT),
    ("CF3", "group", RIGHT),
]
SLOW = [
    # The estimate of RKMK8 is close to rounding there.
    *((*c, BODY) for c in ESTIMATES if (*c, BODY) not in QUICK and c[0] != "RKMK8"),
    *((name, "group", LEFT) for name in ("CF4", "CF54", "RKMK5")),
    *((name, "group", RIGHT) for name in ("CF54", "Luscher3", "RKMK5")),
]


def test_a_step_of_every_method_is_what_its_coefficients_say(subtests):
    cases = [(*case, LINES) for case in ESTIMATES]
    cases += [(*case, DRIVEN) for case in [("CF4", "group"), ("CF4", "algebra"), ("CF2", "group")]]
    for *case, problem in cases:
        with subtests.test(case=(*case, problem[0].__name__)):
            assert_step(*case, problem, problems.op_by_op)


@pytest.mark.parametrize(
    "name, estimate, problem",
    [
        pytest.param(*case, id=f"{case[0]}-{case[1]}-{case[2][0].__name__}", marks=marks)
        for cases, marks in ((QUICK, []), (SLOW, [pytest.mark.slow]))
        for case in cases
    ],
)
def test_a_step_of_vectors_and_matrices_is_what_its_coefficients_say(name, estimate, problem):
    def compiled(step, *args):
        return jax.jit(step, compiler_options=problems.QUICK)(*problems.arrays(args))

    assert_step(name, estimate, problem, compiled)
