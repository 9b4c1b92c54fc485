"""Matrices to test on, and exponentials in many digits."""

import math
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import scipy.linalg

DTYPES = [np.float32, np.float64, np.complex64, np.complex128]
# The largest norms of which `expm` has a polynomial: beyond the last one it squares.
THETA = {"float32": (2.346,), "float64": (0.6764, 1.687)}
# A small rotation, and a million metres in the fixed frame.
POSE = np.array([[0.0, -0.3, 1e6], [0.3, 0.0, -2e6], [0.0, 0.0, 0.0]])


def random(shape, seed=0, dtype: type = np.float64):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=shape)
    if np.issubdtype(dtype, np.complexfloating):
        x = x + 1j * rng.normal(size=shape)
    return x.astype(dtype)


def of_norm(kind, n, norm, seed=0, dtype: type = np.float64):
    """A matrix with the given 2-norm. Skew and negative ones are normal, with exp of norm 1."""
    a = random((n, n), seed, dtype)
    if kind == "skew":
        a = a - a.conj().T
    elif kind == "negative":
        a = -a @ a.conj().T
    elif kind == "nilpotent":
        a = np.triu(a, 1)
    elif kind == "double":  # Every eigenvalue twice, and no basis of eigenvectors.
        a = np.kron(np.eye((n + 1) // 2), [[1.0, 1.0], [0.0, 1.0]])[:n, :n].astype(dtype)
    size = np.linalg.norm(a, 2)
    return (a / size * norm if size > 0 else a).astype(dtype)


def small(kind, n, norm, seed=0, dtype: type = complex):
    """A matrix of size 2 or 3 with the given 2-norm, of some kinds more."""
    if kind == "meet":  # Two eigenvalues are equal.
        q = np.linalg.qr(random((n, n), seed, dtype))[0]
        unit = 1j if np.issubdtype(dtype, np.complexfloating) else 1
        a = q @ np.diag(unit * np.array([1, 1, -2][:n])) @ q.conj().T
        return (a * (norm / np.linalg.norm(a, 2))).astype(dtype)
    if kind == "phase":  # Nearly a multiple of the identity.
        return (of_norm("meet", n, 1e-3 * norm, seed, dtype) + norm * np.eye(n)).astype(dtype)
    if kind == "negative":  # An eigenvalue zero, or exp underflows for a large norm.
        half = random((n, n), seed, dtype)[:, 1:]
        a = -half @ half.conj().T
        return (a * (norm / np.linalg.norm(a, 2))).astype(dtype)
    if kind == "cycle":  # The largest entries are not opposite to each other.
        a = np.roll(np.eye(n), 1, axis=0) + 0.1 * random((n, n), seed, dtype)
        return (a * (norm / np.linalg.norm(a, 2))).astype(dtype)
    return of_norm(kind, n, norm, seed, dtype)


def exact_expm(a):
    """exp(a) as a matrix of mpmath, for arrays or such matrices.

    Scaling and squaring of Taylor's polynomial in 60 digits: 2^-8 norm and 24 terms leave 1e-82,
    and 30 squarings lose at most 9 of the 60 digits.
    """
    with mpmath.workdps(60):
        a = mpmath.matrix(a.tolist())
        norm = max(float(mpmath.mnorm(a, 1)), 1e-300)
        squarings = max(0, math.ceil(math.log2(norm))) + 8
        x = a / mpmath.mpf(2) ** squarings
        total = term = mpmath.eye(a.rows)
        for k in range(1, 25):
            term = term * x / k
            total = total + term
        for _ in range(squarings):
            total = total * total
        return total


def to_numpy(m):
    out = np.array(m.tolist(), dtype=complex).reshape(m.rows, m.cols)
    return out if np.iscomplex(out).any() else np.real(out)


def coefficients(scheme):
    """The polynomial of a scheme of `expm`, expanded without rounding."""

    def plus(p, q):
        length = max(len(p), len(q))
        p, q = ([*r, *[Fraction(0)] * (length - len(r))] for r in (p, q))
        return [x + y for x, y in zip(p, q, strict=True)]

    def times(p, q):
        out = [Fraction(0)] * (len(p) + len(q) - 1)
        for i, x in enumerate(p):
            for j, y in enumerate(q):
                out[i + j] += x * y
        return out

    def combine(weights, known):
        total = [Fraction(0)]
        for w, p in zip(weights, known, strict=True):
            total = plus(total, [Fraction(w) * x for x in p])
        return total

    rows = scheme.rows
    known = [[Fraction(int(i == k)) for i in range(k + 1)] for k in range(1, scheme.powers + 1)]
    known.append(times(known[-1], combine(rows[0], known)))
    y1 = times(combine(rows[1], known), combine(rows[2], known))
    known.append(plus(y1, combine(rows[3], known)))
    rest = plus(times(combine(rows[4], known), combine(rows[5], known)), combine(rows[6], known))
    return plus(rest, [Fraction(1), Fraction(1)])


def backward_error(polynomial, degree, length=60):
    """|c_k| with `polynomial(x) = exp(x + sum_k c_k x^k)`, zero for k up to the degree.

    The polynomial's coefficients are Fractions. Those up to the degree count as Taylor's.
    At theta the terms beyond the length are below 1e-20 of the first.
    """
    p = [Fraction(1, math.factorial(k)) for k in range(degree + 1)] + polynomial[degree + 1 :]
    p += [Fraction(0)] * (length - len(p))
    inverse = [Fraction((-1) ** k, math.factorial(k)) for k in range(length)]
    q = [sum(p[i] * inverse[k - i] for i in range(k + 1)) for k in range(length)]
    c = [Fraction(0)] * length
    for k in range(1, length):
        c[k] = q[k] - sum((i * c[i] * q[k - i] for i in range(degree, k)), Fraction(0)) / k
    assert not any(c[: degree + 1])
    return [abs(float(x)) for x in c]


def inverse_derivative_of_exp(a, basis, b):
    """The coordinates of x with `d/dt exp(a + t x) = b exp(a)` at t = 0, by SciPy's derivatives."""
    columns = [scipy.linalg.expm_frechet(a, e, compute_expm=False) for e in basis]
    right = b @ scipy.linalg.expm(a)
    return np.linalg.lstsq(np.stack(columns, -1).reshape(-1, len(basis)), right.ravel())[0]


def rkmk3_step(generator, t, h, y):
    """A step of RKMK3 for `y' = generator(t, y) y`."""
    flow = scipy.linalg.expm
    k1 = h * generator(t, y)
    k2 = h * generator(t + h / 2, flow(k1 / 2) @ y)
    k3 = h * generator(t + h, flow(2 * k2 - k1) @ y)
    return flow((k1 + 4 * k2 + k3 - k1 @ k2 + k2 @ k1) / 6) @ y


def motions(module: Any, v: Any, states: Any, places: Any, other: Any) -> Any:
    """Of angular velocities, with the velocity v, by one program: the velocity and the increment of
    states in frames, the bracket with another motion, and the inverse derivative.
    """

    @jax.jit
    @jax.vmap
    def everything(w):
        found = []
        for x, frame in states:
            x = jnp.asarray(x)
            velocity = module.tangent(w, jnp.asarray(v), x, frame, places)
            increment = module.increment(w, jnp.asarray(v), x, frame, places, False)
            found.append((velocity, increment))
        both = w, jnp.asarray(v), *map(jnp.asarray, other)
        return found, module.bracket(*both), module.dexpinv(*both)

    return everything
