"""Stumpff functions: sines and cosines of a square root, smooth at zero and for both signs."""

import functools
from collections.abc import Sequence
from math import factorial, pi
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .inverses import factors_of_inverse_root, reciprocal
from .polynomial import polynomial
from .vectors import Vector, smooth


def stumpff(n: int, s: Float[Array | np.ndarray, "*batch"]) -> Float[Array, "*batch"]:
    """The function `c_n(s) = sum_j (-s)^j / (n + 2j)!`, for `n >= 0`.

    With `s = x^2`: `c_0 = cos x`, `c_1 = sin x / x`, `c_2 = (1 - cos x) / x^2`, and with
    `s = -x^2`: `c_0 = cosh x`, `c_1 = sinh x / x`, `c_2 = (cosh x - 1) / x^2`. For both signs
    `s c_{n+2} = 1/n! - c_n`. They are entire functions of s, with the derivatives
    `c_n' = (n c_{n+2} - c_{n+1}) / 2`, which hold at zero too.

    They give the flows of a matrix a with `a^3 = -s a`: `exp(a) = I + c_1 a + c_2 a^2` and
    `phi_1(a) = I + c_2 a + c_3 a^2`. For rotations a is the matrix of the cross product with w, and
    `s = w @ w`. For boosts s is negative.

    The error is a few units of rounding of x, and relative for small x: for `s > 0` absolute in
    `x c_1` and `x^2 c_2`, and for `s < 0` relative to the value. So an s beyond 2^90 (2^32 in
    float32), whose x rounding leaves uncertain by a hundredth, gives NaN, and so does an s that is
    not finite. Where cosh x overflows, the result is infinite.

    **Arguments:** `n`, a number; `s`, an array of any shape, float32 or float64.

    **Returns:** an array like `s`.

    **Raises** `TypeError` if `n` is not an int or `s` has another dtype, `ValueError` if `n` is
    negative.

    Source: Stiefel & Scheifele, Linear and Regular Celestial Mechanics (1971), Section 11.
    """
    if not isinstance(n, int) or isinstance(n, bool):
        raise TypeError(f"n must be an int, got {n!r} of type {type(n).__name__}.")
    if n < 0:
        raise ValueError(f"n must be at least 0, got {n}.")
    s = jnp.asarray(s)
    if s.dtype not in (jnp.float32, jnp.float64):
        raise TypeError(f"s must be float32 or float64, got {s.dtype}.")
    return _of_both_signs(n, s)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
@smooth
def _of_both_signs(n: int, s: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    of_square = _together(*_stumpff_apart(max(n, 3), jnp.maximum(s, 0)))[n]
    return jnp.where(s >= 0, of_square, _of_negative(n, s))


@_of_both_signs.defjvp
def _(n, primals, tangents):
    value, first, second = (_of_both_signs(k, *primals) for k in (n, n + 1, n + 2))
    return value, (n * second - first) / 2 * tangents[0]


def _of_negative(n: int, s: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """`c_n(s)` for a negative s: by its series and, from -16 on, by hyperbolic functions."""
    is_small = s > -16
    terms = [(-1) ** j / factorial(n + 2 * j) for j in range(18)]
    series = polynomial(terms, jnp.where(is_small, s, 0))
    square = jnp.where(is_small, 16, -s)
    x = jnp.sqrt(square)
    c = [jnp.cosh(x), jnp.sinh(x) / x]
    for k in range(n - 1):
        c.append((c[k] - 1 / factorial(k)) / square)
    return jnp.where(is_small, series, c[n])


# The square of a full turn.
_FULL_TURN = 4 * pi**2


class Exponential(NamedTuple):
    """`exp(A) = I + c_1 A + c_2 A^2` for an A with `A^3 = -s A`, and `c_3`.

    `c_1 = near + d1` and `c_2 = near / 2 + d2`, where `near` is 1 up to half a turn and 0 beyond.
    The rounding error of c_1 and c_2 is the same in every step of equal angle, so lengths would
    drift in proportion to the number of steps. Their values at zero are exact and are stored
    separately, so the rounding errors are smaller by the square of the angle.
    """

    near: Array
    d1: Array
    d2: Array
    c3: Array

    def increment(self, once: Vector, twice: Vector) -> Vector:
        """`exp(A) x - x` from `A x` and `A^2 x`."""
        near, d1, d2, _ = self
        return [near * (a + b / 2) + (d1 * a + d2 * b) for a, b in zip(once, twice, strict=True)]

    def turned(self, s: Array, x: Vector, once: Vector, leads_back: bool) -> Vector:
        """`exp(A) x - x` from `A x`, for a unit quaternion or complex number x: `A^2 = -s`.

        With `leads_back` it is `(1 - lead off / 2) exp(A) x - x`, which brings the length of x back
        to 1: `off` is the squared length minus 1, and lead is `1 - c_0` up to half a turn and 1
        beyond. So the error of the length does not grow for any angle, and for a small angle the
        correction is of the order of its square, as is the rounding error of an increment.
        """
        near, d1, d2, _ = self
        d2 = s * d2
        if leads_back:
            off = sum(a * a for a in x[1:]) + (x[0] * x[0] - 1)
            c0 = 1 - near * s / 2 - d2
            c0, c1, part = lax.stop_gradient((c0, near + d1, (1 - near * c0) * (off / 2)))
            d1, d2 = d1 - part * c1, d2 + part * c0
        return [near * (u - s / 2 * a) + (d1 * u - d2 * a) for a, u in zip(x, once, strict=True)]


def stumpff_1_to_3_apart(s: Float[Array, "*batch"]) -> Exponential:
    return _stumpff_apart(3, s)[0]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
@smooth
def _stumpff_apart(
    n: int, s: Float[Array, "*batch"]
) -> tuple[Exponential, tuple[Float[Array, "*batch"], ...]]:
    """The functions of an exponential, and `c_0` and `c_4` to `c_n`, some of which derivatives use.

    They come together, as otherwise a derivative would compute the first ones again. There are no
    branches and no divisions, which would be slow in a loop of small steps.
    """
    constants = _constants(s)
    turns, inverse = _turns(s)
    near = jnp.where(turns == 0, 1, jnp.zeros_like(s))
    excess = turns * ((2 * pi) * inverse)
    scale = 1 - excess
    square = scale * scale
    z = s * square
    p1, p2 = (polynomial(c[1:], z) for c in (constants.sin, constants.versin))
    # Grouped so that few operations depend on the polynomials.
    d1 = (scale * z) * p1 + scale * (1 - near)
    d2 = (square * z) * p2 + square * ((1 - near) / 2)
    # Without a full turn the square of the inverse may overflow.
    c3 = (excess * inverse) * inverse - (scale * square) * p1
    c = {2: near / 2 + d2, 3: c3}
    # The recursion loses digits to cancellation for small s, the series for large s.
    small = s < 16
    for k in range(4, n + 1):
        terms = [(-1) ** j / factorial(k + 2 * j) for j in range(18)]
        series = polynomial(terms, jnp.where(small, s, 0))
        recursion = (1 / factorial(k - 2) - c[k - 2]) * (inverse * inverse)
        c[k] = jnp.where(small, series, recursion)
    return Exponential(near, d1, d2, c3), (1 - s * c[2], *(c[k] for k in range(4, n + 1)))


@_stumpff_apart.defjvp
def _(n, primals, tangents):
    (s,), (s_dot,) = primals, tangents
    exponential, others = _stumpff_apart(n + 2, s)
    c = _together(exponential, others)
    slopes = [(k * c[k + 2] - c[k + 1]) / 2 * s_dot for k in range(n + 1)]
    tangents_out = Exponential(jnp.zeros_like(s), *slopes[1:4]), (slopes[0], *slopes[4:])
    return (exponential, others[: n - 2]), tangents_out


def _together(exponential: Exponential, others: Sequence[Array]) -> list[Array]:
    """The functions `c_0, c_1, ..` in order."""
    near, d1, d2, c3 = exponential
    return [others[0], near + d1, near / 2 + d2, c3, *others[1:]]


def dexpinv_times(s: Array, x: Vector, once: Vector, twice: Vector) -> Vector:
    """The inverse derivative of the exponential at u, of x, from `[u, x]` and `[u, [u, x]]`.

    In a Lie algebra with `ad_u^3 = -s ad_u` it is `x - [u, x] / 2 + excess [u, [u, x]]`.
    """
    excess = cotangent_excess(s)
    return [c + (excess * b - a / 2) for a, b, c in zip(once, twice, x, strict=True)]


@smooth
def cotangent_excess(s: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """`(1 - x/2 cot(x/2)) / x^2` with `s = x^2`, which is 1/12 at zero, and smooth there.

    It is `sum_k 2 / (4 pi^2 k^2 - s)`: a pole at a full turn plus, to rounding, a polynomial. From
    a full turn on the result is 1/12 and has no meaning: see `is_below_full_turn`.
    """
    s = jnp.where(s < _FULL_TURN, s, 0)
    return 2 * reciprocal(_FULL_TURN - s) + polynomial(_constants(s).excess, s)


def is_below_full_turn(s: Float[Array, "*batch"]) -> Bool[Array, ""]:
    """Whether the exponential can be inverted for all angles, whose squares are s.

    That is so below the first pole of the inverse derivative, a full turn. False for NaN.
    """
    return jnp.all(s < _FULL_TURN) if s.ndim else s < _FULL_TURN


class _Constants(NamedTuple):
    """Polynomials that interpolate at Chebyshev nodes, in powers of their variable."""

    sin: Sequence[float]  # sin(sqrt z) / sqrt z for 0 <= z <= 3.1417^2
    versin: Sequence[float]  # (1 - cos(sqrt z)) / z on the same interval
    # `cotangent_excess` without its pole, for 0 <= s <= 4 pi^2.
    excess: Sequence[float]


def _constants(x: Array) -> _Constants:
    return _DOUBLE if x.dtype == jnp.float64 else _SINGLE


def _turns(
    s: Float[Array, "*batch"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """The number of full turns that take `x = sqrt(s)` to an angle in [-pi, pi], and `1 / x`.

    XLA materialises every square root and division, which in a loop of small steps costs more than
    the arithmetic. So 1/x comes from its exponent bits and one polynomial. No branch is needed:
    without a full turn `turns` is exactly 0, and `1 / x` is finite at x = 0 too.
    """
    guess, correction = factors_of_inverse_root(s)
    # Grouped so that the product without the correction does not wait for it.
    turns = jnp.round(((s * (0.5 / pi)) * guess) * correction)
    # A larger angle is accurate to a hundredth of a radian at best.
    limit = 2.0 ** (2 * (jnp.finfo(s.dtype).nmant - 7))
    return turns, jnp.where(s <= limit, guess, jnp.nan) * correction


_DOUBLE = _Constants(
    sin=(
        *(1.0, -0.16666666666666663, 0.008333333333333188),
        *(-0.000198412698412469, 2.7557319222124525e-06, -2.5052108297305365e-08),
        *(1.6059041233543041e-10, -7.647114302277936e-13, 2.8108533080427597e-15),
        *(-8.174655376108592e-18, 1.7577527426101735e-20),
    ),
    versin=(
        *(0.5, -0.041666666666666664, 0.0013888888888888829),
        *(-2.4801587301577676e-05, 2.7557319223205003e-07, -2.0876756950897077e-09),
        *(1.1470744505903215e-11, -4.779456606604926e-14, 1.5616675610328964e-16),
        *(-4.0910585753793584e-19, 8.062113626809763e-22),
    ),
    excess=(
        *(0.03267274151216445, 0.0001056411070533713, 5.637370282477897e-07),
        *(3.3571419523746884e-09, 2.074286428036511e-11, 1.300065473251767e-13),
        *(8.193824256923473e-16, 5.199524766310814e-18, 3.160637725418923e-20),
        *(2.565368035640021e-22, -1.07088013770628e-25, 3.5773832274050867e-26),
        *(-2.7528472959079524e-28, 2.3243625920517675e-30),
    ),
)
_SINGLE = _Constants(
    sin=(
        *(1.0, -0.16666666, 0.008333322, -0.00019840531),
        *(2.7535796e-06, -2.4728324e-08, 1.3611441e-10),
    ),
    versin=(
        *(0.5, -0.041666668, 0.0013888881, -2.480112e-05),
        *(2.7543695e-07, -2.0672082e-09, 9.928024e-12),
    ),
    excess=(
        *(0.03267274, 0.00010564049, 5.63984e-07, 3.3205831e-09),
        *(2.3270427e-11, 4.3504524e-14, 2.160351e-15),
    ),
)
