"""Flows of matrices with exact answers by SciPy, for steps in several coordinates."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import problems
import scipy.linalg

import cfjax
from cfjax.scenes import toda

expm = scipy.linalg.expm
_RNG = np.random.default_rng(3)


def skew(n, is_complex=False):
    """A skew-Hermitian matrix of norm 1 and trace 0."""
    a = _RNG.normal(size=(n, n)) + (1j * _RNG.normal(size=(n, n)) if is_complex else 0)
    a = a - a.conj().T
    a = a - np.trace(a) / n * np.eye(n)
    return a / np.linalg.norm(a, 2)


def symmetric(n):
    a = _RNG.normal(size=(n, n))
    return (a + a.T) / np.linalg.norm(a + a.T, 2)


class Problem(NamedTuple):
    """A field with its start, args, and the solution at any time, by formulas of SciPy."""

    field: Callable[..., Any]
    y0: Any
    args: Any
    exact: Callable[[float], Any]

    @property
    def term(self):
        return cfjax.LieTerm(self.field)

    def end(self, solver, t1, num_steps):
        y0, args = problems.arrays((self.y0, self.args))
        ys = cfjax.integrate(self.term, solver, 0.0, t1, y0, args, num_steps=num_steps).ys
        return jax.tree_util.tree_map(lambda y: y[-1], ys)


# y' = b y + y c, written as a field from one side: the solution is exp(t b) y0 exp(t c).


def left(t, y, args):
    b, c = args
    return cfjax.LeftMatrix(b + y @ c @ y.conj().T)


def right(t, y, args):
    b, c = args
    return cfjax.RightMatrix(y.conj().T @ b @ y + c)


def two_sided(field, y0, b, c):
    # Their y^H y and y y^H are the identity or constant.
    rows, columns = np.eye(len(b)), np.eye(len(c))
    if field is left:
        columns = y0.conj().T @ y0
    else:
        rows = y0 @ y0.conj().T
    return Problem(field, y0, (b, c), lambda t: expm(t * rows @ b) @ y0 @ expm(t * c @ columns))


def low_rank(t, y, args):
    # (g y^T - y g^T) y has y c twice, and y^T b y as well as b y.
    b, c = args
    return cfjax.LowRankSkew(b @ y + y @ (c - y.T @ b @ y) / 2)


def bordered(t, y, args):
    return cfjax.BorderedSkew(args * jnp.cos(t))


def _bordered(y0, gamma):
    matrix = np.pad(gamma, ((0, 0), (0, len(gamma) - gamma.shape[1])))
    matrix = matrix - matrix.T
    return Problem(bordered, y0, gamma, lambda t: expm(np.sin(t) * matrix) @ y0)


def flow_of_toda(t, y, args):
    return cfjax.Conjugation(jnp.triu(y, 1) - jnp.tril(y, -1))


def conjugation(t, y, args):
    """No part of y is in the matrix but y^2, which commutes with y."""
    return cfjax.Conjugation(args + y @ y)


def riccati(t, x, args):
    """x' = b x + x b^T - x r x, and skew multiples of x, which move nothing."""
    b, r, k = args
    return cfjax.Congruence(b - x @ r / 2 + x @ k)


def _riccati(x0, b, r, k):
    def exact(t):
        zero = np.zeros_like(b)
        start = np.vstack([x0, np.eye(len(b))])
        x, y = np.split(expm(t * np.block([[b, zero], [r, -b.T]])) @ start, 2)
        return x @ np.linalg.inv(y)

    return Problem(riccati, x0, (b, r, k), exact)


COLUMNS = _RNG.normal(size=(6, 3)) / 2
ORTHONORMAL = np.linalg.qr(COLUMNS)[0]
_B = _RNG.normal(size=(4, 4)) / 4
LATTICE = symmetric(4)
PROBLEMS = {
    "SO(5)": two_sided(left, np.eye(5), skew(5), skew(5)),
    "SO(5), body frame": two_sided(right, np.eye(5), skew(5), skew(5)),
    "SU(3)": two_sided(left, np.eye(3) + 0j, skew(3, True), skew(3, True)),
    "orthonormal columns": two_sided(left, ORTHONORMAL, skew(6), skew(3)),
    "orthonormal columns, low rank": two_sided(left, ORTHONORMAL, skew(6), skew(3))._replace(
        field=low_rank
    ),
    "columns": two_sided(left, COLUMNS, skew(6), skew(3) / 3),
    "rows": two_sided(right, np.eye(4)[:2] + 0.1, skew(2), skew(4)),
    "a vector": Problem(
        lambda t, y, args: cfjax.LeftMatrix(args * jnp.cos(t)),
        2 * np.eye(5)[0],
        b := skew(5),
        lambda t, b=b: expm(np.sin(t) * b)[:, 0] * 2,
    ),
    "bordered": _bordered(ORTHONORMAL, _RNG.normal(size=(6, 3)) / 3),
    "Toda": Problem(flow_of_toda, LATTICE, None, lambda t: toda.reference(t, LATTICE)),
    "conjugation": Problem(
        conjugation,
        LATTICE @ _B,
        3 * _B,
        lambda t: expm(3 * t * _B) @ LATTICE @ _B @ expm(-3 * t * _B),
    ),
    "Riccati": _riccati(np.eye(4) + 0.1, _B, np.eye(4) / 2 + symmetric(4) / 4, skew(4)),
}


def both(t, y, args):
    """Columns and a lattice, each with a projection of its own."""
    return {"columns": left(t, y["columns"], args), "lattice": flow_of_toda(t, y["lattice"], None)}


_GIVEN = PROBLEMS["columns"]
BOTH = Problem(
    both,
    {"columns": _GIVEN.y0, "lattice": LATTICE},
    _GIVEN.args,
    lambda t: {"columns": _GIVEN.exact(t), "lattice": toda.reference(t, LATTICE)},
)
