"""One contract for all fields: each against its generator, a dense matrix written down in NumPy.

Frozen, every field here is affine: `x' = A x + b` for the entries of its point. The exponential of
`[[A, b], [0, 0]]` in 64 bits of mantissa says what flow and derivatives are to be.
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import mpmath
import numpy as np
import problems
import pytest

import cfjax

RNG = np.random.default_rng(0)
LONG, LONG_COMPLEX = np.longdouble, np.clongdouble
# From nothing to several turns. General matrices grow like exp of that, so they end at 3.
SKEW_SIZES = (0.0, 1e-160, 1e-12, 1e-5, 0.1, 1.0, np.pi, 30.0)
SIZES = (0.0, 1e-160, 1e-12, 1e-5, 0.1, 1.0, 3.0)


@pytest.fixture(autouse=True)
def draws_of_its_own():
    """What a test draws does not hang on the tests before it."""
    RNG.bit_generator.state = np.random.default_rng(1).bit_generator.state


class Case(NamedTuple):
    make: Callable[..., Any]
    # One set of coordinates by name, of norm one: their sum is a direction.
    draw: Callable[[], dict[str, np.ndarray]]
    point: np.ndarray
    # From coordinates and point in long doubles, A and b.
    generator: Callable[..., tuple[np.ndarray, Any]]
    sizes: tuple[float, ...] = SKEW_SIZES
    # Whether the point may be any, so that there is a derivative in it.
    is_free: bool = True
    # Whether the flow itself is one; where a field is frozen at the point, a second flow starts
    # from another.
    is_group: bool = True
    has_bracket: bool = True


def hat(w):
    zero = 0 * w[0]
    return np.array([[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]])


def columns(a, k):
    """What acts on each column of an (n, k) array, row by row."""
    return np.kron(a, np.eye(k, dtype=a.dtype))


def rows(a, k):
    return np.kron(np.eye(k, dtype=a.dtype), a.T)


def normal(*shape, is_complex=False):
    x = RNG.normal(size=shape)
    return x + 1j * RNG.normal(size=shape) if is_complex else x


def quaternions(a, w):
    """What multiplies a quaternion wxyz: a on its vector, and what mixes this with the scalar."""
    return np.block([[np.zeros((1, 1), w.dtype), -w[None]], [w[:, None], a]])


def screw(a, v):
    m = np.zeros((len(v) + 1, len(v) + 1), v.dtype)
    m[:-1, :-1], m[:-1, -1] = a, v
    return m


def extended(a, f, v, time=0):
    """A screw with two vectors, the second of which may move with the first."""
    m = np.zeros((5, 5), v.dtype)
    m[:3, :3], m[:3, 3], m[:3, 4], m[3, 4] = a, f, v, time
    return m


def block_diagonal(a, b):
    return np.block([[a, np.zeros((len(a), len(b)))], [np.zeros((len(b), len(a))), b]])


def unit(**arrays):
    norm = np.sqrt(sum(np.sum(np.abs(x) ** 2) for x in arrays.values()))
    return {name: x / norm for name, x in arrays.items()}


def skew(a):
    return a - a.conj().T


def frame(n, p):
    return np.linalg.qr(normal(n, p))[0]


def border(gamma):
    e = np.eye(*gamma.shape, dtype=gamma.dtype)
    return columns(gamma @ e.T - e @ gamma.T, gamma.shape[1])


TURN = np.array([[0, -1], [1, 0]])
# Fixed operators of which only the coefficients vary: a matrix, and a function of a vector.
OPERATORS = skew(np.triu(normal(4, 4))) / 4, skew(np.eye(4, k=1)) / 2


def from_neighbour(x):
    """Half of the next entry less half of the one before."""
    zero = jnp.zeros_like(x[:1])
    return (jnp.concatenate([x[1:], zero]) - jnp.concatenate([zero, x[:-1]])) / 2


@functools.cache
def operators(dtype):
    vector = jax.ShapeDtypeStruct((4,), dtype)
    return [OPERATORS[0].astype(dtype), (lx.FunctionLinearOperator(from_neighbour, vector), 1.0)]


# It has norm one, as have the directions of the other cases.
SPECTRUM = -np.array([0.0, 0.4, 0.4, 1.0])
CASES = {
    "Rotation": Case(
        cfjax.Rotation,
        lambda: unit(omega=normal(3)),
        normal(3),
        lambda x, omega: (hat(omega), 0),
    ),
    "Rotation of a matrix": Case(
        cfjax.Rotation,
        lambda: unit(omega=normal(3)),
        normal(3, 2),
        lambda x, omega: (columns(hat(omega), 2), 0),
    ),
    "QuaternionRotation, body": Case(
        partial(cfjax.QuaternionRotation, frame="body", layout="wxyz"),
        lambda: unit(omega=normal(3)),
        unit(q=normal(4))["q"],
        lambda x, omega: (quaternions(-hat(omega), omega) / 2, 0),
    ),
    "QuaternionRotation, fixed": Case(
        partial(cfjax.QuaternionRotation, frame="fixed", layout="xyzw"),
        lambda: unit(omega=normal(3)),
        unit(q=normal(4))["q"],
        lambda x, omega: (np.roll(quaternions(hat(omega), omega), -1, (0, 1)) / 2, 0),
    ),
    "RigidMotion of matrices, body": Case(
        partial(cfjax.RigidMotion, frame="body"),
        lambda: unit(omega=normal(3), v=normal(3)),
        normal(4, 4),
        lambda x, omega, v: (rows(screw(hat(omega), v), 4), 0),
    ),
    "RigidMotion of matrices, fixed": Case(
        partial(cfjax.RigidMotion, frame="fixed"),
        lambda: unit(omega=normal(3), v=normal(3)),
        normal(4, 4),
        lambda x, omega, v: (columns(screw(hat(omega), v), 4), 0),
    ),
    "RigidMotion of a quaternion and a position": Case(
        partial(cfjax.RigidMotion, frame="fixed", layout="xyz_xyzw"),
        lambda: unit(omega=normal(3), v=normal(3)),
        np.concatenate([normal(3), unit(q=normal(4))["q"]]),
        lambda x, omega, v: (
            block_diagonal(hat(omega), np.roll(quaternions(hat(omega), omega), -1, (0, 1)) / 2),
            np.concatenate([v, 0 * x[3:]]),
        ),
    ),
    "RigidMotion of a point": Case(
        partial(cfjax.RigidMotion, frame="fixed"),
        lambda: unit(omega=normal(3), v=normal(3)),
        normal(3),
        lambda x, omega, v: (hat(omega), v),
    ),
    "PlanarMotion of matrices, body": Case(
        partial(cfjax.PlanarMotion, frame="body"),
        lambda: unit(omega=normal(), v=normal(2)),
        normal(3, 3),
        lambda x, omega, v: (rows(screw(omega * TURN, v), 3), 0),
    ),
    "PlanarMotion of a complex number and a position": Case(
        partial(cfjax.PlanarMotion, frame="fixed", layout="xy_unit_complex"),
        lambda: unit(omega=normal(), v=normal(2)),
        np.concatenate([normal(2), unit(z=normal(2))["z"]]),
        lambda x, omega, v: (
            block_diagonal(omega * TURN, omega * TURN),
            np.concatenate([v, 0 * x[2:]]),
        ),
    ),
    "ExtendedMotion of matrices, body": Case(
        partial(cfjax.ExtendedMotion, frame="body"),
        lambda: unit(omega=normal(3), a=normal(3), v=normal(3)),
        normal(5, 5),
        lambda x, omega, a, v: (rows(extended(hat(omega), a, v), 5), 0),
    ),
    "ExtendedMotion of matrices, fixed": Case(
        partial(cfjax.ExtendedMotion, frame="fixed"),
        lambda: unit(omega=normal(3), a=normal(3), v=normal(3)),
        normal(5, 5),
        lambda x, omega, a, v: (columns(extended(hat(omega), a, v), 5), 0),
    ),
    "ExtendedMotion of a quaternion and two vectors": Case(
        partial(cfjax.ExtendedMotion, frame="fixed", layout="p_wxyz_v"),
        lambda: unit(omega=normal(3), a=normal(3), v=normal(3)),
        np.concatenate([normal(3), unit(q=normal(4))["q"], normal(3)]),
        lambda x, omega, a, v: (
            block_diagonal(
                block_diagonal(hat(omega), quaternions(hat(omega), omega) / 2), hat(omega)
            ),
            np.concatenate([v, 0 * x[3:7], a]),
        ),
    ),
    "InertialMotion of matrices": Case(
        cfjax.InertialMotion,
        lambda: unit(
            **{name: normal(3) for name in ("omega", "force", "gravity")},
            time=normal(),
            **{name: normal(3) for name in ("body_shift", "fixed_shift")},
        ),
        normal(5, 5),
        # The last two rows are at rest.
        lambda x, omega, force, gravity, time, body_shift, fixed_shift: (
            block_diagonal(
                rows(extended(hat(omega), force, body_shift, time), 3), np.zeros((10, 10))
            ),
            np.concatenate(
                [
                    np.column_stack([np.zeros((3, 3)), gravity, fixed_shift]).ravel(),
                    np.zeros(10),
                ]
            ),
        ),
    ),
    "LeftMatrix": Case(
        cfjax.LeftMatrix,
        lambda: unit(a=normal(4, 4)),
        normal(4, 3),
        lambda x, a: (columns(a, 3), 0),
        SIZES,
    ),
    "LeftMatrix, skew": Case(
        cfjax.LeftMatrix,
        lambda: unit(a=skew(normal(5, 5))),
        normal(5, 5),
        lambda x, a: (columns(a, 5), 0),
    ),
    "LeftMatrix, skew-Hermitian": Case(
        cfjax.LeftMatrix,
        lambda: unit(a=skew(normal(3, 3, is_complex=True))),
        normal(3, 3, is_complex=True),
        lambda x, a: (columns(a, 3), 0),
    ),
    "LeftMatrix, eigenvalues that meet": Case(
        cfjax.LeftMatrix,
        # Twice the same, and once with a vector that is missing.
        lambda: {"a": np.diag([1j, 1j, -2j]) / 6**0.5},
        normal(3, 3, is_complex=True),
        lambda x, a: (columns(a, 3), 0),
    ),
    "LeftMatrix of a vector": Case(
        cfjax.LeftMatrix,
        lambda: unit(a=normal(9, 9)),
        normal(9),
        lambda x, a: (a, 0),
        SIZES,
    ),
    "RightMatrix": Case(
        cfjax.RightMatrix,
        lambda: unit(a=normal(3, 3)),
        normal(2, 3),
        lambda x, a: (rows(a, 2), 0),
        SIZES,
    ),
    "RightMatrix of a row": Case(
        cfjax.RightMatrix,
        lambda: unit(a=skew(normal(8, 8, is_complex=True))),
        normal(8, is_complex=True),
        lambda x, a: (a.T, 0),
    ),
    "Conjugation": Case(
        cfjax.Conjugation,
        lambda: unit(a=normal(3, 3)),
        normal(3, 3),
        lambda x, a: (columns(a, 3) - rows(a, 3), 0),
        SIZES,
    ),
    "Conjugation, skew-Hermitian": Case(
        cfjax.Conjugation,
        lambda: unit(a=skew(normal(2, 2, is_complex=True))),
        normal(2, 2, is_complex=True),
        lambda x, a: (columns(a, 2) - rows(a, 2), 0),
    ),
    "Congruence": Case(
        cfjax.Congruence,
        lambda: unit(a=normal(3, 3)),
        normal(3, 3),
        lambda x, a: (columns(a, 3) + rows(a.conj().T, 3), 0),
        SIZES,
    ),
    "Congruence with a source": Case(
        cfjax.Congruence,
        lambda: unit(a=normal(3, 3, is_complex=True), q=normal(3, 3, is_complex=True)),
        normal(3, 3, is_complex=True),
        lambda x, a, q: (columns(a, 3) + rows(a.conj().T, 3), q.ravel()),
        SIZES,
    ),
    "LinearAffine": Case(
        cfjax.LinearAffine,
        lambda: unit(a=normal(4, 4), b=normal(4)),
        normal(4),
        lambda x, a, b: (a, b),
        SIZES,
    ),
    "LowRankSkew": Case(
        cfjax.LowRankSkew,
        lambda: unit(g=normal(5, 2)),
        frame(5, 2),
        lambda x, g: (columns(g @ x.T - x @ g.T, 2), 0),
        is_free=False,
        is_group=False,
        has_bracket=False,
    ),
    "BorderedSkew": Case(
        cfjax.BorderedSkew,
        lambda: unit(gamma=normal(5, 2)),
        frame(5, 2),
        lambda x, gamma: (border(gamma), 0),
        is_free=False,
    ),
    "SphereRotation": Case(
        cfjax.SphereRotation,
        lambda: unit(g=normal(5)),
        unit(y=normal(5))["y"],
        lambda x, g: (np.outer(g, x) - np.outer(x, g), 0),
        is_free=False,
        is_group=False,
        has_bracket=False,
    ),
    "SphereRotation in space": Case(
        cfjax.SphereRotation,
        lambda: unit(g=normal(3)),
        unit(y=normal(3))["y"],
        lambda x, g: (np.outer(g, x) - np.outer(x, g), 0),
        is_free=False,
        is_group=False,
        has_bracket=False,
    ),
    "Affine": Case(
        lambda alpha, b: cfjax.Affine(b, SPECTRUM.astype(b.dtype), alpha=alpha),
        lambda: unit(alpha=np.abs(normal()), b=normal(4)),
        normal(4),
        lambda x, alpha, b: (alpha * np.diag(SPECTRUM).astype(LONG), b),
        SIZES,
    ),
    "OperatorSum": Case(
        lambda coefficients: cfjax.OperatorSum(coefficients, operators(coefficients.dtype)),
        lambda: unit(coefficients=normal(2)),
        normal(4),
        lambda x, coefficients: (
            coefficients[0] * OPERATORS[0] + coefficients[1] * OPERATORS[1],
            0,
        ),
        has_bracket=False,
    ),
    "OperatorSum of columns, skew": Case(
        lambda coefficients: cfjax.OperatorSum(
            coefficients, operators(coefficients.dtype), is_skew=True
        ),
        lambda: unit(coefficients=normal(2)),
        normal(4, 2),
        lambda x, coefficients: (
            columns(coefficients[0] * OPERATORS[0] + coefficients[1] * OPERATORS[1], 2),
            0,
        ),
        has_bracket=False,
    ),
    "Scaling": Case(
        cfjax.Scaling,
        lambda: unit(rate=normal(4)),
        normal(4),
        lambda x, rate: (np.diag(rate), 0),
        SIZES,
    ),
    "Scaling, phases of rows": Case(
        cfjax.Scaling,
        lambda: unit(rate=1j * normal(3, 1)),
        normal(3, 2, is_complex=True),
        lambda x, rate: (columns(np.diag(rate[:, 0]), 2), 0),
    ),
}
# One of each kind; the others compile for minutes.
QUICK = {
    "Rotation",
    "QuaternionRotation, body",
    "RigidMotion of a quaternion and a position",
    "LeftMatrix, eigenvalues that meet",
    "Conjugation, skew-Hermitian",
    "LinearAffine",
}
SOME_SLOW = [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in CASES
]
WITH_AXES = [name for name in CASES if name.partition(" ")[0] not in ("Affine", "OperatorSum")]


def exact(case, coordinates, point):
    """The flow, how far it is from the point, and the norm of its linear part; in long doubles."""
    flat = np.ravel(point)
    a, b = case.generator(point, **coordinates)
    n = len(flat)
    m = np.zeros((n + 1, n + 1), np.result_type(a, flat))
    m[:n, :n], m[:n, n] = a, b
    squarings = max(0, int(np.ceil(np.log2(max(float(np.abs(m).sum(axis=0).max()), 1e-9)))) + 1)
    small = m / LONG(2) ** squarings
    # The exponential less one. What is left out is below the last bit, 1/27! / 2^27 of it.
    total = term = small
    for k in range(2, 27):
        term = term @ small / k
        total = total + term
    for _ in range(squarings):
        total = 2 * total + total @ total
    moved = (total[:n, :n] @ flat + total[:n, n]).reshape(point.shape)
    return point + moved, moved, 1 + float(np.abs(total[:n]).sum(axis=1).max())


def long(x):
    return np.asarray(x, LONG_COMPLEX if np.iscomplexobj(x) else LONG)


def along(case, coordinates, point, direction, h):
    """The flow at h times the direction from the coordinates and the point."""
    there = [
        jtu.tree_map(lambda x, d: long(x) + LONG(h) * long(d), x, d)
        for x, d in zip((coordinates, point), direction, strict=True)
    ]
    return exact(case, *there)[0]


def derivatives(case, coordinates, point, direction):
    """The first and second one, by differences of order four.

    With h = 2e-3 and sixth derivatives of about one they leave h^4 = 2e-11 over 30 and 90, and of
    rounding 64 bits over h^2.
    """
    h = 2e-3
    f = {k: along(case, coordinates, point, direction, k * h) for k in (-2, -1, 0, 1, 2)}
    first = (f[-2] - 8 * f[-1] + 8 * f[1] - f[2]) / (12 * LONG(h))
    second = (-f[-2] + 16 * f[-1] - 30 * f[0] + 16 * f[1] - f[2]) / (12 * LONG(h) ** 2)
    return first, second


def scaled(case, dtype):
    """Coordinates of all sizes, stacked, with a direction of norm one at each."""
    base, rate = case.draw(), case.draw()
    n = len(case.sizes)
    sizes = np.asarray(case.sizes)

    def cast(x):
        return np.asarray(x, np.result_type(dtype, np.complex64) if np.iscomplexobj(x) else dtype)

    coordinates = {k: cast(np.multiply.outer(sizes, x)) for k, x in base.items()}
    rates = {k: cast(np.stack([x] * n)) for k, x in rate.items()}
    points = cast(np.stack([case.point] * n))
    moves = points[..., ::-1] if case.is_free else 0 * points
    return coordinates, points, (rates, moves)


def element(tree, k):
    return jtu.tree_map(lambda x: x[k], tree)


@pytest.mark.representatives(3)
@pytest.mark.parametrize("name", SOME_SLOW)
def test_flow_and_derivatives(name):
    case = CASES[name]
    coordinates, points, direction = scaled(case, np.float64)

    def flow(coordinates, point):
        return case.make(**coordinates).flow(point)

    def first(at, direction):
        return jax.jvp(flow, at, direction)

    def second(at, direction):
        return jax.jvp(lambda *at: first(at, direction)[1], at, direction)[1]

    @jax.jit
    @jax.vmap
    def everything(at, direction, cotangent):
        end, rate = first(at, direction)
        pulled = jax.vjp(flow, *at)[1](cotangent)
        # JAX pulls back without conjugation.
        pairs = zip(jtu.tree_leaves(pulled), jtu.tree_leaves(direction), strict=True)
        return end, rate, second(at, direction), sum(jnp.sum(a * b) for a, b in pairs)

    cotangents = points.reshape(len(points), -1)[:, ::-1].reshape(points.shape)
    got = everything((coordinates, points), direction, cotangents)
    for k, size in enumerate(case.sizes):
        at, rate = element((coordinates, points), k), element(direction, k)
        want, _, norm = exact(case, *jtu.tree_map(long, at))
        # Some units of rounding, of each of the angles or of what the flow can enlarge.
        unit = 2.0**-52 * (1 + size) * norm * np.abs(points[k]).max()
        where = f"{name} at {size}"
        np.testing.assert_allclose(got[0][k], want.astype(got[0].dtype), 0, 8 * unit, err_msg=where)
        first_, second_ = derivatives(case, *at, rate)
        # The errors of a derivative by differences, and of some units of rounding.
        atol = 2e-11 * norm + 64 * unit
        np.testing.assert_allclose(got[1][k], first_.astype(got[1].dtype), 0, atol, err_msg=where)
        np.testing.assert_allclose(
            got[2][k], second_.astype(got[2].dtype), 0, 4 * atol, err_msg=where
        )
        paired = np.sum(np.asarray(got[1][k]) * cotangents[k])
        # Only the real parts agree for a field that conjugates its coordinates.
        np.testing.assert_allclose(got[3][k].real, paired.real, 0, 200 * unit, err_msg=where)


@pytest.mark.representatives(8)
@pytest.mark.parametrize("name", CASES)
def test_flow_in_single_precision(name):
    case = CASES[name]
    coordinates, points, _ = scaled(case, np.float32)
    flows = jax.jit(jax.vmap(lambda c, x: case.make(**c).flow(x)))(coordinates, points)
    assert flows.dtype == points.dtype
    for k, size in enumerate(case.sizes):
        want, _, norm = exact(case, *jtu.tree_map(long, element((coordinates, points), k)))
        atol = 8 * 2.0**-23 * (1 + size) * norm * np.abs(points[k]).max()
        np.testing.assert_allclose(flows[k], want.astype(flows.dtype), 0, atol, err_msg=str(size))


@pytest.mark.representatives(8)
@pytest.mark.parametrize("name", WITH_AXES)
def test_leading_axes_and_increment(name):
    case = CASES[name]
    coordinates, points, _ = scaled(case, np.float64)
    two = jtu.tree_map(lambda x: x.reshape(-1, 1, *x.shape[1:]), (coordinates, points))

    @jax.jit
    def flows(coordinates, points, two):
        alone = jax.vmap(lambda c, x: case.make(**c).flow(x))(coordinates, points)
        field = case.make(**two[0])
        return alone, field.flow(two[1])[:, 0], field.tangent(two[1])[:, 0], field.increment(two[1])

    alone, together, tangents, increments = flows(coordinates, points, two)
    for k, size in enumerate(case.sizes):
        at = jtu.tree_map(long, element((coordinates, points), k))
        want, moved, norm = exact(case, *at)
        scale = norm * np.abs(points[k]).max()
        unit = 2.0**-52 * (1 + size) * scale
        np.testing.assert_allclose(together[k], alone[k], 0, 8 * unit)
        a, b = case.generator(at[1], **at[0])
        velocity = (a @ at[1].ravel() + b).reshape(want.shape).astype(tangents.dtype)
        np.testing.assert_allclose(tangents[k], velocity, 0, 16 * 2.0**-52 * size * scale)
        if increments is not None:
            # It rounds as little as it is.
            moved = moved.astype(tangents.dtype)
            np.testing.assert_allclose(increments[k, 0], moved, 0, 16 * 2.0**-52 * size * scale)


@pytest.mark.representatives(4)
@pytest.mark.parametrize("name", CASES)
def test_sums_brackets_and_the_group(name):
    case = CASES[name]
    sets = [case.draw() for _ in range(2)]
    a, b = (case.make(**{k: jnp.asarray(x) for k, x in c.items()}) for c in sets)
    point = jnp.asarray(case.point)
    (ma, va), (mb, vb) = (
        case.generator(long(case.point), **{k: long(x) for k, x in c.items()}) for c in sets
    )
    x = long(case.point).ravel()
    atol = 60 * 2.0**-52 * np.abs(case.point).max()

    def same(found, expected):
        expected = expected.reshape(case.point.shape).astype(case.point.dtype)
        np.testing.assert_allclose(found, expected, 0, atol)

    total = cfjax.combine((0.3, -2.0), (a, b))
    same(total.tangent(point), 0.3 * (ma @ x + va) - 2 * (mb @ x + vb))
    if case.has_bracket:
        commutator = ma @ (mb @ x + vb) - mb @ (ma @ x + va)
        same(cfjax.bracket(a, b).tangent(point), commutator)
    if case.is_group:
        parts = [cfjax.combine((weight,), (a,)) for weight in (0.3, 0.7)]
        there = parts[1].flow(parts[0].flow(point))
        np.testing.assert_allclose(there, a.flow(point), 0, atol)
        np.testing.assert_allclose(cfjax.combine((-1.0,), (a,)).flow(a.flow(point)), point, 0, atol)


# Whether `dexpinv` is a closed form: then up to nearly a full turn, where it has a pole.
WITH_DEXPINV = {
    "Rotation": True,
    "QuaternionRotation, body": True,
    "QuaternionRotation, fixed": True,
    "RigidMotion of matrices, body": True,
    "RigidMotion of a point": True,
    "PlanarMotion of matrices, body": True,
    "PlanarMotion of a complex number and a position": True,
    "ExtendedMotion of matrices, body": True,
    "ExtendedMotion of a quaternion and two vectors": True,
    "InertialMotion of matrices": False,
    "LeftMatrix": False,
    "RightMatrix": False,
    "LinearAffine": False,
    "Scaling": True,
}


SLOW_SERIES = ("InertialMotion of matrices", "LeftMatrix", "LinearAffine")


def structure_constants(case):
    """`c[k, i, j]`: the bracket of the coordinates i and j, from the generators' commutators."""
    names = case.draw()
    shapes = {k: np.shape(x) for k, x in names.items()}
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])

    def generator(flat):
        parts = np.split(flat, ends[:-1])
        coordinates = {k: x.reshape(shapes[k]) for k, x in zip(shapes, parts, strict=True)}
        a, b = case.generator(case.point, **coordinates)
        n = case.point.size
        m = np.zeros((n + 1, n + 1))
        m[:n, :n], m[:n, n] = a, b
        return m

    basis = [generator(e) for e in np.eye(ends[-1])]
    columns = np.stack([m.ravel() for m in basis], axis=1)
    brackets = np.array([[(a @ b - b @ a).ravel() for b in basis] for a in basis])
    constants = np.linalg.lstsq(columns, brackets.reshape(-1, columns.shape[0]).T)[0]
    constants = constants.reshape(-1, ends[-1], ends[-1])
    np.testing.assert_allclose(constants, np.rint(constants), atol=1e-12)
    return np.rint(constants)


def exact_dexpinv(constants, u, v):
    """`phi_1(ad_u)^-1 v`, in the digits of mpmath, with phi_1 by its series."""
    d = len(u)
    ad = mpmath.matrix(d, d)
    for k, i, j in zip(*np.nonzero(constants), strict=True):
        ad[int(k), int(j)] += mpmath.mpf(constants[k, i, j]) * u[int(i)]
    total = term = mpmath.eye(d)
    for k in range(2, 90):
        term = term * ad / k
        total = total + term
    return mpmath.lu_solve(total, mpmath.matrix(v))


@pytest.mark.representatives(6)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW_SERIES)) for name in WITH_DEXPINV],
)
def test_the_inverse_derivative_of_the_exponential(name, dtype):
    """And its first and second derivative, by differences of 50 digits."""
    case, is_closed = CASES[name], WITH_DEXPINV[name]
    # The series to degree 12 leaves (2 * 0.1 / 2 pi)^14 of these.
    sizes = (0.0, 1e-30, 1e-12, 1e-3, 1.0, 3.0, 6.0) if is_closed else (0.0, 1e-12, 1e-3, 0.1)
    base, *others = (case.draw() for _ in range(4))
    sets = [
        {k: np.asarray(np.multiply.outer(sizes, x), dtype) for k, x in base.items()},
        *({k: np.stack([np.asarray(x, dtype)] * len(sizes)) for k, x in o.items()} for o in others),
    ]

    def image(u, v):
        return coordinates_of(case.make(**u).dexpinv(case.make(**v), 12))

    def coordinates_of(field):
        return {k: getattr(field, k) for k in base}

    def first(u, v, du, dv):
        return jax.jvp(image, (u, v), (du, dv))

    def second(u, v, du, dv):
        return jax.jvp(lambda u, v: first(u, v, du, dv)[1], (u, v), (du, dv))[1]

    @jax.jit
    def everything(u, v, du, dv):
        arrays = u, v, du, dv
        two = jtu.tree_map(lambda x: x[:, None], (u, v))
        together = jtu.tree_map(lambda x: x[:, 0], image(*two))
        return *jax.vmap(first)(*arrays), jax.vmap(second)(*arrays), together

    found = everything(*sets[:2], sets[2], sets[3])
    constants = structure_constants(case)
    flat = [
        [np.concatenate([np.ravel(s[key][k]) for key in base]) for k in range(len(sizes))]
        for s in (*sets, *found)
    ]
    with mpmath.workdps(50):
        for k, size in enumerate(sizes):
            u, v, du, dv = ([mpmath.mpf(float(x)) for x in s[k]] for s in flat[:4])
            h = mpmath.mpf(10) ** -12

            def along(t, u=u, v=v, du=du, dv=dv):
                there = (
                    [x + t * d for x, d in zip(*pair, strict=True)] for pair in [(u, du), (v, dv)]
                )
                return exact_dexpinv(constants, *there)

            low, middle, high = (along(j * h) for j in (-1, 0, 1))
            wants = middle, (high - low) / (2 * h), (high - 2 * middle + low) / h**2
            # How near the pole is; each derivative is larger by that, and so is its rounding.
            near = 2 * np.pi / (2 * np.pi - size * is_closed)
            for n, (got, want) in enumerate(zip([s[k] for s in flat[4:7]], wants, strict=True)):
                atol = 32 * (n + 1) * near ** (n + 2) * np.finfo(dtype).eps
                np.testing.assert_allclose(
                    got, np.array(want.tolist(), float)[:, 0], 0, atol, err_msg=f"{n} at {size}"
                )
            atol = 8 * near**2 * np.finfo(dtype).eps
            np.testing.assert_allclose(flat[7][k], flat[4][k], 0, atol)


@pytest.mark.parametrize("name", [name for name, closed in WITH_DEXPINV.items() if closed])
def test_a_closed_form_is_the_limit_of_its_series_elementwise_too(name):
    case = CASES[name]
    u, v = (
        {k: jnp.stack([jnp.asarray(0.3 * x)] * 2) for k, x in case.draw().items()} for _ in range(2)
    )
    a, b = (cfjax.elementwise(jax.vmap(lambda c: case.make(**c))(c)) for c in (u, v))
    assert isinstance(a, cfjax.AbstractAlgebraElement)
    series = cfjax.AbstractAlgebraElement.dexpinv(a, b, 16)
    # (0.3 * 2 / 2 pi)^18 is 1e-18.
    problems.assert_close(a.dexpinv(b, 0), series, 1e-15)


@pytest.mark.representatives(10)
@pytest.mark.parametrize("name", CASES)
def test_zero_is_the_identity_exactly(name):
    case = CASES[name]
    zero = case.make(**{k: jnp.zeros_like(x) for k, x in case.draw().items()})
    if name.partition(" ")[0] in ("LowRankSkew", "BorderedSkew", "SphereRotation"):
        # The start of a step is moved to the manifold first, by some roundings.
        np.testing.assert_allclose(zero.flow(jnp.asarray(case.point)), case.point, 0, 2e-15)
    else:
        np.testing.assert_array_equal(zero.flow(jnp.asarray(case.point)), case.point)


@pytest.mark.parametrize("name", CASES)
def test_wrong_points_are_named(name, no_shape_hook):
    case = CASES[name]
    field = case.make(**{k: jnp.asarray(x) for k, x in case.draw().items()})
    longer = tuple(n + 1 for n in case.point.shape)
    for shape in ((), longer, (2, *case.point.shape, 2, 2)):
        point = jnp.ones(shape, case.point.dtype)
        term = cfjax.LieTerm(lambda t, y, args: field)
        with pytest.raises((TypeError, ValueError), match=type(field).__name__) as error:
            cfjax.integrate(term, cfjax.LieEuler(), 0.0, 1.0, point, num_steps=1)
        assert str(shape).replace(" ", "") in str(error.value).replace(" ", "")
