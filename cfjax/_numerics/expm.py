"""The exponential of a small dense matrix, as a Taylor polynomial with scaling and squaring."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Inexact, PyTree

from . import cayley_hamilton
from .matmul import plus_identity, small_product
from .squaring import exponent, magnitude, max_over_batch, squared, squarings

T = TypeVar("T", bound=PyTree)


class Scheme(NamedTuple):
    """A Taylor polynomial and the largest scaled norm it may be used for.

    `rows` are weights over the terms computed so far, of the list A, .., Aᵐ, Y₀, Y₁ with
    Y₀ = Aᵐ·(row 0), Y₁ = (row 1)·(row 2) + (row 3), exp ≈ I + A + (row 4)·(row 5) + (row 6).
    """

    powers: int
    theta: float
    rows: tuple[tuple[float, ...], ...]


# The rows solve the equations "the coefficient of A^k is 1/k!" for k = 2..15 and k = 2..21. Both
# systems have many solutions. These have the least cancellation among those that Newton's method
# reached from random starts. They were refined in 60 digits and rounded to double so that 1/2! to
# 1/6! are correct within 1e-17: an error of 1/2! is an error of exp(a)ᵀ exp(a), the same in every
# step. theta is where the backward error of the remainder of the series reaches half a unit in the
# last place. It is not the one of `TAYLOR_THETA`, as the product also has terms of higher degree.
# tests/numerics/test_expm.py derives both.
_DEGREE_15 = Scheme(
    powers=2,
    theta=2.346,
    rows=(
        (-0.0029455314402796829805, -0.00040187616102010354629),
        (-0.40175684406735678015, 0.0087090665768376759677, 1.0),
        (0.0, -0.03230762888122312082, 1.0),
        (0.0, 0.023385760342712988337, -5.7689885130261447291),
        (2.2242091724963737, 0.23810703738709876, 0.0, 1.0),
        (-0.04130276365929782911, 0.0, 5.7923617070732605218, 1.0),
        (0.0, 0.34846658633645744, 63.3171245588337, 10.408017352313543),
    ),
)
_DEGREE_21 = Scheme(
    powers=3,
    theta=1.687,
    rows=(
        (6.0220339939757525e-5, 4.026607697588414e-6, 1.1715883041600067e-6),
        (0.91444680548322120091, 0.069638057688038120934, 0.00210752478348037193, 1.0),
        (0.0, -0.0044382744842061279606, 0.0026410957045077874184, 1.0),
        (0.0, 0.11109004322888573, 0.030421851623947723, 7.913475596840367),
        (0.9931837303884492, 0.03764869652855396, -0.008695837982034884, 0.0, 1.0),
        (0.2032415001516612, 0.0, 0.0, -2.343812849234265, 1.0),
        (0.0, 0.5366262717221202, 0.08269931189354755, 15.1637651638964, -2.1467488541806707),
    ),
)
# For double precision the norm must be smaller; up to there it saves a product.
_DEGREE_15_DOUBLE = _DEGREE_15._replace(theta=0.6764)
# From the cheapest to the one that is used with scaling and squaring.
TAYLOR_SCHEMES = {
    "float32": (_DEGREE_15,),
    "complex64": (_DEGREE_15,),
    "float64": (_DEGREE_15_DOUBLE, _DEGREE_21),
    "complex128": (_DEGREE_15_DOUBLE, _DEGREE_21),
}


def weighted_sum(weights: Sequence[float], terms: Sequence[T]) -> T:
    used = [(w, term) for w, term in zip(weights, terms, strict=True) if w != 0]
    return _plus(*(jtu.tree_map(lambda x: w * x, term) for w, term in used))  # noqa: B023


def _plus(*terms: T) -> T:
    return jtu.tree_map(lambda *xs: sum(xs[1:], start=xs[0]), *terms)


def taylor_from_second(
    scheme: Scheme, a: T, a2: T, product: Callable[[T, T], T] = small_product
) -> T:
    """`exp(a) - I - a`, for a matrix or a pytree with a product, from a and a^2."""
    terms = [a, a2]
    if scheme.powers == 3:
        terms.append(product(a2, a))

    row = scheme.rows
    terms.append(product(terms[-1], weighted_sum(row[0], terms)))
    y1 = product(weighted_sum(row[1], terms), weighted_sum(row[2], terms))
    terms.append(_plus(y1, weighted_sum(row[3], terms)))
    y2 = product(weighted_sum(row[4], terms), weighted_sum(row[5], terms))
    return _plus(y2, weighted_sum(row[6], terms))


def one_norm(a: Array) -> Array:
    """The 1-norm, with `magnitude` for the absolute value, which is a consistent norm too."""
    return jnp.max(jnp.sum(magnitude(a), axis=0))


def expm(a: Inexact[Array | np.ndarray, "n n"]) -> Inexact[Array, "n n"]:
    """The matrix exponential of `a`, for small dense matrices in loops, batches and derivatives.

    **Arguments:** `a`, shape `(n, n)`, float32, float64, complex64 or complex128.

    **Returns:** exp(a), with the shape and dtype of `a`.

    **Cost:** 5 matrix products (4 in single precision) and s more, with
    s = ⌈log₂(‖a²‖^½ / θ)⌉ ≥ 0 in the 1-norm and θ = 1.687 (2.346 in single precision). In double
    precision 4 products are enough up to ‖a²‖^½ = 0.676, if n > 4. For n = 2 and 3 there are other
    formulas, 2 to 4 times faster, and s = ⌈log₂(‖a‖ / 2^½)⌉ ≥ 0 in the Frobenius norm of a matrix
    that is Hermitian or skew-Hermitian; otherwise s depends on products of entries around cycles,
    and a change of units does not alter it. There is no linear solve and no custom call. Under
    `jax.vmap` every matrix is scaled by its own norm, and the products are those of the largest. A
    derivative of any order works, forward and reverse.

    **Accuracy:** a backward error of a few units in the last place of the scaled matrix, doubled by
    every squaring at worst. exp(0) = I holds exactly, and so does its derivative. s may be up to 52
    (23 in single precision): beyond this no digit of the result would be right, and it is NaN. An
    overflow of exp(a) or of a² gives inf or NaN, an entry that is not finite gives NaN.

    **Raises:** `ValueError` if `a` is not a square matrix, `TypeError` for another dtype.

    Source: the polynomials have the form of Sastre, Linear Algebra Appl. 539 (2018),
    doi:10.1016/j.laa.2017.11.010, and of Sastre & Ibáñez, Mathematics 9 (2021). Bounding the
    backward error by powers of a is from Al-Mohy & Higham, SIAM J. Matrix Anal. Appl. 31 (2009).
    """
    a = jnp.asarray(a)
    weight, remainder = expm_parts(a)
    return weight * (jnp.eye(a.shape[0], dtype=a.dtype) + a) + remainder


def expm_parts(
    a: Inexact[Array, "n n"],
) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"]]:
    """`expm(a)` as `weight * (I + a) + remainder`, with weight 0 if it was squared, otherwise 1.

    A step of an integrator applies an exponential near I as
    `weight * (x + a @ x) + remainder @ x`. The rounding error of the remainder is relative to it,
    of the size of a^2, and is the same in every step with the same a. So the invariants of exp(a)
    drift more slowly than with a product with exp(a). Otherwise as `expm`.
    """
    if a.ndim != 2 or a.shape[0] != a.shape[1]:
        raise ValueError(f"expm: `a` must be a square matrix, shape (n, n), got shape {a.shape}.")
    if a.dtype.name not in TAYLOR_SCHEMES:
        raise TypeError(
            f"expm: `a` must have dtype {', '.join(TAYLOR_SCHEMES)}, got {a.dtype.name}."
        )
    if a.shape[0] <= 1:
        return jnp.zeros((), a.dtype), jnp.where(jnp.isfinite(a), jnp.exp(a), jnp.nan)
    if a.shape[0] <= 3:
        return cayley_hamilton.expm_parts(a)

    schemes = TAYLOR_SCHEMES[a.dtype.name]

    n = a.shape[0]
    a = in_full_register(a)
    thetas = [scheme.theta for scheme in schemes]
    weight, remainder = by_norm(
        thetas,
        a,
        small_product(a, a),
        lambda k, a, a2: taylor_from_second(schemes[k], a, a2),
        lambda a, remainder: plus_identity(remainder + a),
    )
    return weight, remainder[:n, :n]


def in_full_register(a: Array) -> Array:
    """Pads a real matrix that is a little smaller than a vector register with zeros.

    In a batch its products are two to three times faster than those of size n.
    """
    n = a.shape[0]
    return jnp.pad(a, (0, 8 - n)) if 4 < n < 8 and not jnp.iscomplexobj(a) else a


def by_norm(
    thetas: Sequence[float],
    first: PyTree,
    second: PyTree,
    approximate: Callable[[int, PyTree, PyTree], T],
    start: Callable[[PyTree, T], T],
    double: Callable[[T], T] | None = None,
) -> tuple[Array, T]:
    """An approximation chosen by the norm of a, with scaling and squaring for large norms.

    **Arguments:**

    - `thetas`: for each k the largest norm that `approximate` may be used for. A matrix of a larger
      norm is scaled to the last.
    - `first`, `second`: a and a^2, or pytrees whose first leaf they are.
    - `approximate`: a function of k, `first / 2^s` and `second / 4^s`. If s is 0, its value is the
      result.
    - `start`, `double`: otherwise the result is `start(first / 2^s, value)`, doubled s times as
      `squared` does.

    **Returns:** a weight, 1 if s is 0 and otherwise 0, and the result.
    """
    *cheaper, theta = thetas
    # ‖a²‖ bounds every even power, and an odd one up to a factor ‖a‖, which is enough for a
    # backward error relative to ‖a‖. It is often far below ‖a‖², which saves squarings.
    a2 = jtu.tree_leaves(second)[0]
    size = one_norm(lax.stop_gradient(a2))

    def scaled(first: PyTree, second: PyTree) -> tuple[Array, T]:
        s, scale = squarings(exponent(size / theta**2, degree=2), size.dtype)
        first, second = (
            jtu.tree_map(lambda x: x * factor.astype(x.dtype), blocks)  # noqa: B023
            for blocks, factor in [(first, scale), (second, scale * scale)]
        )
        value = approximate(len(cheaper), first, second)
        return (s == 0).astype(a2.dtype), squared(value, lambda x: start(first, x), s, double)

    # Up to size 4 products fuse with their neighbours, and a branch costs more than a product.
    if not cheaper or a2.shape[0] <= 4:
        return scaled(first, second)

    # NaN takes the branch that scales, and stays NaN.
    return lax.cond(
        max_over_batch(size) <= cheaper[0] ** 2,
        lambda first, second: (jnp.ones((), a2.dtype), approximate(0, first, second)),
        jax.checkpoint(scaled),
        first,
        second,
    )
