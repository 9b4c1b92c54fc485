"""Tableaus of exponential Runge-Kutta methods: coefficients are combinations of phi functions."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction as F
from functools import cached_property
from math import factorial, prod
from numbers import Rational
from typing import Any

# `sum_i weight_i phi_(k_i)(c_i z)`, with terms (k, c, weight).
Combination = tuple[tuple[int, F, F], ...]
# The combination of each column j. The first column follows from the others.
Columns = tuple[tuple[int, Combination], ...]

_MAX_PHI = 5


@dataclass(frozen=True, init=False)
class ExponentialTableau:
    """Coefficients of an explicit exponential Runge-Kutta method with `s` stages.

    For `x' = L x + g(t, x)` and `z = h L`, counting stages from 1, a step from `u` is

        U_i = e^(c_i z) u + h sum_(j < i) a_ij(z) g(t + c_j h, U_j),  i = 1..s,
        u_1 = e^z u + h sum_j b_j(z) g(t + c_j h, U_j).

    Every coefficient is a combination of functions `phi_k(c z)`, in which
    `phi_k(z) = sum_j z^j / (j + k)!`. The first column is not an argument: it makes each row sum
    `c_i phi_1(c_i z)` and that of b `phi_1(z)`, so that a constant g is integrated exactly.

    **Arguments:**

    - `c`: the nodes, the first of which is 0. int or `Fraction`.
    - `a`: for each stage i with coefficients beyond the first column a dict from j to the
      coefficient `a_ij`. This is a dict from k, for `phi_k(c_i z)`, or from a pair (k, c), for
      `phi_k(c z)`, to its weight.
    - `b`: the same for the end, a dict from j, where all functions are `phi_k(z)` with k from 2.
      Output within a step is the flow along the same polynomial in time.
    - `error`: the estimate of the error, in the form of `b`. It may also have column s + 1, the
      field at the end of the step, with which the next step begins (first same as last).

    A tableau is compared and hashed by value, so it can be static in a jitted function.

    **Raises:** `TypeError` where a number is not an int or a `Fraction`, `ValueError` where the
    method is implicit, or a function is not one of `phi_1` to `phi_5`.
    """

    c: tuple[F, ...]
    a: tuple[Columns, ...]
    b: Columns
    error: Columns | None

    def __init__(
        self,
        c: Iterable[Any],
        a: Mapping[int, Mapping[int, Mapping[Any, Any]]],
        b: Mapping[int, Mapping[Any, Any]],
        error: Mapping[int, Mapping[Any, Any]] | None = None,
    ) -> None:
        nodes = tuple(_rational(f"c[{i}]", x) for i, x in enumerate(c, 1))
        s = len(nodes)
        if not nodes or nodes[0] != 0:
            raise ValueError(f"c must begin with the node 0, got {[*map(str, nodes)]}.")
        out_of_range = [i for i in a if not 1 < i <= s]
        if out_of_range:
            raise ValueError(f"a must have rows of stages 2 to {s}, got row {out_of_range[0]}.")
        rows = tuple(
            _columns(f"a[{i}]", a.get(i, {}), nodes[i - 1], i - 1) for i in range(1, s + 1)
        )
        weights = _columns("b", b, F(1), s)
        if any(k < 2 or x != 1 for _, terms in weights for k, x, _ in terms):
            raise ValueError("b must be made only of phi_2(z) to phi_5(z) beyond column 1.")
        estimate = None if error is None else _columns("error", error, F(1), s + 1)
        for name, value in dict(c=nodes, a=rows, b=weights, error=estimate).items():
            # The only way to set a field of a frozen dataclass; it is never changed after this.
            object.__setattr__(self, name, value)

    def __hash__(self) -> int:
        return self._hash

    # Cached as that of a `Tableau`.
    @cached_property
    def _hash(self) -> int:
        return hash((self.c, self.a, self.b))

    @property
    def num_stages(self) -> int:
        return len(self.c)

    @property
    def num_evaluations(self) -> int:
        """Evaluations of the field in a step. The one at the end is the first of the next step."""
        return self.num_stages

    @property
    def uses_last(self) -> bool:
        """Whether the estimate uses the field at the end of the step."""
        return any(j > self.num_stages for j, _ in self.error or ())

    @cached_property
    def embedded_method(self) -> "ExponentialTableau | None":
        """The embedded method as a method of its own, whose last stage is the end of the step."""
        if self.error is None:
            return None
        rows = {
            i: {j: {(k, c): w for k, c, w in terms} for j, terms in columns}
            for i, columns in enumerate((*self.a, self.b), 1)
            if columns
        }
        weights = {j: {k: w for k, _, w in terms} for j, terms in self.b}
        for j, terms in self.error:
            column = weights.setdefault(j, {})
            for k, _, w in terms:
                column[k] = column.get(k, F(0)) - w
        return ExponentialTableau((*self.c, 1), rows, weights)

    @cached_property
    def powers(self) -> tuple[tuple[tuple[int, F], ...], ...]:
        """For the powers s, s^2, ... of the polynomial in time that the end is the flow of, the
        weight of each stage j in its coefficient, as pairs (j, weight).
        """
        # The flow of s^m is m! phi_(m+1).
        max_phi = max((k for _, terms in self.b for k, _, _ in terms), default=1)
        return tuple(
            tuple((j, w / factorial(k - 1)) for j, terms in self.b for n, _, w in terms if n == k)
            for k in range(2, max_phi + 1)
        )


def _columns(name: str, columns: Mapping[int, Any], c: F, last_column: int) -> Columns:
    result = []
    for j, terms in sorted(columns.items()):
        if not 2 <= j <= last_column:
            raise ValueError(f"{name} must have columns 2 to {last_column}, got column {j}.")
        result.append((j, _combination(f"{name}[{j}]", terms, c)))
    return tuple(result)


def _combination(name: str, terms: Mapping[Any, Any], c: F) -> Combination:
    result = []
    for key, weight in terms.items():
        k, node = key if isinstance(key, tuple) else (key, c)
        if not isinstance(k, int) or not 1 <= k <= _MAX_PHI:
            raise ValueError(f"{name} must be made of phi_1 to phi_{_MAX_PHI}, got phi_{k}.")
        result.append((k, _rational(f"{name}[{key}]", node), _rational(f"{name}[{key}]", weight)))
    return tuple(result)


def _rational(name: str, value: Any) -> F:
    if isinstance(value, bool) or not isinstance(value, Rational):
        raise TypeError(f"{name} must be an int or a Fraction, got {value!r}.")
    return F(value)


def _divided_difference(nodes: Mapping[int, F], factor: Mapping[int, F]) -> dict[int, dict[int, F]]:
    """The function `factor` of z times the divided difference of g on the nodes of some stages.

    It is the difference of the flows of two interpolants of g that have all but one node in common.
    """
    weights = {j: F(1, 1) / prod(x - y for y in nodes.values() if y != x) for j, x in nodes.items()}
    return {j: {k: w * b for k, b in factor.items()} for j, w in weights.items() if j != 1}


_HALF = F(1, 2)

# Cox & Matthews (2002).
ETDRK4 = ExponentialTableau(
    c=[0, _HALF, _HALF, 1],
    a={3: {2: {1: _HALF}}, 4: {3: {(1, _HALF): 1}}},
    b={2: {2: 2, 3: -4}, 3: {2: 2, 3: -4}, 4: {2: -1, 3: 4}},
)

# A member of a family of 5 stages with free nodes c2, c3 and c4. The end is the flow of a parabola
# through stages 1, 4 and 5, and the embedded method that of one through stages 1, 4 and the end.
ETD43 = ExponentialTableau(
    c=[0, F(1, 5), F(7, 32), F(2, 5), F(7, 8)],
    a={
        3: {2: {2: F(245, 1024)}},
        4: {3: {2: F(128, 175)}},
        5: {
            3: {
                2: F(224, 29),
                3: F(-980, 29),
                (2, F(2, 5)): F(175, 116),
                (3, F(2, 5)): F(-160, 29),
            },
            4: {
                2: F(-8575, 3712),
                3: F(8575, 464),
                (2, F(2, 5)): F(-6125, 7424),
                (3, F(2, 5)): F(175, 58),
            },
        },
    },
    b={4: {2: F(175, 38), 3: F(-200, 19)}, 5: {2: F(-128, 133), 3: F(640, 133)}},
    error=_divided_difference(
        {1: F(0), 4: F(2, 5), 5: F(7, 8), 6: F(1)}, {2: F(1, 20), 3: F(-1, 4)}
    ),
)

# A member of a family of 8 stages with free nodes c2 to c6 and c8. The end is the flow of a cubic
# through stages 1, 6, 7 and 8, and the embedded method that of one through stages 1, 5, 6 and 8.
# All nodes are doublings of 1/8 and of 7/10, so two arguments give all functions of a matrix.
_QUARTER, _LATE = F(1, 4), F(7, 10)
ETD54 = ExponentialTableau(
    c=[0, F(1, 8), _LATE, F(1, 8), _HALF, _QUARTER, _LATE, 1],
    a={
        3: {2: {2: F(98, 25)}},
        4: {3: {2: F(5, 224)}},
        5: {
            3: {2: F(-25, 322), 3: F(100, 161)},
            4: {2: F(56, 23), 3: F(-80, 23)},
        },
        6: {
            4: {2: F(2, 3), 3: F(-2, 3)},
            5: {2: F(-1, 24), 3: F(1, 6)},
        },
        7: {
            4: {(2, _QUARTER): F(-224, 375), (3, _QUARTER): F(224, 375)},
            5: {
                2: F(-49, 50),
                3: F(686, 125),
                (2, _QUARTER): F(-28, 375),
                (3, _QUARTER): F(28, 375),
            },
            6: {
                2: F(98, 25),
                3: F(-1372, 125),
                (2, _QUARTER): F(56, 125),
                (3, _QUARTER): F(-56, 125),
            },
        },
        8: {
            5: {
                2: -7,
                3: 76,
                4: -240,
                (2, _QUARTER): F(-4, 3),
                (3, _QUARTER): 4,
                (4, _QUARTER): -4,
                (2, _LATE): F(-35, 3),
                (3, _LATE): 98,
                (4, _LATE): F(-1372, 5),
            },
            6: {
                2: F(112, 9),
                3: F(-256, 3),
                4: F(640, 3),
                (2, _QUARTER): F(32, 27),
                (3, _QUARTER): F(-32, 9),
                (4, _QUARTER): F(32, 9),
                (2, _LATE): F(280, 27),
                (3, _LATE): F(-784, 9),
                (4, _LATE): F(10976, 45),
            },
            7: {
                2: F(125, 63),
                3: F(-500, 21),
                4: F(2000, 21),
                (2, _QUARTER): F(100, 189),
                (3, _QUARTER): F(-100, 63),
                (4, _QUARTER): F(100, 63),
                (2, _LATE): F(125, 27),
                (3, _LATE): F(-350, 9),
                (4, _LATE): F(980, 9),
            },
        },
    },
    b={
        6: {2: F(224, 27), 3: F(-1088, 27), 4: F(640, 9)},
        7: {2: F(-500, 189), 3: F(5000, 189), 4: F(-4000, 63)},
        8: {2: F(7, 9), 3: F(-76, 9), 4: F(80, 3)},
    },
    error=_divided_difference(
        {1: F(0), 6: _QUARTER, 5: _HALF, 7: _LATE, 8: F(1)},
        {2: F(1, 20), 3: F(-1, 2), 4: F(6, 5)},
    ),
)
