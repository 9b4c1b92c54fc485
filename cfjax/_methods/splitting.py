"""Coefficients of splitting methods, and their order.

A method is a list of numbers s1, s2, ...: with X = exp(1) exp(2) .. exp(N) for the terms 1 to N and
X* its mirror image, a step is X(s1 h) X*(s2 h) X(s3 h) ..., and neighbours of one term merge. Its
order for two terms is its order for any number (McLachlan, SIAM J. Sci. Comput. 16 (1995)).
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate, chain, product
from math import factorial

# Rounding of coefficients with 15 digits, in sums of some hundred products.
_TOLERANCE = 1e-12
_MAX_ORDER = 8


def stages(a: Sequence[float], b: Sequence[float]) -> tuple[float, ...]:
    """The numbers of the symmetric method exp(a1 A) exp(b1 B) exp(a2 A) .. of two terms.

    `a` and `b` are its first halves without the entries in the middle, as each must sum to 1.
    """
    b = [*b, 0.5 - sum(b)]
    a = [*a, 1 - 2 * sum(a), *reversed(a)]
    b = [*b, *reversed(b)]
    in_turn = chain.from_iterable(zip(a, b, strict=False))
    return tuple(accumulate(in_turn, lambda s, x: x - s))


STRANG = (0.5, 0.5)

# Blanes & Moan, J. Comput. Appl. Math. 142 (2002), doi:10.1016/S0377-0427(01)00492-7, Table 2: S6
# and S10.
BLANES_MOAN_4 = stages(
    (0.0792036964311957, 0.353172906049774, -0.0420650803577195),
    (0.209515106613362, -0.143851773179818),
)
BLANES_MOAN_6 = stages(
    (
        0.0502627644003922,
        0.413514300428344,
        0.0450798897943977,
        -0.188054853819569,
        0.541960678450780,
    ),
    (0.148816447901042, -0.132385865767784, 0.067307604692185, 0.432666402578175),
)


def _palindrome(*first_half: float) -> tuple[float, ...]:
    """A symmetric composition with sum 1, from the first half without the middle."""
    return (*first_half, 1 - 2 * sum(first_half), *reversed(first_half))


# Parts of a step, by the order of the composition of a symmetric method of order 2: Suzuki, Phys.
# Lett. A 146 (1990), doi:10.1016/0375-9601(90)90962-N; Sofroniou & Spaletta, Optim. Methods Softw.
# 20 (2005), doi:10.1080/10556780500140664; Kahan & Li, Math. Comp. 66 (1997),
# doi:10.1090/S0025-5718-97-00873-9.
COMPOSITIONS = {
    4: _palindrome(*[1 / (4 - 4 ** (1 / 3))] * 2),
    6: _palindrome(
        0.21375583945878254555518066964857,
        0.18329381407425713911385974425217,
        0.17692819473098943794898811709929,
        -0.44329082681170215849622829626258,
        0.11728560432865935385403585669136,
    ),
    8: _palindrome(
        0.13020248308889008088,
        0.56116298177510838456,
        -0.38947496264484728641,
        0.15884190655515560090,
        -0.39590389413323757734,
        0.18453964097831570709,
        0.25837438768632204729,
        0.29501172360931029887,
    ),
}


@lru_cache
def splitting_order(stages: Sequence[float]) -> int:
    """The order of a splitting method, of which all words in two letters are compared.

    The product of the exponentials and the exponential of the sum are series in words; the method
    has order p if they agree in all words of up to p letters.
    """
    series = {"": 1.0}
    for k, s in enumerate(stages):
        for letter in "AB" if k % 2 == 0 else "BA":
            series = _times_exponential(series, letter, s)
    for n in range(1, _MAX_ORDER + 1):
        words = map("".join, product("AB", repeat=n))
        if any(abs(series.get(w, 0.0) - 1 / factorial(n)) > _TOLERANCE for w in words):
            return n - 1
    return _MAX_ORDER


def _times_exponential(series: dict[str, float], letter: str, s: float) -> dict[str, float]:
    result: dict[str, float] = {}
    for word, x in series.items():
        for n in range(_MAX_ORDER - len(word) + 1):
            extended = word + n * letter
            result[extended] = result.get(extended, 0.0) + x * s**n / factorial(n)
    return result
