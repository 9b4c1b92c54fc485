"""The order of a tableau, decided by its order conditions.

The solution of a Lie group method is a sum over products of frozen fields and their derivatives,
and an ordered rooted tree stands for one such derivative. Fields do not commute, so the
order of the factors counts:

- a *letter* is an ordered rooted tree. It stands for one factor;
- a *word* is a finite sequence of letters, the first applied first. It stands for one product;
- a *forest* is a tree without its root: the sequence of its children's trees. So a forest is a
  word as well, and determines its tree.

Here both are nested tuples: a word is the tuple of its letters, and a letter is the tuple of its
forest's. `()` is the empty word, and as a letter the single node. A letter's order, its number of
nodes, is one more than that of its forest; a word's order is the sum over its letters. A
commutator-free method has order q when every word up to order q has the weight that it has in the
exact solution: Owren, J. Phys. A 39 (2006), doi:10.1088/0305-4470/39/19/S07.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from functools import cache, cached_property, lru_cache
from typing import Any, TypeAlias

import numpy as np

from .coefficients import Product, Row, uncertainty
from .tableau import Tableau


class _Rounded:
    """A number that is computed from rounded coefficients.

    `value` is exact for the rounded coefficients: no rounding happens here. Entry i of `change` is
    how much the number changes to first order when float coefficient i moves by its `uncertainty`.
    """

    def __init__(self, value: Fraction, change: np.ndarray) -> None:
        self.value = value
        self.change = change

    @cached_property
    def _float(self) -> float:
        return float(self.value)

    def __add__(self, other: "_Rounded | Fraction") -> "_Rounded":
        if isinstance(other, Fraction):
            return _Rounded(self.value + other, self.change)
        return _Rounded(self.value + other.value, self.change + other.change)

    def __mul__(self, other: "_Rounded | Fraction") -> "_Rounded":
        if isinstance(other, Fraction):
            return _Rounded(self.value * other, self.change * float(other))
        change = other._float * self.change + self._float * other.change
        return _Rounded(self.value * other.value, change)

    def __truediv__(self, other: int) -> "_Rounded":
        return _Rounded(self.value / other, self.change / other)

    __radd__ = __add__
    __rmul__ = __mul__


# A tuple of words. Written without recursion, which run-time type checkers cannot follow.
Word: TypeAlias = tuple[Any, ...]
# A Fraction, a _Rounded, or a float where nothing is to be proved.
Number: TypeAlias = Any
Weights: TypeAlias = dict[Word, Number]
# The defect of each weight of one order, and its tolerance.
Defects: TypeAlias = list[tuple[Fraction, float]]


def order(tableau: Any) -> int:
    """The order of a commutator-free method, at least 1 as every tableau is consistent.

    The order of an exponential Runge-Kutta method is the classical one, for steps that are short
    for the linear part too; `cfjax.stiff_order` is the order for long ones.

    For exact tableaus the result is exact. Floats are taken as rounded coefficients, and the result
    is the order that the unrounded method may have; see `_defects`.

    **Raises:** `TypeError` if `tableau` is neither a `Tableau` nor an `ExponentialTableau`.
    """
    if not isinstance(tableau, Tableau):
        # Not at the top: an import of cfjax makes few of the methods.
        from .exponential import ExponentialTableau
        from .stiff_order import classical_order

        if isinstance(tableau, ExponentialTableau):
            return classical_order(tableau)
        raise TypeError(f"order: tableau must be a cfjax.Tableau, got {tableau!r}.")
    return _order(tableau)


# The type is checked before: other objects, such as a `diffrax.ButcherTableau`, may have no hash.
@lru_cache
def _order(tableau: Tableau) -> int:
    return _largest_order(_defects(_end_weights(tableau), exact_weight), tableau)


def error_constant(tableau: Tableau) -> float:
    """The size of the leading error term of a `tableau`.

    For a method of order q it is the 2-norm of the residuals of all order conditions of order
    q + 1.

    **Raises:** `TypeError` if `tableau` is not a `Tableau`.
    """
    if not isinstance(tableau, Tableau):
        raise TypeError(f"error_constant: tableau must be a cfjax.Tableau, got {tableau!r}.")
    return _error_constant(tableau)


@lru_cache
def _error_constant(tableau: Tableau) -> float:
    defects = _defects(_end_weights(tableau), exact_weight)
    for _ in range(_order(tableau)):
        next(defects)
    return math.hypot(*(float(defect) for defect, _ in next(defects)))


def runge_kutta_order(a: Iterable[Iterable[Any]], b: Iterable[Any]) -> int:
    """The classical order of an explicit Runge-Kutta method, which it has in a linear space.

    `a` holds the rows of the stages after the first, `a[i]` with the coefficients of stages
    0..i; `b` holds one weight for each stage. These are `a_lower` and `b_sol` of a
    `diffrax.ButcherTableau`. Floats are treated as in `order`.

    **Raises:** as `Tableau`, naming `alpha` for `a` and `beta` for `b`.

    Source: Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, theorem II.2.13.
    """
    return _runge_kutta_order(Tableau([[], *([row] for row in a)], [b]))


@lru_cache
def _runge_kutta_order(tableau: Tableau) -> int:
    return _largest_order(_defects(_tree_weights(tableau), exact_tree_weight), tableau)


def _largest_order(defects: Iterator[Defects], tableau: Tableau) -> int:
    # An explicit method with s stages has at most order s, so the search ends.
    for q in range(tableau.num_stages):
        # Not `any(... > ...)`: an overflow gives the tolerance nan, which must not be accepted.
        if not all(abs(defect) <= tolerance for defect, tolerance in next(defects)):
            return q
    return tableau.num_stages


def _defects(orders: Iterator[Weights], exact: Callable[[Word], Fraction]) -> Iterator[Defects]:
    """The defects and their tolerances, order by order from 1.

    Weights have no rounding errors of their own, so a tolerance has to cover only that of the
    coefficients: to first order, the sum of the changes that each of them can make. It is zero
    where they are fractions.
    """
    # Simpler would be to bound the weight by the same sums of absolute values. But where large
    # coefficients cancel that is useless: 0.02 for Dopri8, whose defects are below 3e-16.
    for weights in orders:
        yield [
            (weight.value - exact(word), float(np.abs(weight.change).sum()))
            if isinstance(weight, _Rounded)
            else (weight - exact(word), 0.0)
            for word, weight in weights.items()
        ]


@cache
def words(n: int) -> tuple[Word, ...]:
    """All words of order n: 1, 1, 2, 5, 14, 42, 132 from n = 0."""
    if n == 0:
        return ((),)
    return tuple(
        (tree, *suffix)
        for size in range(1, n + 1)
        for tree in words(size - 1)
        for suffix in words(n - size)
    )


@cache
def trees(n: int) -> tuple[Word, ...]:
    """All rooted trees of order n, children in any order: 1, 1, 2, 4, 9, 20, 48 from n = 1."""
    return tuple(dict.fromkeys(map(_sorted, words(n - 1))))


@cache
def _sorted(tree: Word) -> Word:
    return tuple(sorted(map(_sorted, tree)))


@cache
def _order_of(word: Word) -> int:
    return sum(1 + _order_of(tree) for tree in word)


@cache
def exact_weight(word: Word) -> Fraction:
    """The weight of a word in the exact solution."""
    if not word:
        return Fraction(1)
    return exact_weight(word[:-1]) * exact_weight(word[-1]) / _order_of(word)


@cache
def exact_tree_weight(tree: Word) -> Fraction:
    """The weight of a tree in the exact solution in a linear space, one over its density."""
    return math.prod(map(exact_tree_weight, tree), start=Fraction(1, 1 + _order_of(tree)))


def _end_weights(tableau: Tableau) -> Iterator[Weights]:
    """The weights of all words at the end point, order by order from 1."""
    rows = _nonzero([prefix[-1] for prefix in tableau.prefixes])
    for n, (_, end_weights) in enumerate(word_weights(tableau, rows), 1):
        yield {word: end_weights[word] for word in words(n)}


def word_weights(
    tableau: Tableau, rows: Iterable[Iterable[tuple[int, Any]]]
) -> Iterator[tuple[list[Weights], Weights]]:
    """The weights of all words at each stage and at the end point, up to order 1, 2, and so on.

    `rows` holds the last row of each of the tableau's prefixes, as its nonzero coefficients with
    their stages, in the arithmetic that is wanted.
    """
    # At each point of the step, by the flows that lead there. Before the first flow only the empty
    # word has a weight. Zeros are left out.
    points: dict[Product, Weights] = {(): {(): Fraction(1)}}
    flows = []
    for prefix, row in zip(tableau.prefixes, rows, strict=True):
        before, after = points[prefix[:-1]], points.setdefault(prefix, {(): Fraction(1)})
        flow_weights: Weights = {(): Fraction(1)}
        letters: Weights = {}
        flows.append((row, before, after, flow_weights, letters))
    stages = [points[product] for product in tableau.alpha]
    end_weights = points[tableau.beta]
    n = 0
    while True:
        n += 1
        for row, before, after, flow_weights, letters in flows:
            for tree in words(n - 1):
                letters[tree] = _sum(a * stages[k][tree] for k, a in row if tree in stages[k])
            for word in words(n):
                # The flow alone: 1/m! times the product over the word's m letters.
                flow_weights[word] = flow_weights[word[:-1]] * letters[word[-1]] / len(word)
            for word in words(n):
                splits = ((word[:i], word[i:]) for i in range(len(word) + 1))
                after[word] = _sum(before[u] * flow_weights[v] for u, v in splits if u in before)
        yield stages, end_weights


def _tree_weights(tableau: Tableau) -> Iterator[Weights]:
    """The weights of all trees at the end point, order by order from 1, in a linear space.

    There flows add up. For brevity each point must have at most one.
    """
    products = (*tableau.alpha, tableau.beta)
    *rows, end_row = _nonzero([row[0] if row else () for row in products])
    # At each stage: the weight of a tree, and the product of the weights of its root's children.
    tree_weights: list[Weights] = [{} for _ in rows]
    branch_products: list[Weights] = [{} for _ in rows]
    n = 0
    while True:
        n += 1
        for tree in trees(n):
            for weights, products in zip(tree_weights, branch_products, strict=True):
                products[tree] = products[tree[:-1]] * weights[tree[-1]] if tree else Fraction(1)
        yield {tree: _sum(a * branch_products[k][tree] for k, a in end_row) for tree in trees(n)}
        # Only for the next order, and the most work of all.
        for tree in trees(n):
            for row, weights in zip(rows, tree_weights, strict=True):
                weights[tree] = _sum(a * branch_products[k][tree] for k, a in row)


def _nonzero(rows: Sequence[Row]) -> list[list[tuple[int, Number]]]:
    """Each row's nonzero coefficients with their stages. Every float can change on its own."""
    num_floats = sum(isinstance(a, float) for row in rows for a in row)
    directions = iter(np.eye(num_floats))

    def number(a: Fraction | float) -> Number:
        if isinstance(a, Fraction):
            return a
        return _Rounded(Fraction(a), float(uncertainty(a)) * next(directions))

    return [[(k, number(a)) for k, a in enumerate(row) if a] for row in rows]


def _sum(terms: Iterable[Number]) -> Number:
    return sum(terms, Fraction(0))
