"""`RKMK(..., coordinates="cayley")`, and `CayleyRK4`."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import matrix_checks
import numpy as np
import problems
import pytest
from matrix_checks import fixed_of, product
from matrix_problems import PROBLEMS, Problem, skew
from scipy.linalg import expm
from solver_table import runge_kutta_extension

import cfjax

CAYLEY: Any = {"coordinates": "cayley"}
RKMK5, RKMK8 = cfjax.RKMK5(**CAYLEY), cfjax.RKMK8(**CAYLEY)
# Programs with one stage for all compile faster, and so do those of few stages.
SHORT = cfjax.RKMK(diffrax.Heun.tableau, **CAYLEY, estimate=None)
ROLLED = {
    "RKMK5": cfjax.RKMK5(**CAYLEY, unroll=False),
    "RKMK8": cfjax.RKMK8(**CAYLEY, unroll=False),
}
# Steps to t = 2 that leave more than rounding.
STEPS = {"RKMK5": (16, 32, 64), "RKMK8": (6, 8, 12)}

# Groups of matrices with y^H J y = J: y' = b y + y c is a field from one side,
# (b + y c y^-1) y or y (y^-1 b y + c), and the solution is exp(t b) y0 exp(t c).

_RNG = np.random.default_rng(5)
SYMPLECTIC = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(3))
LORENTZ = np.diag([1.0, 1.0, 1.0, -1.0])
SPLIT = np.diag([1.0, 1.0, -1.0, -1.0])
FORMS = {"SO(5)": np.eye(5), "Sp(6)": SYMPLECTIC, "SO(3, 1)": LORENTZ, "SU(2, 2)": SPLIT + 0j}
FORMS |= {"SU(3)": np.eye(3) + 0j, "U(3)": np.eye(3) + 0j, "GL(4)": None}
FORMS["SL(3), complex"] = None


def element(group):
    """Of the algebra, of norm 1."""
    form, n = FORMS[group], 3 if group == "SL(3), complex" else 4
    if form is None:
        a = _RNG.normal(size=(n, n)) + (1j * _RNG.normal(size=(n, n)) if n == 3 else 0)
    elif group == "Sp(6)":
        s = _RNG.normal(size=form.shape)
        a = form @ (s + s.T)
    else:
        a = np.linalg.inv(form) @ skew(len(form), np.iscomplexobj(form))
    if group.startswith("S"):
        a = a - np.trace(a) / len(a) * np.eye(len(a))
    return a / np.linalg.norm(a, 2)


def group_problem(group, frame):
    form = FORMS[group]

    def inverse(y):
        if form is None:
            return jnp.linalg.inv(y)
        return jnp.asarray(np.linalg.inv(form), y.dtype) @ y.conj().T @ jnp.asarray(form, y.dtype)

    def left(t, y, args):
        b, c = args
        return cfjax.LeftMatrix(b + y @ c @ inverse(y))

    def right(t, y, args):
        b, c = args
        return cfjax.RightMatrix(inverse(y) @ b @ y + c)

    b, c = element(group), element(group)
    y0 = np.eye(len(b), dtype=b.dtype)
    field = left if frame == "fixed" else right
    return Problem(field, y0, (b, c), lambda t: expm(t * b) @ expm(t * c))


def phase():
    """In U(3), with a trace that moves: the solution in SU(3) times a phase."""
    given = group_problem("SU(3)", "fixed")

    def field(t, y, args):
        within = given.field(t, y, args)
        unit = (1j * jnp.cos(t).astype(complex) / 3) * jnp.eye(3, dtype=complex)
        return cfjax.LeftMatrix(within.a + unit)

    return given._replace(field=field, exact=lambda t: given.exact(t) * np.exp(1j * np.sin(t) / 3))


def sphere(n):
    """Oja's flow of one column, p' = d p - p (p^T d p), as a rotation of a unit vector."""
    d, y0 = np.linspace(-1, 1, n), np.ones(n) / n**0.5

    def exact(t):
        y = np.exp(t * d) * y0
        return y / np.linalg.norm(y)

    return Problem(lambda t, y, d: cfjax.SphereRotation(d * y), y0, d, exact)


SIDES = {"SO(5)": "fixed", "Sp(6)": "body", "SO(3, 1)": "fixed", "SU(2, 2)": "body"}
SIDES |= {"SU(3)": "body", "GL(4)": "fixed", "SL(3), complex": "body"}
GROUPS = {group: group_problem(group, frame) for group, frame in SIDES.items()}
GROUPS["U(3)"] = phase()
OTHERS = ["columns", "orthonormal columns, low rank", "bordered", "Toda", "conjugation", "Riccati"]
OTHERS = {x: PROBLEMS[x] for x in OTHERS} | {f"sphere, n = {n}": sphere(n) for n in (3, 5)}
GIVEN = GROUPS | OTHERS


def some(*names):
    return {name: GIVEN[name] for name in names}


def fixed(name, y):
    """The form and the determinant of a group, which occur in no step."""
    if name not in FORMS:
        return fixed_of(name, y)
    form = FORMS[name]
    of_form = np.zeros(0) if form is None else (y.conj().T @ form @ y).ravel()
    return np.append(of_form, 0 if name in ("SU(2, 2)", "U(3)", "GL(4)") else np.linalg.det(y))


# From each side, with a trace, and tangent vectors. Those from both sides are below.
FEW = some("Sp(6)", "U(3)", "orthonormal columns, low rank")


@pytest.mark.parametrize(
    "given, name",
    [
        pytest.param(FEW, "RKMK5", id="few-RKMK5"),
        pytest.param(GIVEN, "RKMK5", id="all-RKMK5", marks=pytest.mark.slow),
        pytest.param(GIVEN, "RKMK8", id="all-RKMK8", marks=pytest.mark.slow),
    ],
)
def test_order_and_manifold_against_exact_answers(given, name, subtests):
    """Tsitouras' error terms of order 5 are so small that the next ones show, by an order where the
    solution grows. Roundings are of products of entries up to e^2, as the algebra's have norm 1.
    """
    few, slopes = (1.0, 3 if name == "RKMK5" else 1), (-0.75, 1.3)
    matrix_checks.check_order(subtests, ROLLED[name], given, STEPS[name], slopes, few, fixed)


def spinning(t, y, args):
    b, c = args
    turn, other = jnp.stack([jnp.cos(t), jnp.sin(2 * t)]).astype(y.dtype)
    a = turn * b + other * y @ c @ y.conj().T
    # In the algebra to the last bit: rounding of this product is no skew matrix, and adds up.
    return cfjax.LeftMatrix((a - a.conj().T) / 2)


def boosted(t, y, args):
    b, c = args
    # Bounded, as the exact solution is the product of two that are.
    a = LORENTZ @ (jnp.cos(t) * (b + y @ c @ LORENTZ @ y.T @ LORENTZ))
    return cfjax.LeftMatrix(LORENTZ @ (a - a.T) / 2)


VARYING = {
    "SO(5)": (spinning, np.eye(5), (skew(5), skew(5))),
    "SU(3)": (spinning, np.eye(3) + 0j, (skew(3, True), skew(3, True))),
    "SO(3, 1)": (boosted, np.eye(4), (element("SO(3, 1)"), element("SO(3, 1)"))),
    "sphere": (
        lambda t, y, args: cfjax.SphereRotation(args * jnp.sin(t) + jnp.roll(y, 1)),
        *(np.eye(5)[0], np.arange(5.0)),
    ),
}


@pytest.mark.parametrize(
    "names, more, num_steps",
    [
        (["SO(5)"], {}, 10_000),
        pytest.param(VARYING, matrix_checks.VARYING, 100_000, marks=pytest.mark.slow),
    ],
    ids=["few", "all"],
)
def test_many_steps_stay_on_the_manifold(names, more, num_steps, subtests):
    given = {name: Problem(*VARYING[name], exact=None) for name in names}
    solver = ROLLED["RKMK5"]
    matrix_checks.check_many_steps(subtests, solver, given, num_steps, fixed, more=more)


# One step: the Runge-Kutta numbers of these coordinates alone

THETA = 0.4


def scalar_step(solver, rate):
    """A step of `v' = rate(v)` from 0, in NumPy: v at its end, and at THETA within it."""
    n, ks = len(solver.b), [rate(0.0)]
    extension = runge_kutta_extension(solver.a[:n], solver.b, solver.order(None))

    def total(weights):
        return sum(float(w) * k for w, k in zip(weights, ks, strict=False))

    for row in (*solver.a[1:n], *extension.rows):
        ks.append(rate(total(row)))
    (powers,) = extension.weights
    weights = sum(np.array(row, float) * THETA**k for k, row in enumerate(powers, 1))
    return total(solver.b), total(weights)


def turn_of(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


# Growth costs the digits that the pages say, of steps that multiply by e^w.
@pytest.mark.parametrize(
    "solver, growth",
    [
        (RKMK5, {2: 1e-3, 3: 0.2, 4: 1}),
        pytest.param(ROLLED["RKMK8"], {2: 1e-4, 3: 1e-2, 4: 0.1, 6: 1}, marks=pytest.mark.slow),
    ],
    ids=["RKMK5", "RKMK8"],
)
def test_one_step_has_its_own_numbers(solver, growth, subtests):
    """Turns have `v' = w (1 + v^2 / 4)` and angles 2 atan(v / 2); boosts the hyperbolic ones."""
    w, rates = 0.9, np.array(list(growth))
    turn, boost = np.zeros((2, 3, 3))
    turn[0, 1], turn[1, 0], boost[0, 1], boost[1, 0] = -w, w, w, w
    start = np.diag([1.0, 2.0, 3.0])
    angles = 2 * np.arctan(np.divide(scalar_step(solver, lambda v: w * (1 + v * v / 4)), 2))
    rapidities = 2 * np.arctanh(np.divide(scalar_step(solver, lambda v: w * (1 - v * v / 4)), 2))
    # Not what other coordinates give, which are exact here.
    assert min(abs(angles[0] - w), abs(rapidities[0] - w)) > 1e-9
    numbers = scalar_step(solver, lambda v: rates * (1 - v * v / 4))
    rational = [(1 + x / 2) / (1 - x / 2) for x in numbers]
    # To one digit.
    off = np.abs(rational[0] / np.exp(rates) - 1)
    np.testing.assert_allclose(off, list(growth.values()), rtol=0.3, atol=0)
    points = np.ones((len(rates), 3))
    given = {
        "turn": (cfjax.LeftMatrix, np.eye(3), turn),
        "boost": (cfjax.LeftMatrix, np.eye(3), boost),
        "two-sided": (cfjax.Congruence, start, turn),
        "growth": (cfjax.LeftMatrix, points, rates[:, None, None] * np.diag([1.0, 0.0, 0.0])),
    }
    given = {
        name: Problem(lambda t, y, a, cls=cls: cls(a), y0, a, None)
        for name, (cls, y0, a) in given.items()
    }
    whole = product(given)

    @jax.jit
    def step(y0, args):
        times = jnp.asarray(0.0), jnp.asarray(1.0)
        end, _, info, *_ = problems.first_step(solver, whole.term, *times, y0, args)
        path = solver.interpolation_cls(t0=times[0], t1=times[1], **info)
        return end, path.evaluate(THETA)

    for k, found in enumerate(step(whole.y0, whole.args)):
        expected = {
            "turn": turn_of(angles[k]),
            "boost": expm(rapidities[k] / w * boost),
            "two-sided": turn_of(angles[k]) @ start @ turn_of(-angles[k]),
            "growth": np.stack([rational[k], *np.ones((2, len(rates)))], 1),
        }
        for name, y in expected.items():
            with subtests.test(name=name, k=str(k)):
                rtol = 1e-13 if name == "growth" else 0
                np.testing.assert_allclose(found[name], y, rtol=rtol, atol=4e-15)


# Means of three angles, whose sum is half a turn at a third of one. There the angles of the step
# may be on the other side.
MEANS = np.array([0.3, 1.0, np.pi / 3 - 1e-4, np.pi / 3 + 1e-4, 1.06, 1.5, 2.0, 2.35])
MEANS = np.concatenate([MEANS, -MEANS])


def turns(means, solver, h):
    """A step along `i (mean + h)`: by the angles of the step, with the mean of the trace."""
    w, v = np.linalg.eigh(h)
    w = means[:, None] + w
    angles = 2 * np.arctan(scalar_step(solver, lambda x: w * (1 + x * x / 4))[0] / 2)
    angles = angles + np.mean(w - angles, axis=1, keepdims=True)
    return (v * np.exp(1j * angles)[:, None]) @ v.conj().T


@pytest.mark.parametrize(
    "parts, dtype",
    [
        (("left", "row"), np.complex128),
        pytest.param(("right", "column"), np.complex64, marks=pytest.mark.slow),
    ],
    ids=["double", "single"],
)
def test_a_trace_beyond_half_a_turn(parts, dtype):
    """A determinant gives its logarithm up to whole turns, and a third of one is no rounding."""
    rng, solver = np.random.default_rng(7), cfjax.RKMK(diffrax.Bosh3.tableau, **CAYLEY)
    h, start = (rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3)) for _ in range(2))
    h = h + h.conj().T
    h = 0.2 * (h - np.trace(h) / 3 * np.eye(3)) / np.linalg.norm(h, 2)
    points = {"left": start, "right": start, "column": start[:, 0], "row": start[0]}
    y0 = {x: jnp.asarray(np.stack([points[x]] * len(MEANS)), dtype) for x in parts}

    def field(t, y, a):
        classes = {"left": cfjax.LeftMatrix, "column": cfjax.LeftMatrix}
        return {x: classes.get(x, cfjax.RightMatrix)(a) for x in y}

    def end(shift):
        a = jax.vmap(lambda k: 1j * (k * jnp.eye(3, dtype=dtype) + jnp.asarray(h, dtype)))(
            MEANS.astype(dtype) + shift.astype(dtype)
        )
        ys = cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 1.0, y0, a, num_steps=1).ys
        return {x: y[-1] for x, y in ys.items()}

    def expected(shift):
        turn = turns(MEANS + shift, solver, h)
        exact = np.stack([expm(1j * ((x + shift) * np.eye(3) + h)) for x in MEANS])
        # Of order 3, and a sixth of the way to another root.
        np.testing.assert_allclose(turn, exact, rtol=0, atol=0.3)
        left, right = turn @ start, start @ turn
        return {"left": left, "right": right, "column": left[..., 0], "row": right[:, 0]}

    slope = jax.jit(
        lambda x: jax.jvp(end, (x,), (jnp.ones_like(x),)), compiler_options=problems.QUICK
    )
    found, slopes = slope(jnp.zeros((), jnp.finfo(dtype).dtype))
    values = [expected(k * 1e-3) for k in (0, 1, -1, 2, -2)]
    # Some tens of roundings of angles up to 7; the quotients have order 4.
    atol = 40 * float(jnp.finfo(dtype).eps)
    for x in parts:
        y, *ys = (value[x] for value in values)
        np.testing.assert_allclose(found[x], y, rtol=0, atol=atol)
        quotient = (8 * (ys[0] - ys[1]) - (ys[2] - ys[3])) / 12e-3
        np.testing.assert_allclose(slopes[x], quotient, rtol=0, atol=4 * atol + 1e-10)


def rk4(f, t, h, y):
    k1 = f(t, y)
    k2 = f(t + h / 2, y + h / 2 * k1)
    k3 = f(t + h / 2, y + h / 2 * k2)
    k4 = f(t + h, y + h * k3)
    return y + h * (k1 + 2 * k2 + 2 * k3 + k4) / 6


def test_beside_a_sphere_it_is_the_classical_method():
    """In a linear space, and a field may read a part at rest."""

    def field(t, y, args):
        axis = cfjax.SphereRotation(y["scale"] * jnp.cos(t + y["axis"]))
        # The same field with a number.
        alone = cfjax.SphereRotation(0.7 * jnp.cos(t + y["alone"]))
        return {"axis": axis, "alone": alone, "place": jnp.sin(y["place"]) * t, "scale": None}

    t, h, place, axis = 0.3, 0.4, np.arange(3.0), np.eye(3)[0]
    y0 = problems.arrays({"axis": axis, "alone": axis, "place": place, "scale": 0.7})
    term, solver = cfjax.LieTerm(field), cfjax.CayleyRK4()
    found = jax.jit(lambda y0: problems.first_step(solver, term, t, t + h, y0, None)[0])(y0)
    expected = rk4(lambda t, y: np.sin(y) * t, t, h, place)
    np.testing.assert_allclose(found["place"], expected, rtol=0, atol=1e-15)
    assert float(found["scale"]) == 0.7
    # The same operations, which XLA may fuse otherwise.
    np.testing.assert_allclose(found["axis"], found["alone"], rtol=0, atol=1e-14)


# Derivatives, batches, precision


REST = "SO(5)", "Riccati", "bordered", "orthonormal columns, low rank"


@pytest.mark.parametrize(
    "names", [("sphere, n = 3",), pytest.param(("SU(3)", "Toda", *REST), marks=pytest.mark.slow)]
)
def test_derivatives_are_those_of_difference_quotients(names):
    matrix_checks.check_derivatives(SHORT, some(*names), 4e-11)


@pytest.mark.parametrize(
    "names", [("sphere, n = 5",), pytest.param(("SU(3)", "Toda", *REST), marks=pytest.mark.slow)]
)
def test_vmap_and_leading_axes_are_single_solves(names):
    matrix_checks.check_batches(SHORT, some(*names))


def test_a_matrix_for_all_points_stays_one():
    """An axis of 1 is broadcast, and so are the coordinates: each point moves by one matrix."""
    b, c = skew(5), skew(5)
    points = _RNG.normal(size=(3, 5))

    def field(t, y, args):
        a = b + jnp.sin(t) * c
        return {"points": cfjax.LeftMatrix(a[None]), "matrix": cfjax.LeftMatrix(a)}

    y0 = {"points": points, "matrix": np.eye(5)}
    ends: Any = Problem(field, y0, None, None).end(SHORT, 1.0, 4)
    np.testing.assert_allclose(ends["points"], points @ ends["matrix"].T, rtol=0, atol=1e-14)


def test_single_precision():
    # Some tens of roundings of numbers up to 3.
    matrix_checks.check_single_precision(ROLLED["RKMK5"], some("SU(3)"), 3e-5)


# Nearly half a turn


def test_nearly_half_a_turn_fails_and_is_taken_again(subtests):
    # One of two elements.
    cases: Any = {"LeftMatrix": (cfjax.LeftMatrix, np.array([1.0, 3.0]))}
    cases["LowRankSkew"] = cfjax.LowRankSkew, np.array(3.0)
    matrix_checks.check_steps_that_are_too_long(subtests, ROLLED["RKMK5"], cases)


def oscillator(t, y, args):
    return cfjax.LeftMatrix(args)


def test_units_are_no_turn():
    """An oscillator by half a radian in each step, with any unit of its velocity."""
    for units in (1.0, 1e3, 1e-4):
        matrix = 0.5 * np.array([[0.0, units], [-1 / units, 0.0]])
        found = Problem(oscillator, np.eye(2), matrix, None).end(RKMK8, 4.0, 4)
        # Of order 8 in steps of half a radian.
        np.testing.assert_allclose(found, expm(4 * matrix), rtol=1e-9, atol=0)


@pytest.mark.slow
def test_a_rejected_step_has_no_derivative():
    found = matrix_checks.slope_of_a_controlled_turn(RKMK5, cfjax.LeftMatrix)
    # The entry is cos(angle).
    np.testing.assert_allclose(found, -3 * np.sin(3), rtol=0, atol=1e-5)
