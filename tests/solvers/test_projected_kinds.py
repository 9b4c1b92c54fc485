"""`Projected` on every kind of state, each with a field that depends on state and time."""

import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import problems
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp

import cfjax

RNG = np.random.default_rng(0)
Q = np.array([1.0, -3.0, 5.0, 1.0]) / 6
R = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
R *= np.linalg.det(R)


def pose(rotation, *vectors):
    n = len(rotation)
    matrix = np.eye(n + len(vectors))
    matrix[:n, :n] = rotation
    for k, vector in enumerate(vectors):
        matrix[:n, n + k] = vector
    return matrix


def twist(cls, **conventions):
    n = cls.dimension

    def field(x):
        parts = jnp.split(x, len(x) // n) if n == 3 else [x[0], x[1:3]]
        return cls(**dict(zip(cls.coordinates, parts, strict=False)), **conventions)

    return field, n * len(cls.coordinates) if n == 3 else 3


def inertial(x):
    return cfjax.InertialMotion(omega=x[:3], force=x[3:6], gravity=x[6:], layout="wxyz_v_p")


def rotation(x):
    return cfjax.Rotation(x)


def quaternion(x):
    return cfjax.QuaternionRotation(x, frame="body", layout="wxyz")


# The field of so many numbers, and the start.
RIGID, PLANAR = cfjax.RigidMotion, cfjax.PlanarMotion
KINDS: dict[str, tuple[Any, int, np.ndarray]] = {
    "array": (lambda x: x, 4, np.ones(4)),
    "vector": (rotation, 3, np.array([1.0, -2.0, 0.5])),
    "attitude": (rotation, 3, R),
    "two columns": (rotation, 3, RNG.normal(size=(3, 2))),
    "body of points": (rotation, 3, RNG.normal(size=(3, 5))),
    "lattice": (lambda x: cfjax.Rotation(x.reshape(4, 3)), 12, RNG.normal(size=(4, 3))),
    "quaternion": (quaternion, 3, Q),
    "sphere": (cfjax.SphereRotation, 5, np.array([0.1, -0.7, 0.1, 0.7, 0.0])),
    "spheres": (lambda x: cfjax.SphereRotation(x.reshape(2, 4)), 8, np.stack([Q, Q[::-1]])),
    "pose": (*twist(RIGID, frame="fixed", layout="xyz_xyzw"), np.r_[1.0, 2.0, 3.0, Q]),
    "pose matrix": (*twist(RIGID, frame="body"), pose(R, [1.0, 2.0, 3.0])),
    "point": (*twist(RIGID, frame="fixed"), np.array([1.0, 2.0, 3.0])),
    "planar pose": (
        *twist(PLANAR, frame="body", layout="unit_complex_xy"),
        np.array([0.6, 0.8, 1.0, 2.0]),
    ),
    "planar matrix": (
        *twist(PLANAR, frame="fixed"),
        pose(np.array([[0.6, -0.8], [0.8, 0.6]]), [1.0, 2.0]),
    ),
    "extended pose": (
        *twist(cfjax.ExtendedMotion, frame="body", layout="p_wxyz_v"),
        np.r_[1.0, 2.0, 3.0, Q, 0.1, 0.2, 0.3],
    ),
    "extended matrix": (
        *twist(cfjax.ExtendedMotion, frame="fixed"),
        pose(R, [0.1, 0.2, 0.3], [1.0, 2.0, 3.0]),
    ),
    "inertial": (inertial, 9, np.r_[Q, 0.1, 0.2, 0.3, 1.0, 2.0, 3.0]),
    "own": (lambda x: problems.Circle(x[0]), 1, np.array([0.6, 0.8])),
}
Y0 = {name: y0 for name, (_, _, y0) in KINDS.items()}
# How the numbers of a field depend on the state.
COUPLING = {name: 0.4 * RNG.normal(size=(n, y0.size)) for name, (_, n, y0) in KINDS.items()}


def one(name, t, y, coupling):
    # Far from the origin it depends little on the position.
    return KINDS[name][0](jnp.sin(coupling @ (y / jnp.sqrt(1 + y * y)).ravel() + 2 * t))


def field(t, y, coupling):
    return {name: one(name, t, y[name], coupling[name]) for name in KINDS}


TERM = cfjax.LieTerm(field)


@functools.cache
def velocity():
    @jax.jit
    def velocity(t, y):
        return cfjax.tangent(field(t, y, COUPLING), y)

    return lambda t, y: jax.tree.map(np.asarray, velocity(jnp.asarray(t), problems.arrays(y)))


# Nearest points in NumPy


def unit(x):
    return x / np.linalg.norm(x)


def numbers(at):
    def nearest(z, y0):
        z = z.copy()
        z[at] = unit(z[at])
        return z

    return nearest


def blocks(n):
    def nearest(z, y0):
        z = z.copy()
        z[:n, :n] = scipy.linalg.polar(z[:n, :n])[0]
        return z

    return nearest


def turned(z, y0):
    """The rotation of the columns, by the matrix that takes them there, which is linear."""
    a = z @ np.linalg.pinv(y0)
    return scipy.linalg.polar(a)[0] @ y0


NEAREST = {
    "array": lambda z, y0: z,
    "vector": lambda z, y0: np.linalg.norm(y0) * unit(z),
    "attitude": blocks(3),
    "body of points": turned,
    "lattice": lambda z, y0: np.stack(
        [np.linalg.norm(a) * unit(b) for a, b in zip(y0, z, strict=True)]
    ),
    "quaternion": numbers(slice(0, 4)),
    "sphere": numbers(slice(0, 5)),
    "spheres": lambda z, y0: np.stack([unit(x) for x in z]),
    "pose": numbers(slice(3, 7)),
    "pose matrix": blocks(3),
    "point": lambda z, y0: z,
    "planar pose": numbers(slice(0, 2)),
    "planar matrix": blocks(2),
    "extended pose": numbers(slice(3, 7)),
    "extended matrix": blocks(3),
    "inertial": numbers(slice(0, 4)),
    "own": numbers(slice(0, 2)),
}


def loop(tableau, t1, num_steps):
    """The end of equal steps, in NumPy."""
    y, h, rate = Y0, t1 / num_steps, velocity()
    add = lambda y, rates, row: {  # noqa: E731
        name: y[name] + h * sum((a * k[name] for a, k in zip(row, rates, strict=True)), 0.0)
        for name in y
    }
    for step in range(num_steps):
        rates = []
        for c, row in zip((0.0, *tableau.c), ((), *tableau.a_lower), strict=True):
            rates.append(rate((step + c) * h, add(y, rates, row)))
        z = add(y, rates, tableau.b_sol)
        y = {name: NEAREST[name](z[name], y[name]) if name in NEAREST else z[name] for name in y}
    return y


@eqx.filter_jit
def solve(solver, t1, num_steps, args):
    y0 = problems.arrays(Y0)
    return cfjax.integrate(TERM, solver, 0.0, t1, y0, args, num_steps=num_steps).ys


def end(solver, t1, num_steps):
    ys = solve(solver, t1, num_steps, problems.arrays(COUPLING))
    return {name: np.asarray(y[-1]) for name, y in ys.items()}


def test_steps_are_those_of_a_loop_in_numpy(subtests):
    method = diffrax.Bosh3()
    found, expected = end(cfjax.Projected(method), 0.6, 3), loop(method.tableau, 0.6, 3)
    for name in NEAREST:
        with subtests.test(kind=name):
            # Some tens of roundings of numbers up to 5.
            np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=5e-14)


@functools.cache
def exact(t1):
    shapes = {name: y.shape for name, y in Y0.items()}
    ends = np.cumsum([y.size for y in Y0.values()])[:-1]

    def split(flat):
        pieces = zip(np.split(flat, ends), shapes.items(), strict=True)
        return {name: x.reshape(shape) for x, (name, shape) in pieces}

    def flat(y):
        return np.concatenate([y[name].ravel() for name in shapes])

    rate = velocity()
    solution = solve_ivp(
        lambda t, x: flat(rate(t, split(x))), (0, t1), flat(Y0), "DOP853", rtol=1e-13, atol=1e-13
    )
    return split(solution.y[:, -1])


def gram(name, y):
    """What the manifold keeps."""
    match name:
        case "array" | "point":
            return np.zeros(1)
        case "attitude" | "two columns" | "body of points":
            return y.T @ y
        case "lattice" | "spheres":
            return np.sum(y * y, axis=1)
    if y.ndim == 2:
        n = 2 if "planar" in name else 3
        return y[:n, :n].T @ y[:n, :n]
    at = {"pose": slice(3, 7), "extended pose": slice(3, 7), "planar pose": slice(0, 2)}
    at |= {"inertial": slice(0, 4)}
    part = y[at.get(name, slice(None))]
    return part @ part


@pytest.mark.slow
@pytest.mark.parametrize(
    "method, steps",
    [
        (diffrax.Bosh3(), (20, 40, 80)),
        (diffrax.Tsit5(), (8, 16, 32)),
        (diffrax.Dopri8(), (3, 4, 6)),
    ],
    ids=["Bosh3", "Tsit5", "Dopri8"],
)
def test_order_and_manifold(method, steps, subtests):
    solver = cfjax.Projected(method)
    ends = [end(solver, 1.0, n) for n in steps]
    order = solver.order(None)
    for name, answer in exact(1.0).items():
        with subtests.test(kind=name):
            errors = np.array([np.linalg.norm(y[name] - answer) for y in ends])
            # More than the error of the answer.
            assert errors[-1] > 1e-12
            # Terms of the next orders show, most of Tsit5, whose own are small.
            assert order - 0.8 < problems.slope(steps, errors) < order + 1.9, errors
            for y in ends:
                off = np.abs(gram(name, y[name]) - gram(name, Y0[name])).max()
                # Some roundings of products up to 10.
                assert off < 2e-14


@pytest.mark.slow
@pytest.mark.parametrize("dtype, bound", [(np.float64, 1e-13), (np.float32, 1e-5)])
def test_many_steps_stay_on_the_manifold(dtype, bound, subtests):
    """100 000 of a tenth of a radian. What is kept is relative to what it was."""
    args = jax.tree.map(lambda x: jnp.asarray(x, dtype), (Y0, COUPLING))

    @jax.jit
    def solve(y0, coupling):
        # Positions turn in plain space, where Heun's method would make them grow.
        solver, options = cfjax.Projected(diffrax.Bosh3()), {"num_steps": 100_000}
        return cfjax.integrate(TERM, solver, 0.0, 1e4, y0, coupling, **options).ys

    ends = solve(*args)
    for name in NEAREST:
        with subtests.test(kind=name):
            found, start = (np.asarray(y, float) for y in (ends[name][-1], args[0][name]))
            start = gram(name, start)
            atol = bound * max(1, np.abs(start).max())
            np.testing.assert_allclose(gram(name, found), start, rtol=0, atol=atol)


def test_derivatives():
    """Of a step and its estimate, in both modes, are those of difference quotients."""
    # One of each way to the manifold that no matrix takes.
    names = ["vector", "body of points", "own"]
    solver = cfjax.Projected(diffrax.Heun())
    start = problems.arrays(Y0)

    def only(tree):
        return {name: tree[name] for name in names}

    def some(t, y, coupling):
        return {name: one(name, t, y[name], coupling[name]) for name in names}

    term = cfjax.LieTerm(some)

    def step(length, coupling):
        """A vector may have any length, so its start may depend on something."""
        moved = only(start) | {"vector": length * start["vector"]}
        times = jnp.asarray(0.1), jnp.asarray(0.7)
        return problems.first_step(solver, term, *times, moved, coupling)[:2]

    x = jnp.asarray(1.2), problems.arrays(only(COUPLING))
    direction = problems.random_like(x, 1)
    weights = problems.random_like(jax.eval_shape(step, *x), 2)
    pushed = jax.jit(lambda x, d: jax.jvp(lambda x: step(*x), (x,), (d,))[1])(x, direction)
    pulled = jax.jit(jax.grad(lambda x: problems.inner(weights, step(*x))))(x)
    found = problems.inner(pulled, direction)
    np.testing.assert_allclose(found, problems.inner(weights, pushed), rtol=1e-12)
    quotient = problems.central_difference(jax.jit(lambda x: step(*x)), x, direction, 1e-4)
    # The square of the step, times third derivatives up to 100.
    problems.assert_close(pushed, quotient, 1e-6)


def test_in_a_linear_space_it_is_the_method_itself():
    """Also with controlled steps, of which there are as many."""

    def velocity(t, y, args):
        return {"a": jnp.sin(t + y["b"]) * jnp.ones(3), "b": -y["a"].sum() * y["b"]}

    y0 = problems.arrays({"a": np.arange(3.0), "b": np.array(1.0)})
    plain, projected = (
        diffrax.diffeqsolve(
            diffrax.ODETerm(velocity),
            solver,
            *(0.0, 3.0, 0.1),
            y0,
            stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
        )
        for solver in (diffrax.Tsit5(), cfjax.Projected(diffrax.Tsit5()))
    )
    for name in ("num_steps", "num_accepted_steps"):
        assert plain.stats[name] == projected.stats[name]
    problems.assert_close(plain.ys, projected.ys, 1e-13)


@pytest.mark.slow
def test_output_events_and_adjoints_of_controlled_steps():
    """Between steps, at an event, and a gradient through both is that in forward mode."""
    names = ["vector", "pose", "pose matrix", "own"]

    def some(t, y, coupling):
        return {name: one(name, t, y[name], coupling[name]) for name in names}

    start = problems.arrays({name: Y0[name] for name in names})
    coupling = problems.arrays({name: COUPLING[name] for name in names})

    def solve(coupling, adjoint):
        return diffrax.diffeqsolve(
            cfjax.LieTerm(some),
            cfjax.Projected(diffrax.Tsit5()),
            *(0.0, 2.0, 0.1),
            start,
            coupling,
            saveat=diffrax.SaveAt(ts=jnp.asarray([0.3, 0.7, 1.1]), t1=True),
            stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
            event=diffrax.Event(lambda t, y, args, **kwargs: t - 1.3, optx.Newton(1e-12, 1e-12)),
            adjoint=adjoint,
            max_steps=64,
        )

    solution = jax.jit(lambda c: solve(c, diffrax.RecursiveCheckpointAdjoint()))(coupling)
    np.testing.assert_allclose(solution.ts[-1], 1.3, rtol=0, atol=1e-11)
    for k, t in enumerate([0.3, 0.7, 1.1, 1.3]):
        for name in names:
            found = np.asarray(solution.ys[name][k])
            # Output within a step has order 4, a tenth of a radian from its ends.
            np.testing.assert_allclose(found, exact(t)[name], rtol=0, atol=1e-6)
            off = np.abs(gram(name, found) - gram(name, Y0[name])).max()
            assert off < 1e-14

    def loss(coupling, adjoint):
        ys = solve(coupling, adjoint).ys
        return sum(jnp.sum(jnp.sin(ys[name])) for name in names)

    direction = problems.random_like(coupling, 3)
    pulled = jax.jit(jax.grad(lambda c: loss(c, diffrax.RecursiveCheckpointAdjoint())))(coupling)
    forward = lambda c: loss(c, diffrax.ForwardMode())  # noqa: E731
    pushed = jax.jit(lambda c, d: jax.jvp(forward, (c,), (d,))[1])(coupling, direction)
    # Sums of some hundred steps of rounding.
    np.testing.assert_allclose(problems.inner(pulled, direction), pushed, rtol=1e-10)
