"""Orders of exponential Runge-Kutta methods, proved in fractions.

The error of a step is a sum over trees (Luan & Ostermann 2014). A leaf of order k is the defect of
a stage's quadrature, `psi_(k,i)(z) = sum_j a_ij(z) c_j^(k-1) / (k-1)! - c_i^k phi_k(c_i z)`. From a
stage j with trees of orders q, q', .. the stage i gets `sum_j a_ij(z) c_j^m tree tree' ..`, a tree
of order 1 + m + q + q' + ... Derivatives of g stand between them, so each function of z has an
argument of its own, and a condition holds if it holds for all arguments.

All functions are combinations of `phi_k(c z)`. They are expanded in one of two ways:

- in `e^(c z) z^(-m)`, which are linearly independent for different c and m, so that a function is
  zero if and only if all its coefficients are;
- in Taylor's series, truncated at some degree.

Source: Luan & Ostermann, Exponential B-series: the stiff case, SIAM J. Numer. Anal. 51 (2013),
doi:10.1137/130920204; Hochbruck & Ostermann, Explicit exponential Runge-Kutta methods for
semilinear parabolic problems, SIAM J. Numer. Anal. 43 (2005), doi:10.1137/040611434.
"""

from collections.abc import Callable, Iterator
from fractions import Fraction as F
from functools import lru_cache
from itertools import combinations_with_replacement, product
from math import factorial
from typing import Any, TypeAlias

from .exponential import Combination, ExponentialTableau

# A function of several arguments: the coefficient of each product of basis functions of them.
Function: TypeAlias = dict[tuple[Any, ...], F]
# A leaf of order k is (k, ()), and (m, children) is c^m times its children.
Tree: TypeAlias = tuple[int, tuple[Any, ...]]
# The expansion of a combination of phi functions.
Expansion: TypeAlias = Callable[[Combination], Function]

# No method needs the conditions of a higher order, which take long.
_MAX_ORDER = 6


def stiff_order(tableau: ExponentialTableau) -> int:
    """The stiff order of an exponential Runge-Kutta method: that for any stiff linear part.

    With a stiff order p the error is of order p at steps of any length, by a constant that does not
    depend on the linear part, at boundaries too where g does not vanish. (The conditions of orders
    below p hold for all arguments, those of order p with the argument of b zero, as usual.)

    **Raises:** `TypeError` if `tableau` is not a `cfjax.ExponentialTableau`.

    Source: Luan & Ostermann, Exponential B-series: the stiff case, SIAM J. Numer. Anal. 51 (2013),
    doi:10.1137/130920204.
    """
    if not isinstance(tableau, ExponentialTableau):
        raise TypeError(
            f"stiff_order: tableau must be a cfjax.ExponentialTableau, got {tableau!r}."
        )
    return _stiff_order(tableau)


# The type is checked before: other objects, such as a `diffrax.ButcherTableau`, may have no hash.
@lru_cache
def _stiff_order(tableau: ExponentialTableau) -> int:
    def holds(p: int) -> bool:
        below = (_conditions(tableau, q, _exact, _exact) for q in range(2, p))
        return all(map(_is_zero, below)) and _is_zero(_conditions(tableau, p, _exact, _at_zero))

    return _largest(holds)


@lru_cache
def classical_order(tableau: ExponentialTableau) -> int:
    """The order for steps that are short for the linear part too, which is `cfjax.order`."""

    def holds(p: int) -> bool:
        # Each argument is of the order of the step.
        return all(
            _is_zero(_conditions(tableau, q, *[_taylor(p - q)] * 2), p - q) for q in range(2, p + 1)
        )

    return _largest(holds)


def _largest(holds: Callable[[int], bool]) -> int:
    p = 1
    while p < _MAX_ORDER and holds(p + 1):
        p += 1
    return p


def _is_zero(conditions: Iterator[Function], degree: int | None = None) -> bool:
    return all(
        value == 0
        for condition in conditions
        for key, value in condition.items()
        if degree is None or sum(key) <= degree
    )


def _conditions(
    tableau: ExponentialTableau, p: int, inner: Expansion, outer: Expansion
) -> Iterator[Function]:
    """The functions that must be zero for order p. `outer` expands b, and `inner` all else."""
    a = [[(j, inner(terms)) for j, terms in columns] for columns in tableau.a]
    b = [(j, outer(terms)) for j, terms in tableau.b]

    # The first column never counts: its node is zero, and its stage exact.
    def tree_function(columns: Any, c: F, expand: Expansion, tree: Tree) -> Function:
        k, children = tree
        total = {} if children else expand(((k, c, -(c**k)),) if c else ())
        for j, function in columns:
            node = tableau.c[j - 1]
            term = _times(function, node**k if children else node ** (k - 1) / factorial(k - 1))
            for child in children:
                term = _product(term, stage_function(j, child))
            total = _sum(total, term)
        return total

    @lru_cache
    def stage_function(i: int, tree: Tree) -> Function:
        return tree_function(a[i - 1], tableau.c[i - 1], inner, tree)

    return (tree_function(b, F(1), outer, tree) for tree in _trees(p))


@lru_cache
def _trees(order: int) -> tuple[Tree, ...]:
    result: list[Tree] = [(order, ())]
    for size in range(1, order):
        for orders in combinations_with_replacement(range(2, order), size):
            m = order - 1 - sum(orders)
            if m >= 0:
                forests = {tuple(sorted(trees)) for trees in product(*map(_trees, orders))}
                result += [(m, forest) for forest in sorted(forests)]
    return tuple(result)


def _exact(terms: Combination) -> Function:
    """The coefficients of `e^(c z) z^(-m)`, with the key (c, m)."""
    total: Function = {}
    for k, c, weight in terms:
        if c == 0:
            term = {((F(0), 0),): weight / factorial(k)}
        else:
            term = {((F(0), k - j),): -weight / (c ** (k - j) * factorial(j)) for j in range(k)}
            term[((c, k),)] = weight / c**k
        total = _sum(total, term)
    return total


def _at_zero(terms: Combination) -> Function:
    return {(): sum((weight / factorial(k) for k, _, weight in terms), F(0))}


def _taylor(degree: int) -> Expansion:
    """The coefficients of powers of z, up to a degree. The key is the power."""
    return lambda terms: {
        (m,): sum((weight * c**m / factorial(m + k) for k, c, weight in terms), F(0))
        for m in range(degree + 1)
    }


def _times(function: Function, factor: F) -> Function:
    return {key: factor * value for key, value in function.items()}


def _sum(a: Function, b: Function) -> Function:
    total = dict(a)
    for key, value in b.items():
        total[key] = total.get(key, F(0)) + value
    return {key: value for key, value in total.items() if value}


def _product(a: Function, b: Function) -> Function:
    return {x + y: v * w for x, v in a.items() for y, w in b.items()}
