"""Problems and small tools that several test files share. No answer here comes from cfjax."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import jaxpr_as_fun, jaxprs_in_params
from scipy.integrate import solve_ivp

import cfjax

# Rigid body: y is the angular momentum, args the three moments of inertia.

INERTIA = np.array([1.0, 2.0, 3.5])
MOMENTUM = np.array([0.48, 0.6, 0.64])


def rigid_body(t, y, args):
    del t
    return cfjax.Rotation(-y / args)


def driven_body(t, y, args):
    """The rigid body with a turning torque: depends on state and time."""
    drive = jnp.stack([jnp.sin(2 * t), jnp.cos(t), t])
    return cfjax.Rotation(drive - y / args)


def driven_body_ode(t, y, args):
    """The same field as a plain ordinary differential equation, in NumPy."""
    return np.cross(np.array([np.sin(2 * t), np.cos(t), t]) - y / args, y)


# Matrices: y' = A(t, y) y or y A(t, y), with A skew, so y stays orthogonal.

_RNG = np.random.default_rng(20)
GENERATORS = _RNG.standard_normal((4, 4, 4))
ORTHOGONAL = np.linalg.qr(_RNG.standard_normal((4, 4)))[0]


def generator(xp: Any, t, y, args):
    """A skew matrix that depends on time and state, and commutes with itself at no two times.

    `xp` is NumPy for reference answers and `jax.numpy` for cfjax.
    """
    g = args
    a = xp.cos(t) * g[0] + xp.sin(2 * t) * g[1] + g[2] @ y @ g[3] / 2
    return (a - a.T) / 2


def left_matrix(t, y, args):
    return cfjax.LeftMatrix(generator(jnp, t, y, args))


def right_matrix(t, y, args):
    return cfjax.RightMatrix(generator(jnp, t, y, args))


# A product of manifolds with every kind of part: an attitude, a momentum and a position.


def body_in_flight(t, y, args):
    """A driven rigid body that moves along its own first axis."""
    inertia, drag = args
    spin = y["momentum"] / inertia
    push = jnp.stack([jnp.cos(2 * t), jnp.sin(t), jnp.ones_like(t)])
    return {
        "attitude": cfjax.Rotation(spin),
        "momentum": cfjax.Rotation(push - spin),
        "position": y["attitude"][:, 0] - drag * y["position"],
    }


def body_in_flight_ode(t, y, args):
    inertia, drag = args
    attitude, momentum, position = y[:9].reshape(3, 3), y[9:12], y[12:]
    spin = momentum / inertia
    push = np.array([np.cos(2 * t), np.sin(t), 1.0])
    return np.concatenate(
        [
            np.cross(spin, attitude.T).T.ravel(),
            np.cross(push - spin, momentum),
            attitude[:, 0] - drag * position,
        ]
    )


FLIGHT_START = {
    "attitude": np.eye(3),
    "momentum": MOMENTUM,
    "position": np.array([0.1, -0.2, 0.3]),
}
FLIGHT_ARGS = (INERTIA, 0.3)


# A driven top in four terms, each of which has an exact flow: attitude q and angular momentum m.


def _kick(t, y, args):
    torque = (1 + 0.3 * jnp.sin(t)) * jnp.cross(jnp.asarray([0.2, 0.3, 1.0]), y["q"][:, 2])
    return {"q": None, "m": torque}


def _spin(axis):
    def field(t, y, args):
        m = jnp.eye(3)[axis] * y["m"] / args
        return {"q": cfjax.RightMatrix(jnp.cross(jnp.eye(3), m)), "m": cfjax.Rotation(-m)}

    return field


DRIVEN_TOP = diffrax.MultiTerm(*map(cfjax.LieTerm, (_kick, _spin(0), _spin(1), _spin(2))))
DRIVEN_TOP_START = {"q": np.eye(3), "m": np.array([1.0, 0.5, 2.0])}


def driven_top_ode(t, y):
    q, m = y[3:].reshape(3, 3), y[:3]
    w = m / INERTIA
    torque = (1 + 0.3 * np.sin(t)) * np.cross([0.2, 0.3, 1.0], q[:, 2])
    hat = np.cross(np.eye(3), w)
    return np.concatenate([np.cross(m, w) + torque, (q @ hat).ravel()])


def assert_order_of_driven_top(solver, order, num_steps, answer) -> None:
    errors, (y0, args) = [], arrays((DRIVEN_TOP_START, INERTIA))
    for n in num_steps:
        ys: Any = cfjax.integrate(DRIVEN_TOP, solver, 0.0, 1.0, y0, args, num_steps=n).ys
        end = np.concatenate([np.ravel(ys["m"][-1]), np.ravel(ys["q"][-1])])
        errors.append(np.max(np.abs(end - answer)))
    # Above the rounding of the reference, so the slope is the method's.
    assert errors[1] > 20 * REFERENCE_ERROR
    assert order - 0.1 < np.log2(errors[0] / errors[1]) < order + 0.35
    assert solver.order(DRIVEN_TOP) == order


def flat(y: Any) -> np.ndarray:
    """All entries of a state as one vector, in the order of its structure."""
    return np.concatenate([np.ravel(leaf) for leaf in jtu.tree_leaves(y)])


def arrays(tree: Any) -> Any:
    """The same pytree with JAX arrays, so that new values never trace again."""
    return jtu.tree_map(jnp.asarray, tree)


# Reference answers: DOP853 in the linear space, at the tightest tolerance SciPy takes. Methods of
# order 5 approach them with a clean slope down to 2e-13 (256 steps), so they are better than that.
REFERENCE_ERROR = 1e-13


def reference(ode: Callable[[float, np.ndarray], np.ndarray], t0, t1, y0) -> np.ndarray:
    answer = solve_ivp(ode, (t0, t1), y0, method="DOP853", rtol=2.3e-14, atol=1e-15)
    assert answer.success
    return answer.y[:, -1]


# A loop of steps that knows nothing of cfjax.integrate or diffrax.diffeqsolve.


@eqx.filter_jit
def many_steps(field, solver, t0, t1, y0, args, num_steps, ignore_stage_times=False):
    """The end of `num_steps` equal steps; their number is traced, so one program serves all.

    `ignore_stage_times` makes the mistake of solvers that evaluate every stage at the start of
    the step.
    """
    h = (t1 - t0) / num_steps

    def step(n, carry):
        y, state = carry
        start, end = t0 + n * h, t0 + (n + 1) * h

        def mistaken(t, y, args):
            del t
            return field(start, y, args)

        term = cfjax.LieTerm(mistaken if ignore_stage_times else field)
        y, _, _, state, _ = solver.step(term, start, end, y, args, state, made_jump=False)
        return y, state

    state = solver.init(cfjax.LieTerm(field), t0, t0 + h, y0, args)
    return lax.fori_loop(0, num_steps, step, (y0, state))[0]


def first_step(solver, term, t0, t1, y0, args) -> Any:
    """What `solver.step` returns for a step with a new state of the solver."""
    state = solver.init(term, t0, t1, y0, args)
    return solver.step(term, t0, t1, y0, args, state, made_jump=False)


def num_operations(jaxpr: Any) -> int:
    """The operations of a program as it is written, with its functions, loops and branches."""
    inner = (x for eqn in jaxpr.eqns for x in jaxprs_in_params(eqn.params))
    return len(jaxpr.eqns) + sum(map(num_operations, inner))


def errors(field, solver, t1, y0, args, answer, steps: Sequence[int], **kwargs) -> np.ndarray:
    """Distances of the end points from `answer`, for each number of steps from t = 0 to `t1`."""
    y0, args = arrays(y0), arrays(args)
    ends = [
        many_steps(
            field, solver, jnp.asarray(0.0), jnp.asarray(t1), y0, args, jnp.asarray(n), **kwargs
        )
        for n in steps
    ]
    return np.array([np.linalg.norm(flat(end) - answer) for end in ends])


def slope(steps: Sequence[int], errors: np.ndarray) -> float:
    """The observed order: the slope of the regression line of log error over log step size."""
    return -float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


class Growth(cfjax.AbstractFrozenField):
    """A class of a user's own, without a bracket."""

    rate: jax.Array

    def flow(self, point):
        return point * jnp.exp(self.rate)

    def tangent(self, point):
        return point * self.rate


# Derivatives.

# For `jax.jit` where most of the time of a test is the compilation of a derivative.
QUICK: Any = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


class Circle(cfjax.AbstractFrozenField):
    """Turns of the circle through a point about the origin."""

    angle: jax.Array

    def flow(self, point):
        c, s = jnp.cos(self.angle), jnp.sin(self.angle)
        return jnp.stack([c * point[0] - s * point[1], s * point[0] + c * point[1]])

    def tangent(self, point):
        return self.angle * jnp.stack([-point[1], point[0]])

    def defect(self, point):
        return jnp.abs(point @ point - 1), "length 1"

    def projected(self, point):
        return cfjax.Nearest(self.tangent(point), to_the_circle)


def to_the_circle(point):
    return point / jnp.sqrt(point @ point)


def central_difference(fun: Callable[[Any], Any], x: Any, direction: Any, step: float) -> Any:
    """Order 4: an error of about step^4 (fifth derivative) / 30 and 1.5 rounding / step."""
    f = [
        fun(jtu.tree_map(lambda a, d, k=k: a + k * step * d, x, direction)) for k in (-2, -1, 1, 2)
    ]
    return jtu.tree_map(lambda a, b, c, d: ((a - d) - 8 * (b - c)) / (12 * step), *f)


def orthonormal(y: Any) -> Any:
    """The nearest orthonormal columns, for columns within a difference quotient's step of such.

    Newton's method: a defect of 1e-2 is one of 1e-4, 1e-8 and 1e-16. A solve refuses other starts.
    """
    for _ in range(3):
        y = y @ (3 * jnp.eye(y.shape[1]) - y.T @ y) / 2
    return y


def assert_close(found: Any, expected: Any, atol: float) -> None:
    for a, b in _pairs(found, expected):
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def inner(a: Any, b: Any) -> jax.Array:
    """The pairing of two pytrees of real arrays, which is what a gradient is defined by."""
    return cast(jax.Array, sum(jnp.vdot(x, y) for x, y in _pairs(a, b)))


def _pairs(a, b):
    return zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True)


def random_like(tree: Any, seed: int) -> Any:
    """A fixed random direction, shaped like `tree`."""
    rng = np.random.default_rng(seed)
    return jtu.tree_map(lambda x: jnp.asarray(rng.standard_normal(jnp.shape(x))), tree)


# Squares of angles, on both sides of what formulas of sines and cosines decide by: half turns,
# and 16.
SQUARES_OF_ANGLES = [
    0.0,
    1e-300,
    1e-160,
    1e-30,
    1e-8,
    1e-3,
    1.0,
    *(k**2 * np.pi**2 * (1 + d) for k in (1, 2, 3, 4) for d in (-1e-9, 0.0, 1e-9)),
    np.nextafter(16.0, 0.0),
    16.0,
    np.nextafter(16.0, 20.0),
    40.0,
    110.0,
    1e4,
]


def hat(w) -> np.ndarray:
    """The matrix of the cross product with w."""
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def op_by_op(fun: Callable[..., Any], *args: Any) -> Any:
    """`fun(*args)` by its program, operation by operation.

    Each operation is compiled once for all programs. To compile every program takes far longer.
    """
    args = arrays(args)
    program, shape = jax.make_jaxpr(fun, return_shape=True)(*args)
    return jtu.tree_unflatten(
        jtu.tree_structure(shape), jaxpr_as_fun(program)(*jtu.tree_leaves(args))
    )


def in_pieces(term, solver, t0, t1, y0, args, num_steps: int, pieces: int) -> Any:
    """The end of as many solves of `num_steps` steps, one after the other, by one program."""
    y, args = arrays((y0, args))
    for start, end in pairwise(np.linspace(t0, t1, pieces + 1)):
        ys = cfjax.integrate(term, solver, start, end, y, args, num_steps=num_steps).ys
        y = jtu.tree_map(lambda x: x[-1], ys)
    return y
