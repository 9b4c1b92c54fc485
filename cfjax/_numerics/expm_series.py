"""Taylor and Chebyshev polynomials that equal exp up to rounding.

On the interval from -iL to iL a Chebyshev series is `c_0 / 2 + sum_k c_k R_k(z)`, where
`R_k(z) = i^k T_k(-i z / L)`, so `R_0 = 1`, `R_1 = z / L` and `R_(k+1) = 2 z / L R_k + R_(k-1)`.
"""

from decimal import Context, Decimal, localcontext

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Real

# For each degree the largest norm for which the Taylor polynomial has a backward error below half a
# unit in the last place; up to where the terms grow and cancel. As in Table 3.1 of Al-Mohy &
# Higham; tests/numerics/test_expm_series.py derives them.
TAYLOR_THETA = {
    "float32": {
        **{3: 0.01123, 4: 0.05116, 5: 0.1308, 6: 0.2495, 7: 0.4014, 8: 0.58, 9: 0.7795},
        **{10: 0.9951, 11: 1.223, 12: 1.461, 13: 1.707, 14: 1.959, 15: 2.217},
    },
    "float64": {
        **{5: 0.0024, 6: 0.009065, 7: 0.02384, 8: 0.04991, 9: 0.08957, 10: 0.1441, 11: 0.2142},
        **{12: 0.2996, 13: 0.3997, 14: 0.5139, 15: 0.641, 16: 0.7802, 17: 0.9305, 18: 1.09},
        **{19: 1.26, 20: 1.438, 21: 1.623, 22: 1.816, 23: 2.014, 24: 2.219, 25: 2.428},
    },
}
# `J_0(L) - 1` cancels, and the result is rounded to float64.
_DECIMALS = Context(prec=40)


def taylor_degree(precision: str, norm: float) -> int:
    """The least degree that is enough for a norm."""
    return next(degree for degree, theta in TAYLOR_THETA[precision].items() if norm <= theta)


def row_for(norm: Real[Array, ""], largest: np.ndarray) -> Int[Array, ""]:
    """The row of a table for a norm: the first with `norm <= largest[row]`, otherwise the last."""
    return jnp.sum(norm > largest[:-1].astype(norm.dtype))


def chebyshev_of_exp_minus_one(length: float, tolerance: float, growth: float = 1.0) -> list[float]:
    """`c_0 / 2, c_1, c_2, ..` of `exp(z) - 1`, without a tail that adds up to the tolerance.

    `R_k` is at most `growth^k`: by default on the interval itself.
    """
    with localcontext(_DECIMALS):
        first, *others = _chebyshev_of_exp(Decimal(length))
        coefficients = [first / 2 - 1, *others]
        tail, growth_ = Decimal(0), Decimal(growth)
        while True:
            last = abs(coefficients[-1]) * growth_ ** (len(coefficients) - 1)
            if tail + last > tolerance:
                return [float(c) for c in coefficients]
            tail += last
            coefficients.pop()


def powers_of_phi_2(length: float, degree: int) -> list[float]:
    """The truncated series of `(exp(z) - 1 - z) / z^2`, as coefficients of powers of z."""
    with localcontext(_DECIMALS):
        x = Decimal(length)
        series = _divided_by_z(_divided_by_z(_chebyshev_of_exp(x), x), x)
        basis = np.full((degree + 1, degree + 1), Decimal(0))
        basis[0, 0], basis[1, 1] = Decimal(1), 1 / x
        for k in range(2, degree + 1):
            basis[k] = basis[k - 2]
            basis[k, 1:] += 2 / x * basis[k - 1, :-1]
        return [float(p) for p in [series[0] / 2, *series[1 : degree + 1]] @ basis]


def _chebyshev_of_exp(length: Decimal) -> list[Decimal]:
    """Twice the Bessel numbers: `exp(z) = J_0(L) + 2 sum_k J_k(L) R_k(z)`."""
    # By the recurrence backwards, from where they are far below the last digit (Miller).
    bessel = [Decimal(0), Decimal(1)]
    for k in range(40 + 2 * int(length), 0, -1):
        bessel.append(2 * k / length * bessel[-1] - bessel[-2])
    bessel.reverse()
    one = bessel[0] + 2 * sum(bessel[2::2])
    return [2 * j / one for j in bessel]


def _divided_by_z(series: list[Decimal], length: Decimal) -> list[Decimal]:
    """The series of `(f(z) - f(0)) / z`, as `z R_k = L / 2 (R_(k+1) - R_(k-1))`."""
    quotient = [Decimal(0), Decimal(0)]
    for c in reversed(series[1:]):
        quotient.insert(0, 2 / length * c + quotient[1])
    return quotient
