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
import numpy as np
import pytest
from problems import hat

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
    # Whether the generator is that of other points too, so that a commutator is the bracket.
    has_bracket: bool = True
    has_axes: bool = True
    # Whether the flow moves a point to the manifold or to coefficients and back, or adds up as many
    # terms as the largest of a batch needs, with some roundings.
    rounds_at_zero: bool = False


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


def dissipator(a):
    return np.kron(a, a) - (columns(a.T @ a, 3) + rows(a.T @ a, 3)) / 2


def block_diagonal(a, b):
    return np.block([[a, np.zeros((len(a), len(b)))], [np.zeros((len(b), len(a))), b]])


def unit(**arrays):
    norm = np.sqrt(sum(np.sum(np.abs(x) ** 2) for x in arrays.values()))
    return {name: x / norm for name, x in arrays.items()}


def skew(a):
    return a - a.conj().T


def frame(n, p):
    return np.linalg.qr(normal(n, p))[0]


def turned(q, *vectors):
    """Vectors of the body in fixed coordinates, by a unit quaternion wxyz."""
    m = hat(q[1:])
    turn = np.eye(3) + 2 * q[0] * m + 2 * m @ m
    return [turn @ v for v in vectors]


def in_body(x, omega, *velocities):
    """A pose wxyz and vectors, whose velocities turn with the body: A and b depend on its start."""
    omega_there, *there = turned(x[:4], omega, *velocities)
    starts = x[4:].reshape(-1, 3)
    a = quaternions(-hat(omega), omega) / 2
    for _ in starts:
        a = block_diagonal(a, hat(omega_there))
    b = [v - np.cross(omega_there, p) for v, p in zip(there, starts, strict=True)]
    return a, np.concatenate([0 * x[:4], *b])


def border(gamma):
    e = np.eye(*gamma.shape, dtype=gamma.dtype)
    return columns(gamma @ e.T - e @ gamma.T, gamma.shape[1])


TURN = np.array([[0, -1], [1, 0]])
# Of a density matrix: one is nilpotent, the other diagonal.
JUMPS = np.eye(3, k=1), np.diag([0.5, 0.0, -0.5])
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


def affine(spectrum, transform=None):
    def make(alpha, b):
        precision = np.finfo(b.dtype).dtype
        dtype = np.result_type(precision, np.complex64) if np.iscomplexobj(spectrum) else precision
        return cfjax.Affine(b, spectrum.astype(dtype), transform, alpha=alpha)

    return make


def second_difference(n, ends=-2, around=0):
    """Half of it, of norm two: with these entries at both ends, and between them."""
    m = np.diag(np.full(n, -2.0)) + np.eye(n, k=1) + np.eye(n, k=-1)
    m[0, 0] = m[-1, -1] = ends
    m[0, -1] += around
    m[-1, 0] += around
    return m / 2


# It has norm one, as have the directions of the other cases.
SPECTRUM = -np.array([0.0, 0.4, 0.4, 1.0])
ADVECTION = 1j * np.sin(2 * np.pi * np.arange(3) / 5)
GRID = cfjax.TensorTransform((cfjax.FourierTransform(), cfjax.CosineTransform()))
ON_GRID = np.add.outer(
    cfjax.FourierTransform().second_difference(3), cfjax.CosineTransform().second_difference(4)
)
CASES = {
    "Rotation": Case(
        cfjax.Rotation, lambda: unit(omega=normal(3)), normal(3), lambda x, omega: (hat(omega), 0)
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
    "RigidMotion of a quaternion and a position, body": Case(
        partial(cfjax.RigidMotion, frame="body", layout="wxyz_xyz"),
        lambda: unit(omega=normal(3), v=normal(3)),
        np.concatenate([unit(q=normal(4))["q"], normal(3)]),
        lambda x, omega, v: in_body(x, omega, v),
        is_free=False,
        has_bracket=False,
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
    "PlanarMotion of matrices, fixed": Case(
        partial(cfjax.PlanarMotion, frame="fixed"),
        lambda: unit(omega=normal(), v=normal(2)),
        normal(3, 3),
        lambda x, omega, v: (columns(screw(omega * TURN, v), 3), 0),
    ),
    "PlanarMotion of a point": Case(
        partial(cfjax.PlanarMotion, frame="fixed"),
        lambda: unit(omega=normal(), v=normal(2)),
        normal(2),
        lambda x, omega, v: (omega * TURN, v),
    ),
    "PlanarMotion of a complex number and a position, body": Case(
        partial(cfjax.PlanarMotion, frame="body", layout="unit_complex_xy"),
        lambda: unit(omega=normal(), v=normal(2)),
        np.concatenate([unit(z=normal(2))["z"], normal(2)]),
        lambda x, omega, v: (
            block_diagonal(omega * TURN, omega * TURN),
            np.concatenate([0 * v, x[0] * v + x[1] * (TURN @ v) - omega * (TURN @ x[2:])]),
        ),
        is_free=False,
        has_bracket=False,
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
    "ExtendedMotion of a quaternion and two vectors, body": Case(
        partial(cfjax.ExtendedMotion, frame="body", layout="wxyz_v_p"),
        lambda: unit(omega=normal(3), a=normal(3), v=normal(3)),
        np.concatenate([unit(q=normal(4))["q"], normal(6)]),
        lambda x, omega, a, v: in_body(x, omega, a, v),
        is_free=False,
        has_bracket=False,
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
                [np.column_stack([np.zeros((3, 3)), gravity, fixed_shift]).ravel(), np.zeros(10)]
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
        cfjax.LeftMatrix, lambda: unit(a=normal(9, 9)), normal(9), lambda x, a: (a, 0), SIZES
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
        rounds_at_zero=True,
        has_bracket=False,
    ),
    "BorderedSkew": Case(
        cfjax.BorderedSkew,
        lambda: unit(gamma=normal(5, 2)),
        frame(5, 2),
        lambda x, gamma: (border(gamma), 0),
        is_free=False,
        rounds_at_zero=True,
    ),
    "SphereRotation": Case(
        cfjax.SphereRotation,
        lambda: unit(g=normal(5)),
        unit(y=normal(5))["y"],
        lambda x, g: (np.outer(g, x) - np.outer(x, g), 0),
        is_free=False,
        rounds_at_zero=True,
        has_bracket=False,
    ),
    "SphereRotation in space": Case(
        cfjax.SphereRotation,
        lambda: unit(g=normal(3)),
        unit(y=normal(3))["y"],
        lambda x, g: (np.outer(g, x) - np.outer(x, g), 0),
        is_free=False,
        rounds_at_zero=True,
        has_bracket=False,
    ),
    "Affine": Case(
        affine(SPECTRUM),
        lambda: unit(alpha=np.abs(normal()), b=normal(4)),
        normal(4),
        lambda x, alpha, b: (alpha * np.diag(SPECTRUM).astype(LONG), b),
        SIZES,
        has_axes=False,
    ),
    "Affine, columns by sines": Case(
        affine(cfjax.SineTransform().second_difference(4) / 2, cfjax.SineTransform()),
        lambda: unit(alpha=np.abs(normal()), b=normal(4, 2)),
        normal(4, 2),
        lambda x, alpha, b: (columns(alpha * second_difference(4), 2), b.ravel()),
        SIZES,
        has_axes=False,
        rounds_at_zero=True,
    ),
    "Affine, advection of real points": Case(
        affine(ADVECTION, cfjax.RealFourierTransform(5)),
        lambda: unit(alpha=np.abs(normal()), b=normal(5)),
        normal(5),
        lambda x, alpha, b: (
            alpha * (np.roll(np.eye(5), 1, axis=1) - np.roll(np.eye(5), -1, axis=1)) / 2,
            b,
        ),
        SIZES,
        has_axes=False,
        rounds_at_zero=True,
    ),
    "Affine, a grid of complex numbers": Case(
        affine(ON_GRID / 4, GRID),
        lambda: unit(alpha=np.abs(normal()), b=normal(3, 4, is_complex=True)),
        normal(3, 4, is_complex=True),
        lambda x, alpha, b: (
            alpha
            * (columns(second_difference(3, around=1), 4) + rows(second_difference(4, ends=-1), 3))
            / 2,
            b.ravel(),
        ),
        SIZES,
        has_axes=False,
        rounds_at_zero=True,
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
        has_axes=False,
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
        has_axes=False,
        rounds_at_zero=True,
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
    "Lindblad": Case(
        lambda h, rates: cfjax.Lindblad(h, [a.astype(rates.dtype) for a in JUMPS], rates),
        lambda: unit(h=1j * skew(normal(3, 3, is_complex=True)), rates=np.abs(normal(2))),
        1j * skew(normal(3, 3, is_complex=True)),
        lambda x, h, rates: (
            columns(-1j * h, 3)
            + rows(1j * h, 3)
            + sum(rate * dissipator(a) for rate, a in zip(rates, JUMPS, strict=True)),
            0,
        ),
        # What is not Hermitian in a point is lost.
        is_free=False,
        has_bracket=False,
    ),
}


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


# Central differences of order 8, with which h = 0.02 leaves below 1e-16 of the derivatives of what
# varies by about one, and of rounding 64 bits over h^2.
STEP = LONG("0.02")
WEIGHTS = np.array([LONG(1) / n for n in (280, -26.25, 5, -1.25)])
FIRST = np.concatenate([WEIGHTS, [0], -WEIGHTS[::-1]]) / STEP
WEIGHTS = np.array([LONG(1) / n for n in (-560, 39.375, -5, 0.625)])
SECOND = np.concatenate([WEIGHTS, [LONG(-205) / 72], WEIGHTS[::-1]]) / STEP**2


def derivatives(fun):
    """The first and the second derivative at zero of a function of a long double."""
    values = np.stack([fun(k * STEP) for k in range(-4, 5)])
    return np.tensordot(FIRST, values, 1), np.tensordot(SECOND, values, 1)


def scaled(case, dtype):
    """Coordinates of all sizes, stacked, with a direction of norm one at each."""
    base, rate = case.draw(), case.draw()
    n = len(case.sizes)

    def cast(x):
        return np.asarray(x, np.result_type(dtype, np.complex64) if np.iscomplexobj(x) else dtype)

    coordinates = {k: cast(np.multiply.outer(case.sizes, x)) for k, x in base.items()}
    rates = {k: cast(np.stack([x] * n)) for k, x in rate.items()}
    points = cast(np.stack([case.point] * n))
    moves = points[..., ::-1] if case.is_free else 0 * points
    return (coordinates, points), (rates, moves)


def element(tree, k):
    return jtu.tree_map(lambda x: x[k], tree)


def close(found, expected, atol, where):
    np.testing.assert_allclose(found, expected.astype(found.dtype), 0, atol, err_msg=where)


# One row of each class is quick. The lines of the others are those of it, of a class that shares
# them, or of tests of what it calls.
SLOW = {
    *("Rotation of a matrix", "QuaternionRotation, fixed"),
    *("RigidMotion of matrices, body", "RigidMotion of matrices, fixed"),
    "RigidMotion of a quaternion and a position",
    "RigidMotion of a quaternion and a position, body",
    *("PlanarMotion of matrices, fixed", "PlanarMotion of a point"),
    "PlanarMotion of a complex number and a position",
    "PlanarMotion of a complex number and a position, body",
    *("ExtendedMotion of matrices, body", "ExtendedMotion of matrices, fixed"),
    "ExtendedMotion of a quaternion and two vectors, body",
    *("LeftMatrix, skew", "LeftMatrix, skew-Hermitian", "LeftMatrix, eigenvalues that meet"),
    *("LeftMatrix of a vector", "RightMatrix", "RightMatrix of a row"),
    *("Conjugation, skew-Hermitian", "Congruence", "SphereRotation in space"),
    *("Affine, advection of real points", "Affine, a grid of complex numbers"),
    *("OperatorSum of columns, skew", "Scaling, phases of rows"),
}
# Derivatives of a second order differ by the functions that fields share.
SLOW_TWICE = CASES.keys() - {"Rotation", "LeftMatrix", "LowRankSkew", "Affine", "Scaling"}


def some_slow(names, slow):
    return [pytest.param(x, marks=[pytest.mark.slow] * (x in slow)) for x in names]


def flow_of(case):
    return lambda coordinates, point: case.make(**coordinates).flow(point)


def exact_derivatives(case, here, rate):
    def along(t):
        return exact(case, *jtu.tree_map(lambda x, d: x + t * d, here, rate))[0]

    return derivatives(along)


@pytest.mark.parametrize("name", some_slow(CASES, SLOW))
def test_motion(name):
    """Flow, derivatives, increment and tangent of all sizes, sums and brackets, by one program."""
    case = CASES[name]
    at, direction = scaled(case, np.float64)
    singles, _ = scaled(case, np.float32)
    cotangents = at[1].reshape(len(at[1]), -1)[:, ::-1].reshape(at[1].shape)
    sets = [{k: x[None] if case.has_axes else x for k, x in case.draw().items()} for _ in range(2)]

    def of_one(at, direction, cotangent):
        end, push = jax.linearize(flow_of(case), *at)
        # JAX pulls back without conjugation.
        pulled = jax.linear_transpose(push, *at)(cotangent)
        pairs = zip(*map(jtu.tree_leaves, (pulled, direction)), strict=True)
        paired = sum(jnp.sum(a * b).real for a, b in pairs)
        field = case.make(**at[0])
        return end, push(*direction), paired, field.tangent(at[1]), field.increment(at[1])

    def motions(coordinates, point):
        field = case.make(**coordinates)
        return field.flow(point), field.increment(point)

    def velocities(sets, point):
        a, b = (case.make(**coordinates) for coordinates in sets)
        bracket = cfjax.bracket(a, b).tangent(point) if case.has_bracket else None
        return cfjax.combine((0.3, -2.0), (a, b)).tangent(point), bracket

    def two(at):
        """A field with an axis of one for two points, or a field for both of them."""
        points = np.stack([at[1], -at[1]], axis=1)
        return {k: x[:, None] if case.has_axes else x for k, x in at[0].items()}, points

    def of_two(fun):
        return fun if case.has_axes else jax.vmap(fun, (None, 0))

    @jax.jit
    def everything(at, direction, cotangents, singles, sets, points):
        of_singles = of_two(motions) if case.has_axes else jax.vmap(of_two(motions))
        return (
            jax.vmap(of_one)(at, direction, cotangents),
            of_singles(*singles),
            of_two(velocities)(sets, points),
        )

    points = np.stack([case.point, -case.point])
    ones, (ends, increments), (total, bracket) = jax.device_get(
        everything(at, direction, cotangents, two(singles), sets, points)
    )
    assert ones[0].dtype == at[1].dtype and ends.dtype == singles[1].dtype
    for k, size in enumerate(case.sizes):
        where, here = f"{name} at {size}", jtu.tree_map(long, element(at, k))
        flow, rate, paired, tangent, increment = element(ones, k)
        end, moved, norm = exact(case, *here)
        scale = norm * np.abs(case.point).max()
        # Some units of rounding, of each of the angles or of what the flow can enlarge.
        unit = 2.0**-52 * (1 + size) * scale
        least = 9 * case.rounds_at_zero
        close(flow, end, 8 * unit if size else least * 2.0**-52, where)
        first, _ = exact_derivatives(case, here, element(direction, k))
        close(rate, first, 64 * unit, where)
        # Only the real parts agree for a field that conjugates its coordinates.
        expected = np.sum(rate * cotangents[k]).real
        np.testing.assert_allclose(paired, expected, 0, 200 * unit, err_msg=where)
        a, b = case.generator(here[1], **here[0])
        velocity = (a @ here[1].ravel() + b).reshape(here[1].shape)
        # They round as little as they are.
        atol = 16 * size * scale
        close(tangent, velocity, atol * 2.0**-52, where)
        if increment is not None:
            close(increment, moved, (atol + least) * 2.0**-52, where)
        coordinates, point = jtu.tree_map(long, element(singles, k))
        for j, sign in enumerate((1, -1)):
            end, moved, norm = exact(case, coordinates, sign * point)
            scale = norm * np.abs(case.point).max()
            close(ends[k, j], end, 8 * 2.0**-23 * (1 + size) * scale, where)
            if increments is not None:
                atol = (16 * size * scale + least) * 2.0**-23
                close(increments[k, j], moved, atol, where)
    atol = 60 * 2.0**-52 * np.abs(case.point).max()
    for j, point in enumerate(long(points)):
        generators = [
            case.generator(point, **{k: long(x[0] if case.has_axes else x) for k, x in c.items()})
            for c in sets
        ]
        va, vb = ((m @ point.ravel() + b).reshape(point.shape) for m, b in generators)
        close(total[j], LONG(0.3) * va - 2 * vb, atol, name)
        if case.has_bracket:
            (ma, _), (mb, _) = generators
            commutator = (ma @ vb.ravel() - mb @ va.ravel()).reshape(point.shape)
            close(bracket[j], commutator, atol, name)


@pytest.mark.parametrize("name", some_slow(CASES, SLOW_TWICE))
def test_second_derivatives(name):
    case = CASES[name]
    at, direction = scaled(case, np.float64)

    @jax.jit
    @jax.vmap
    def twice(at, direction):
        rate = lambda *at: jax.jvp(flow_of(case), at, direction)[1]  # noqa: E731
        return jax.jvp(rate, at, direction)

    found = jax.device_get(twice(at, direction))
    for k, size in enumerate(case.sizes):
        where, here = f"{name} at {size}", jtu.tree_map(long, element(at, k))
        norm = exact(case, *here)[2]
        unit = 2.0**-52 * (1 + size) * norm * np.abs(case.point).max()
        first, second = exact_derivatives(case, here, element(direction, k))
        close(found[0][k], first, 64 * unit, where)
        close(found[1][k], second, 256 * unit, where)


def test_batches_without_members(subtests):
    for name, case in CASES.items():
        if not case.has_axes or name in SLOW:
            continue

        def motions(coordinates, point, case=case):
            a, b = case.make(**coordinates), case.make(**coordinates)
            made = [a, cfjax.combine((0.3, -2.0), (a, b))]
            if isinstance(a, cfjax.AbstractAlgebraElement):
                made += [a.bracket(b), a.dexpinv(b, 2)]
            # One of each class: the others are traced alike.
            flows = {type(field): field.flow(point) for field in made}
            return [*flows.values(), *(field.tangent(point) for field in made)]

        with subtests.test(case=name):
            at = jtu.tree_map(lambda x: x[:0], scaled(case, np.float64)[0])
            for made in jax.eval_shape(motions, *at):
                assert (made.shape, made.dtype) == (at[1].shape, at[1].dtype)


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
SLOW_DEXPINV = {
    *("InertialMotion of matrices", "LeftMatrix", "LinearAffine", "RigidMotion of a point"),
    *("PlanarMotion of a complex number and a position", "QuaternionRotation, fixed"),
    *("RigidMotion of matrices, body", "ExtendedMotion of a quaternion and two vectors"),
}


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


def phi_1_times(constants, u, v):
    """`phi_1(ad_u) v` by its series, in long doubles."""
    ad = np.tensordot(constants, u, (1, 0))
    total = term = v
    # 90 terms of a norm of 12: the last one is below 12^89 / 90! = 1e-42.
    for k in range(2, 91):
        term = ad @ term / k
        total = total + term
    return total


@pytest.mark.parametrize("name", some_slow(WITH_DEXPINV, SLOW_DEXPINV))
def test_the_inverse_derivative_of_the_exponential(name):
    """`phi_1(ad_u)` of it and of its derivatives is v, with the derivatives of this."""
    case, is_closed = CASES[name], WITH_DEXPINV[name]
    # The series to degree 12 leaves (2 * 0.1 / 2 pi)^14 of these.
    sizes = (0.0, 1e-30, 1e-12, 1e-3, 1.0, 3.0, 6.0) if is_closed else (0.0, 1e-12, 1e-3, 0.1)
    base, *others = (case.draw() for _ in range(4))
    sets = [{k: np.multiply.outer(sizes, x) for k, x in base.items()}]
    sets += [{k: np.stack([x] * len(sizes)) for k, x in other.items()} for other in others]
    singles = jtu.tree_map(lambda x: np.asarray(x, np.float32), sets[:2])

    def image(u, v):
        field = case.make(**u).dexpinv(case.make(**v), 12)
        return {k: getattr(field, k) for k in base}

    def with_derivatives(u, v, du, dv):
        first = lambda *at: jax.jvp(image, at, (du, dv))  # noqa: E731
        (value, rate), (_, second) = jax.jvp(first, (u, v), (du, dv))
        return value, rate, second

    @jax.jit
    def everything(sets, singles):
        return jax.vmap(with_derivatives)(*sets), image(*singles)

    found, of_singles = jax.device_get(everything(sets, singles))
    constants = long(structure_constants(case))

    def flat(tree, k):
        return long(np.concatenate([np.ravel(tree[key][k]) for key in base]))

    for k, size in enumerate(sizes):
        u, v, du, dv = (flat(x, k) for x in sets)
        w = [flat(x, k) for x in found]

        def residual(t, u=u, v=v, du=du, dv=dv, w=w):
            image = w[0] + t * w[1] + t**2 / 2 * w[2]
            return phi_1_times(constants, u + t * du, image) - (v + t * dv)

        residuals = [residual(LONG(0)), *derivatives(residual)]
        # How near the pole is; each derivative is larger by that, and so is its rounding.
        near = 2 * np.pi / (2 * np.pi - size * is_closed)
        for n, x in enumerate(residuals):
            atol = 32 * (n + 1) * near ** (n + 1) * 2.0**-52
            np.testing.assert_allclose(x, 0 * x, 0, atol, err_msg=f"{name}, {n} at {size}")
        u, v, w = (flat(x, k) for x in (*singles, of_singles))
        atol = 32 * near * 2.0**-23
        np.testing.assert_allclose(phi_1_times(constants, u, w), v, 0, atol)


def test_wrong_points_are_named(no_shape_hook, subtests):
    for name, case in CASES.items():
        field = case.make(**{k: jnp.asarray(x) for k, x in case.draw().items()})
        term = cfjax.LieTerm(lambda t, y, args, field=field: field)
        longer = tuple(n + 1 for n in case.point.shape)
        for shape in ((), longer, (2, *case.point.shape, 2, 2)):
            point = np.ones(shape, case.point.dtype)
            with subtests.test(case=name, shape=shape):
                with pytest.raises((TypeError, ValueError), match=type(field).__name__) as error:
                    term.vf(0.0, point, None)
                assert str(shape).replace(" ", "") in str(error.value).replace(" ", "")
