"""`RKMK(..., coordinates="cayley")`, and `CayleyRK4`."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import matrix_problems
import numpy as np
import problems
import pytest
from matrix_problems import BOTH, PROBLEMS, Problem, skew
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import cfjax
from cfjax.scenes import zeitlin

CAYLEY: Any = {"coordinates": "cayley"}
RKMK5, RKMK8 = cfjax.RKMK5(**CAYLEY), cfjax.RKMK8(**CAYLEY)
SOLVERS = {"RKMK5": RKMK5, "RKMK8": RKMK8}
# Of few stages, which compiles faster.
SHORT = cfjax.RKMK(diffrax.Bosh3.tableau, **CAYLEY)
# Steps to t = 2 that leave more than rounding.
STEPS = {"RKMK5": (16, 32, 64), "RKMK8": (6, 8, 12)}
ORDERS = {"RKMK5": 5, "RKMK8": 8}

# Groups of matrices with y^H J y = J: y' = b y + y c is a field from one side,
# (b + y c y^-1) y or y (y^-1 b y + c), and the solution is exp(t b) y0 exp(t c).

_RNG = np.random.default_rng(5)
SYMPLECTIC = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(3))
LORENTZ = np.diag([1.0, 1.0, 1.0, -1.0])
SPLIT = np.diag([1.0, 1.0, -1.0, -1.0])
FORMS = {"SO(5)": np.eye(5), "Sp(6)": SYMPLECTIC, "SO(3, 1)": LORENTZ, "SU(2, 2)": SPLIT + 0j}
FORMS |= {"SU(3)": np.eye(3) + 0j, "GL(4)": None, "SL(3), complex": None}


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


def sphere(n):
    """Oja's flow of one column, p' = d p - p (p^T d p), as a rotation of a unit vector."""
    d, y0 = np.linspace(-1, 1, n), np.ones(n) / n**0.5

    def exact(t):
        y = np.exp(t * d) * y0
        return y / np.linalg.norm(y)

    return Problem(lambda t, y, d: cfjax.SphereRotation(d * y), y0, d, exact)


GROUPS = {
    f"{group}, {frame} frame": group_problem(group, frame)
    for group in FORMS
    for frame in ("fixed", "body")
}
OTHERS = ["columns", "orthonormal columns, low rank", "bordered", "Toda", "conjugation", "Riccati"]
GIVEN = GROUPS | {x: PROBLEMS[x] for x in OTHERS} | {f"sphere, n = {n}": sphere(n) for n in (3, 5)}


@pytest.mark.representatives(16)
@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("problem", GIVEN)
def test_order_against_exact_answers(problem, name):
    """Mistakes in the coordinates leave order 2.

    Tsitouras' error terms of order 5 are so small that the next ones show, by an order where the
    solution grows.
    """
    given, solver, order = GIVEN[problem], SOLVERS[name], ORDERS[name]
    assert solver.order(None) == order
    exact = given.exact(2.0).ravel()
    off = problems.errors(given.field, solver, 2.0, given.y0, given.args, exact, STEPS[name])
    # A hundred roundings of numbers up to 3.
    steps, off = np.array(STEPS[name])[off > 5e-14], off[off > 5e-14]
    assert len(off) > 1
    assert order - 0.75 < problems.slope(steps, off) < order + 1.3


# On the manifold


@pytest.mark.parametrize("frame", ["fixed", "body"])
@pytest.mark.parametrize("group", [x for x in FORMS if x != "GL(4)"])
def test_groups_are_kept_without_their_form(group, frame):
    """In steps that are off by far more."""
    given, form = GROUPS[f"{group}, {frame} frame"], FORMS[group]
    y = np.asarray(given.end(RKMK5, 1.0, 3))
    assert np.abs(y - given.exact(1.0)).max() > 1e-8
    # Roundings of products of entries up to e^2, as the algebra's have norm 1.
    if form is not None:
        np.testing.assert_allclose(y.conj().T @ form @ y, form, rtol=0, atol=2e-14)
    if group != "SU(2, 2)":
        np.testing.assert_allclose(np.linalg.det(y), 1, rtol=0, atol=2e-14)


def test_a_determinant_that_moves_is_that_of_the_trace():
    """With a matrix of trace i cos(t): the determinant turns by sin(t), to the order."""
    b = skew(3, True)

    def field(t, y, b):
        trace = 1j * jnp.cos(t).astype(complex) * jnp.eye(3, dtype=complex)
        return cfjax.LeftMatrix(b + trace / 3 + y @ b @ y.conj().T)

    given = Problem(field, np.eye(3) + 0j, b, lambda t: np.exp(1j * np.sin(t)))
    y = np.asarray(given.end(RKMK8, 2.0, 8))
    # The error of order 8 in the integral of a cosine.
    np.testing.assert_allclose(np.linalg.det(y), given.exact(2.0), rtol=0, atol=1e-10)


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


@pytest.mark.parametrize(
    "problem, num_steps",
    [
        pytest.param(problem, n, marks=[pytest.mark.slow] * (n > 10_000))
        for problem in ("SO(3)", "SU(3)", "SO(8)", "SO(3, 1)", "low rank", "sphere", "Toda")
        for n in (10_000, 100_000)
    ],
)
def test_many_steps_stay_on_the_manifold(problem, num_steps):
    """With fields that vary, in steps of 0.1: the form of the start, to 5e-14."""
    columns, lattice = matrix_problems.ORTHONORMAL, matrix_problems.LATTICE
    pairs = [skew(6), skew(3)]
    fields = {
        "SO(3)": (spinning, np.eye(3), (skew(3), skew(3))),
        "SU(3)": (spinning, np.eye(3) + 0j, (skew(3, True), skew(3, True))),
        "SO(8)": (spinning, np.eye(8), (skew(8), skew(8))),
        "SO(3, 1)": (boosted, np.eye(4), (element("SO(3, 1)"), element("SO(3, 1)"))),
        "low rank": (matrix_problems.low_rank, columns, tuple(pairs)),
        "sphere": (
            lambda t, y, args: cfjax.SphereRotation(args * jnp.sin(t) + jnp.roll(y, 1)),
            np.eye(5)[0],
            np.arange(5.0),
        ),
        # Periodic in time, as Toda's own flow comes to rest.
        "Toda": (
            lambda t, y, args: cfjax.Conjugation(
                jnp.cos(t) * args + jnp.triu(y, 1) - jnp.tril(y, -1)
            ),
            lattice,
            skew(4),
        ),
    }
    given = Problem(*fields[problem], exact=lambda t: np.zeros(0))
    y = np.asarray(given.end(RKMK5, 0.1 * num_steps, num_steps))
    if problem == "Toda":
        found, expected = (
            [np.trace(np.linalg.matrix_power(x, k)) for k in range(1, 5)] for x in (y, given.y0)
        )
    else:
        form = LORENTZ if problem == "SO(3, 1)" else np.eye(len(y))
        found, expected = (x.conj().T @ form @ x for x in (y, given.y0))
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-14)
    if problem == "SU(3)":
        np.testing.assert_allclose(np.linalg.det(y), 1, rtol=0, atol=5e-14)


# One step: the Runge-Kutta numbers of these coordinates alone


def scalar_step(tableau, rate):
    """A step of `v' = rate(v)` from 0, in NumPy."""
    ks = []
    for row in ((), *tableau.a_lower):
        ks.append(rate(sum(a * k for a, k in zip(row, ks, strict=True))))
    return sum(b * k for b, k in zip(tableau.b_sol, ks, strict=True))


def turn_of(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize("tableau", [diffrax.Tsit5.tableau, diffrax.Dopri8.tableau])
@pytest.mark.parametrize("kind", ["turn", "boost", "two-sided"])
def test_one_step_has_its_own_numbers(kind, tableau):
    """Turns have `v' = w (1 + v^2 / 4)` and angles 2 atan(v / 2); boosts the hyperbolic ones."""
    w = 0.9
    start = np.diag([1.0, 2.0, 3.0]) if kind == "two-sided" else np.eye(3)
    a = np.zeros((3, 3))
    a[0, 1], a[1, 0] = (w, w) if kind == "boost" else (-w, w)
    if kind == "boost":
        rapidity = 2 * np.arctanh(scalar_step(tableau, lambda v: w * (1 - v * v / 4)) / 2)
        expected, error = expm(rapidity / w * a), abs(rapidity - w)
    else:
        angle = 2 * np.arctan(scalar_step(tableau, lambda v: w * (1 + v * v / 4)) / 2)
        expected, error = turn_of(angle), abs(angle - w)
        if kind == "two-sided":
            expected = expected @ start @ expected.T
    # Not what other coordinates give, which are exact here.
    assert error > 1e-9
    cls = cfjax.Congruence if kind == "two-sided" else cfjax.LeftMatrix
    given = Problem(lambda t, y, a: cls(a), start, a, lambda t: expected)
    found = given.end(cfjax.RKMK(tableau, **CAYLEY), 1.0, 1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=4e-15)


@pytest.mark.parametrize(
    "solver, tableau, errors",
    [
        (RKMK5, diffrax.Tsit5.tableau, {2: 1e-3, 3: 0.2, 4: 1}),
        (RKMK8, diffrax.Dopri8.tableau, {2: 1e-4, 3: 1e-2, 4: 0.1, 6: 1}),
    ],
    ids=SOLVERS,
)
def test_growth_costs_the_digits_that_the_pages_say(solver, tableau, errors):
    """Of a step that multiplies by e^w: the rational function of its own number, nothing worse."""
    w = np.array(list(errors))
    v = scalar_step(tableau, lambda v: w * (1 - v * v / 4))
    a = w[:, None, None] * np.diag([1.0, 0.0, 0.0])
    y0 = np.ones((len(w), 3))
    given = Problem(lambda t, y, a: cfjax.LeftMatrix(a), y0, a, None)
    found = np.asarray(given.end(solver, 1.0, 1))[:, 0]
    np.testing.assert_allclose(found, (1 + v / 2) / (1 - v / 2), rtol=1e-13, atol=0)
    off = np.abs(found / np.exp(w) - 1)
    # To one digit.
    np.testing.assert_allclose(off, list(errors.values()), rtol=0.3, atol=0)


# Means of three angles, whose sum is half a turn at a third of one. There the angles of the step
# may be on the other side.
MEANS = np.array([0.3, 1.0, np.pi / 3 - 1e-4, np.pi / 3 + 1e-4, 1.06, 1.5, 2.0, 2.35])
MEANS = np.concatenate([MEANS, -MEANS])


def turns(means, tableau, h):
    """A step along `i (mean + h)`: by the angles of the step, with the mean of the trace."""
    w, v = np.linalg.eigh(h)
    w = means[:, None] + w
    angles = 2 * np.arctan(scalar_step(tableau, lambda x: w * (1 + x * x / 4)) / 2)
    angles = angles + np.mean(w - angles, axis=1, keepdims=True)
    return (v * np.exp(1j * angles)[:, None]) @ v.conj().T


@pytest.mark.parametrize(
    "parts, dtype",
    [(("left", "row"), np.complex128), (("right", "column"), np.complex64)],
    ids=["double", "single"],
)
def test_a_trace_beyond_half_a_turn(parts, dtype):
    """A determinant gives its logarithm up to whole turns, and a third of one is no rounding."""
    rng = np.random.default_rng(7)
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
        ys = cfjax.integrate(cfjax.LieTerm(field), SHORT, 0.0, 1.0, y0, a, num_steps=1).ys
        return {x: y[-1] for x, y in ys.items()}

    def expected(shift):
        turn = turns(MEANS + shift, diffrax.Bosh3.tableau, h)
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


@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
def test_a_trace_that_depends_on_the_state():
    """Of a vector whose entries turn by their sizes, in steps up to a trace of 5."""
    mixing = 0.3 * np.array([[0.2, 1.0, 0.5j], [0.4, -0.3j, 1.0], [-1.0j, 0.5, 0.1]])
    y0 = np.array([0.6, 0.5j, 0.4 - 0.4j])

    def matrix(xp, t, y):
        sizes, t = y * xp.conj(y), xp.asarray(t, complex)
        return mixing + xp.diag(1j * (1.5 + 0.3 * xp.sin(t) + sizes) - 0.5 * xp.sum(sizes))

    t1, exactly = 6.0, {"rtol": 1e-12, "atol": 1e-12}
    exact = solve_ivp(lambda t, y: y @ matrix(np, t, y), (0, t1), y0, "DOP853", **exactly).y[:, -1]

    @jax.jit
    def controlled(tolerance):
        control = diffrax.PIDController(rtol=0.0, atol=tolerance)
        term = cfjax.LieTerm(lambda t, y, args: cfjax.RightMatrix(matrix(jnp, t, y)))
        start = jnp.asarray(y0)
        return diffrax.diffeqsolve(
            term, RKMK5, 0.0, t1, 0.8, start, stepsize_controller=control
        ).ys[-1]

    off = [np.abs(controlled(x) - exact).max() / x for x in (1e-2, 1e-4)]
    # The estimate is of a step, and errors of steps add up. Another root is off by 100 tolerances.
    assert max(off) < 10


A, B = _RNG.standard_normal((7, 7)) / 3, _RNG.standard_normal((7, 2)) / 3
Q = np.linalg.qr(_RNG.standard_normal((7, 2)))[0]


def low_rank(t, y, args):
    return cfjax.LowRankSkew(jnp.cos(t) * A @ y + B)


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
    g = np.cos(t) * A @ y + B
    target = ((g @ y.T - y @ g.T) @ y).ravel()
    weights, _, rank, _ = np.linalg.lstsq(np.stack(columns, 1), target)
    assert rank == len(basis) == 11
    return sum(w * b for w, b in zip(weights, basis, strict=True))


@pytest.mark.parametrize("unroll", [True, False])
def test_a_step_on_columns_is_rk4_in_the_tangent_space(unroll):
    t, h = 0.3, 0.4
    k1 = rate(t, 0 * Q)
    k2 = rate(t + h / 2, h / 2 * k1)
    k3 = rate(t + h / 2, h / 2 * k2)
    k4 = rate(t + h, h * k3)
    expected = cayley(a_of(h * (k1 + 2 * k2 + 2 * k3 + k4) / 6)) @ Q
    term, solver = cfjax.LieTerm(low_rank), cfjax.CayleyRK4(unroll=unroll)
    step = jax.jit(lambda y: problems.first_step(solver, term, t, t + h, y, None)[0])
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


# Flows with exact answers


def test_oja():
    """The span of exp(t d) y0, with orthonormal columns."""
    n, p, t1 = 20, 3, 2.0
    d, y0 = np.linspace(0, 3, n), np.linalg.qr(_RNG.normal(size=(n, p)))[0]
    given = Problem(lambda t, y, d: cfjax.LowRankSkew(d[:, None] * y), y0, d, lambda t: y0)
    y = np.asarray(given.end(RKMK8, t1, 16))
    z = np.linalg.qr(np.exp(t1 * d)[:, None] * y0)[0]
    # The error of the method, of fourth powers of rates up to 3 in steps of 1/8.
    np.testing.assert_allclose(y @ y.T, z @ z.T, rtol=0, atol=1e-8)
    np.testing.assert_allclose(y.T @ y, np.eye(p), rtol=0, atol=2e-15)


@pytest.mark.parametrize("coordinates", ["cayley", "projected"])
def test_rossby_haurwitz_waves(coordinates):
    """Vorticity on a sphere as a Hermitian matrix: the eigenvalues stay, and the pattern turns."""
    n, t1 = 8, 2.0
    args = zeitlin.inverse_laplacian(n)
    start, end = (zeitlin.rossby_haurwitz(t, n) for t in (0.0, t1))
    given = Problem(zeitlin.field, start, args, lambda t: end)
    y = np.asarray(given.end(cfjax.RKMK8(coordinates=coordinates), t1, 40))
    np.testing.assert_array_equal(y, y.conj().T)
    spectra = [np.linalg.eigvalsh(x) for x in (y, start)]
    # Some roundings of eigenvalues up to 10.
    np.testing.assert_allclose(*spectra, rtol=0, atol=4e-14)
    assert np.abs(start - end).max() > 0.5
    np.testing.assert_allclose(y, end, rtol=0, atol=1e-8)


def henon_heiles(xp: Any, x):
    """The velocity of an orbit, and its derivative."""
    q, p, one = x[:2], x[2:], np.eye(2)
    force = xp.stack([-q[0] - 2 * q[0] * q[1], -q[1] - q[0] ** 2 + q[1] ** 2])
    slopes = xp.stack([-1 - 2 * q[1], -2 * q[0], -2 * q[0], -1 + 2 * q[1]]).reshape(2, 2)
    matrix = xp.concatenate(
        [xp.concatenate([0 * one, one], 1), xp.concatenate([slopes, 0 * one], 1)]
    )
    return xp.concatenate([p, force]), matrix


def test_the_derivative_of_a_hamiltonian_flow_is_symplectic():
    orbit, t1 = np.array([0.1, 0.2, 0.3, -0.1]), 10.0

    def plain(t, x):
        velocity, matrix = henon_heiles(np, x[:4])
        return np.concatenate([velocity, (matrix @ x[4:].reshape(4, 4)).ravel()])

    def field(t, y, args):
        velocity, matrix = henon_heiles(jnp, y["orbit"])
        return {"orbit": velocity, "derivative": cfjax.LeftMatrix(matrix)}

    start = np.concatenate([orbit, np.eye(4).ravel()])
    expected = solve_ivp(plain, (0, t1), start, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    y0 = problems.arrays({"orbit": orbit, "derivative": np.eye(4)})
    form = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(2))
    ys: Any = cfjax.integrate(cfjax.LieTerm(field), RKMK8, 0.0, t1, y0, num_steps=20).ys
    m = np.asarray(ys["derivative"][-1])
    # Roundings of products of entries up to 30, in steps that are off by far more.
    np.testing.assert_allclose(m.T @ form @ m, form, rtol=0, atol=5e-13)
    off = problems.flat({"a": ys["orbit"][-1], "b": m}) - expected
    assert 1e-9 < np.abs(off).max() < 1e-4


# Error control, and output within steps


def test_control_keeps_to_its_tolerance():
    given = GROUPS["Sp(6), body frame"]
    y0, args = problems.arrays((given.y0, given.args))

    @jax.jit
    def end(tolerance):
        control = diffrax.PIDController(rtol=0.0, atol=tolerance)
        options: Any = {"stepsize_controller": control}
        return diffrax.diffeqsolve(given.term, RKMK5, 0.0, 2.0, 0.05, y0, args, **options).ys[-1]

    tolerances = (1e-5, 1e-7, 1e-9)
    off = [np.abs(np.asarray(end(x)) - given.exact(2.0)).max() / x for x in tolerances]
    # The estimate is of a step, and errors of steps add up.
    assert max(off) < 10
    assert min(off) > 1e-3


def fixed_of(problem, y):
    """What stays, by NumPy."""
    if problem == "Toda":
        return np.linalg.eigvalsh((y + y.T) / 2)
    return np.concatenate([(y.conj().T @ y).ravel(), [np.linalg.det(y) if len(y) == 3 else 1.0]])


@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
@pytest.mark.parametrize(
    "name, problem",
    [
        ("RKMK5", "SU(3), fixed frame"),
        ("RKMK8", "Toda"),
        ("RKMK5", "orthonormal columns, low rank"),
        pytest.param("RKMK8", "SU(3), body frame", marks=pytest.mark.slow),
    ],
)
def test_output_within_steps(name, problem):
    given, order = GIVEN[problem], ORDERS[name]
    y0, args = problems.arrays((given.y0, given.args))
    ts = np.linspace(0.05, 2.0, 16)
    exact = np.stack([given.exact(t) for t in ts])
    steps, off = ((10, 20), []) if order == 5 else ((4, 8), [])

    @jax.jit
    def saved(h):
        return diffrax.diffeqsolve(
            given.term, SOLVERS[name], 0.0, 2.0, h, y0, args, saveat=diffrax.SaveAt(ts=ts)
        ).ys

    for n in steps:
        ys = np.asarray(saved(2.0 / n))
        off.append(np.abs(ys - exact).max())
        for y in ys:
            np.testing.assert_allclose(
                fixed_of(problem, y), fixed_of(problem, given.y0), rtol=0, atol=1e-14
            )
    # The end of a step has the order of the method, and is saved too.
    assert order - 1.5 < np.log2(off[0] / off[1]) < order + 1.3


# Derivatives


def scaled(s, field):
    return jax.tree_util.tree_map(lambda x: s.astype(x.dtype) * x, field)


def all_kinds(t, y, args):
    return {name: GIVEN[name].field(t, y[name], args[name]) for name in y}


def mixed(*names):
    return Problem(
        all_kinds,
        {x: GIVEN[x].y0 for x in names},
        {x: GIVEN[x].args for x in names},
        lambda t: {x: GIVEN[x].exact(t) for x in names},
    )


@pytest.mark.parametrize(
    "given",
    [
        pytest.param(mixed("SU(3), fixed frame"), id="SU(3)"),
        pytest.param(mixed("SO(5), body frame", "orthonormal columns, low rank"), id="mixed"),
        pytest.param(mixed("Toda", "Riccati"), id="two-sided", marks=pytest.mark.slow),
    ],
)
def test_derivatives_are_those_of_difference_quotients(given):
    y0, args = problems.arrays((given.y0, given.args))
    weights = problems.random_like(y0, 1)

    def field(t, y, s):
        return scaled(s, given.field(t, y, args))

    def value(s):
        ys = cfjax.integrate(cfjax.LieTerm(field), SHORT, 0.0, 1.0, y0, s, num_steps=4).ys
        products = jax.tree_util.tree_map(lambda w, y: jnp.sum(w * jnp.real(y[-1])), weights, ys)
        return sum(jax.tree_util.tree_leaves(products))

    s = jnp.asarray(1.1)
    expected = problems.central_difference(jax.jit(value), s, 1.0, 1e-3)
    derivatives = (jax.grad(value), jax.jacfwd(value))
    found = [jax.jit(f, compiler_options=problems.QUICK)(s) for f in derivatives]
    # Rounding over the step of the quotient, and 1e-12 of its fourth power.
    np.testing.assert_allclose(found, [expected] * 2, rtol=0, atol=4e-11)


@pytest.mark.slow
def test_gradients_by_the_start():
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


# Batches, precision, products of manifolds


@pytest.mark.parametrize(
    "given",
    [
        pytest.param(mixed("SU(3), body frame", "sphere, n = 5"), id="SU(3) and a sphere"),
        pytest.param(mixed("SO(5), fixed frame", "Toda"), id="SO(5) and Toda"),
        pytest.param(
            mixed("Riccati", "bordered", "orthonormal columns, low rank"),
            id="others",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_vmap_and_leading_axes_are_single_solves(given):
    matrix_problems.check_batches(given, SHORT, scaled)


def test_a_matrix_for_all_points_stays_one():
    """An axis of 1 is broadcast, and so are the coordinates: each point moves by one matrix."""
    b, c = skew(5), skew(5)
    points = jnp.asarray(_RNG.normal(size=(3, 5)))
    term = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix((b + jnp.sin(t) * c)[None]))
    ends = cfjax.integrate(term, RKMK8, 0.0, 1.0, points, num_steps=4).ys[-1]
    alone = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix(b + jnp.sin(t) * c))
    matrix = cfjax.integrate(alone, RKMK8, 0.0, 1.0, jnp.eye(5), num_steps=4).ys[-1]
    np.testing.assert_allclose(ends, points @ matrix.T, rtol=0, atol=1e-14)


def test_single_precision():
    given = mixed("SU(3), body frame", "Sp(6), fixed frame", "Toda", "sphere, n = 5")
    low = lambda x: np.asarray(x, np.complex64 if np.iscomplexobj(x) else np.float32)  # noqa: E731
    y0, args = jax.tree_util.tree_map(low, (given.y0, given.args))
    end: Any = given._replace(y0=y0, args=args).end(RKMK5, 2.0, 20)
    dtypes = {x.dtype.name for x in jax.tree_util.tree_leaves(end)}
    assert dtypes == {"float32", "complex64"}
    # Some tens of roundings of numbers up to 3.
    problems.assert_close(end, given.exact(2.0), 3e-5)


@pytest.mark.parametrize(
    "given",
    [mixed("SU(3), fixed frame"), pytest.param(BOTH, marks=pytest.mark.slow)],
    ids=["SU(3)", "both"],
)
def test_stages_in_a_loop_are_those_one_by_one(given):
    """With a trace, and of two parts."""
    tableau = diffrax.Bosh3.tableau
    solvers = [cfjax.RKMK(tableau, unroll=x, **CAYLEY) for x in (False, True)]
    loop, single = (given.end(solver, 1.0, 3) for solver in solvers)
    # Which XLA may fuse otherwise.
    problems.assert_close(loop, single, 1e-14)


# Nearly half a turn


def fast(cls, angle):
    """Turns by an angle in unit time."""
    a = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    if cls is cfjax.LowRankSkew:
        start = np.eye(3)[:, :1]
        return Problem(
            lambda t, y, args: cls(angle * jnp.asarray(a) @ y),
            start,
            None,
            lambda t: expm(angle * t * a) @ start,
        )
    start = np.diag([1.0, 2.0, 3.0]) if cls is cfjax.Congruence else np.eye(3)

    def exact(t):
        turn = expm(angle * t * a)
        return turn @ start @ turn.T if cls is cfjax.Congruence else turn @ start

    return Problem(lambda t, y, args: cls(angle * jnp.asarray(a)), start, None, exact)


@pytest.mark.parametrize(
    "cls", [cfjax.LeftMatrix, cfjax.RightMatrix, cfjax.Congruence, cfjax.LowRankSkew]
)
def test_nearly_half_a_turn_fails_and_is_taken_again(cls):
    given, slow = fast(cls, 3.0), fast(cls, 1.0)
    assert np.abs(slow.end(RKMK5, 1.0, 1) - slow.exact(1.0)).max() < 0.02
    with pytest.raises(RuntimeError, match="without bound, or the steps"):
        given.end(RKMK5, 1.0, 1)

    @jax.jit
    def controlled(tolerance):
        control = diffrax.PIDController(rtol=0.0, atol=tolerance)
        y0 = jnp.asarray(given.y0)
        sol = diffrax.diffeqsolve(given.term, RKMK5, 0.0, 1.0, 1.0, y0, stepsize_controller=control)
        return sol.ys[-1], sol.stats["num_rejected_steps"]

    # With such a tolerance the estimate alone would not reject the step.
    assert controlled(1e3)[1] > 0
    assert np.abs(controlled(1e-6)[0] - given.exact(1.0)).max() < 1e-5


def test_a_turn_of_one_member_fails_for_all():
    a = np.array([[0.0, -1.0], [1.0, 0.0]]) * np.array([1.0, 3.0])[:, None, None]
    given = Problem(lambda t, y, a: cfjax.LeftMatrix(a), np.stack([np.eye(2)] * 2), a, expm)
    with pytest.raises(RuntimeError, match="without bound, or the steps"):
        given.end(RKMK5, 1.0, 1)


@pytest.mark.parametrize("units", [1.0, 1e3, 1e-4])
def test_units_are_no_turn(units):
    """An oscillator by half a radian in each step, with any unit of its velocity."""
    matrix = 0.5 * np.array([[0.0, units], [-1 / units, 0.0]])
    given = Problem(lambda t, y, a: cfjax.LeftMatrix(a), np.eye(2), matrix, lambda t: None)
    expected = expm(4 * matrix)
    # Of order 8 in steps of half a radian.
    np.testing.assert_allclose(given.end(RKMK8, 4.0, 4), expected, rtol=1e-9, atol=0)


@pytest.mark.slow
def test_a_rejected_step_has_no_derivative():
    given = fast(cfjax.LeftMatrix, 3.0)

    def end(s):
        control = diffrax.PIDController(rtol=0.0, atol=1e-8)
        term = cfjax.LieTerm(lambda t, y, s: given.term.prod(given.field(t, y, None), s))
        sol = diffrax.diffeqsolve(
            term, RKMK5, 0.0, 1.0, 1.0, jnp.asarray(given.y0), s, stepsize_controller=control
        )
        return sol.ys[-1, 0, 0]

    # y[0, 0] is cos(angle).
    found = jax.grad(end)(jnp.asarray(1.0))
    np.testing.assert_allclose(found, -3 * np.sin(3), rtol=0, atol=1e-5)
