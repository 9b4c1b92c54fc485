"""The bounds of Taylor polynomials, and the tails of Chebyshev series."""

import math
from typing import Any

import mpmath as mp
import pytest

from cfjax._numerics.expm_series import TAYLOR_THETA, chebyshev_of_exp_minus_one

UNIT = {"float32": 2.0**-24, "float64": 2.0**-53}


@pytest.mark.parametrize("precision", UNIT)
def test_the_bounds_are_where_the_backward_error_reaches_the_unit_roundoff(precision):
    """With `log(exp(-x) T(x)) = sum_k c_k x^k` it is `sum_k |c_k| theta^(k-1)`."""
    for degree, theta in TAYLOR_THETA[precision].items():
        length = degree + 20  # Beyond, less than 1e-12 of the first term.
        with mp.workdps(40):
            one = [mp.mpf(1) / math.factorial(k) for k in range(length)]
            # exp(-x) T(x) = 1 - exp(-x) (the rest of the series).
            q = [
                -sum(one[i] * (-1) ** (k - i) * one[k - i] for i in range(degree + 1, k + 1))
                for k in range(length)
            ]
            c = [mp.mpf(0)] * length
            for k in range(degree + 1, length):
                c[k] = q[k] - sum(i * c[i] * q[k - i] for i in range(degree + 1, k)) / k

        def backward(x, c=c):
            return sum(abs(float(a)) * x ** (k - 1) for k, a in enumerate(c) if a)

        assert backward(theta) <= UNIT[precision] < backward(theta * 1.004)


def test_the_tail_of_a_chebyshev_series():
    """Where `R_k` is at most `growth^k` it is below the tolerance, and no shorter series is so."""
    length, tolerance = 6.0, 1e-13
    for growth in (1.0, 1.7):
        found = chebyshev_of_exp_minus_one(length, tolerance, growth)
        with mp.workdps(40):
            numbers: list[Any] = [2 * mp.besselj(k, length) for k in range(120)]
            sizes: list[Any] = [abs(c) * mp.mpf(growth) ** k for k, c in enumerate(numbers)]
            tail: list[Any] = [mp.fsum(sizes[n:]) for n in (len(found), len(found) - 1)]
            assert tail[0] <= tolerance < tail[1]
            numbers[0] = numbers[0] / 2 - 1
            assert all(abs(c - a) < 1e-16 for c, a in zip(found, numbers, strict=False))
