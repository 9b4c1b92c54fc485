"""Output within the steps of any method: coefficients that the order conditions decide.

Those of the named methods are stored, as the last digits of what is derived depend on the machine
and its number of threads. `python tests/methods/derive.py` writes them.
"""

import json
from collections.abc import Iterator
from functools import cache, lru_cache
from hashlib import sha256
from itertools import islice
from math import factorial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from .coefficients import ContinuousExtension
from .order_conditions import exact_tree_weight, exact_weight, order, trees, word_weights, words
from .tableau import Tableau

# The conditions of one order: what they multiply the coefficients of one power of theta with, and
# what the results must be, one column for each power.
Conditions: TypeAlias = tuple[np.ndarray, np.ndarray]

# Of words, the conditions of order 5 are no longer all linear.
_MAX_ORDER = 4
# The highest power of theta.
_MAX_POWER = 8
# What is zero but for rounding: for the methods here singular values are above 7e-6 or below 1e-14.
_ROUNDING = 1e-9
STORED = Path(__file__).with_name("extensions.json")


@lru_cache
def continuous_extension(tableau: Tableau) -> ContinuousExtension:
    """The tableau's own, or one of uniform order p - 1 for a method of order p, but at most 4."""
    return tableau.continuous_extension or _stored(tableau) or derived_extension(tableau)


def derived_extension(tableau: Tableau) -> ContinuousExtension:
    """What the order conditions give.

    It uses the field at the end of the step only where the stages do not suffice.

    With `B_j` the sum of row j of beta, flow j is given a sum of `theta B_j`. Then the conditions
    are linear in the rest: in the weight of a word that has one letter besides single nodes, the
    stages' fields occur in that letter only, and up to order 4 one word has two such letters, whose
    weight is half the square of a letter's. Nor do the powers of theta mix.
    """
    found, reached = _solve(tableau.beta, _flow_conditions(tableau), _MAX_ORDER)
    if reached < _MAX_ORDER and reached < order(tableau) - 1:
        with_end = Tableau((*tableau.alpha, tableau.beta), tableau.beta)
        found, _ = _solve(with_end.beta, _flow_conditions(with_end), _MAX_ORDER)
    return found


class RungeKuttaExtension(NamedTuple):
    """Weights of the stages, and the rows and times of those that the method itself has not."""

    weights: ContinuousExtension
    rows: tuple[tuple[float, ...], ...]
    times: tuple[float, ...]


@lru_cache
def runge_kutta_extension(
    a: tuple[tuple[float, ...], ...], b: tuple[float, ...], order: int
) -> RungeKuttaExtension:
    """One of uniform order p - 1 in a linear space, for a Runge-Kutta method of order p, `order`.

    `a[i]` and `b[i]` belong to stage i.
    """
    found = _stored(a, b, order)
    return RungeKuttaExtension(*found) if found else derived_runge_kutta_extension(a, b, order)


def derived_runge_kutta_extension(
    a: tuple[tuple[float, ...], ...], b: tuple[float, ...], order: int
) -> RungeKuttaExtension:
    """What the order conditions give.

    The method's own stages suffice up to order 5 with as few as diffrax has. `diffrax.Dopri8` takes
    4 more, which evaluate the field at the end of the step and at three points within. These points
    are where the stages so far reach one order more than elsewhere. Where there are no such points
    the order is what the stages reach.
    """
    more = []
    found, reached = _solve((b,), _tree_conditions(a, len(b)), _MAX_POWER)
    if reached < order - 1:
        more.append((b, 1.0))
        points = [1.0]
        while points:
            stages = (*a, *(row for row, _ in more))
            padded = (*b, *[0.0] * (len(stages) - len(b)))
            conditions = list(islice(_tree_conditions(stages, len(stages)), order - 1))
            found, reached = _solve((padded,), iter(conditions), _MAX_POWER)
            if reached >= order - 1:
                break
            points, matrix, values = _points_of_order(conditions[: reached + 1])
            for c in points:
                right = values @ c ** np.arange(1, 1 + _MAX_POWER)
                row = np.linalg.lstsq(matrix, right, rcond=_ROUNDING)[0]
                more.append((tuple(row.tolist()), c))
    return RungeKuttaExtension(found, tuple(row for row, _ in more), tuple(c for _, c in more))


def identity(*method: Any) -> str:
    """A short text that says which coefficients these are."""
    return sha256(repr(method).encode()).hexdigest()[:16]


def _stored(*method: Any) -> Any:
    """What is stored for these coefficients; None for those of a user."""
    return _as_tuples(_by_identity().get(identity(*method)))


@cache
def _by_identity() -> dict[str, Any]:
    return {each["of"]: each["extension"] for each in json.loads(STORED.read_text()).values()}


def _as_tuples(tree: Any) -> Any:
    return tuple(map(_as_tuples, tree)) if isinstance(tree, list) else tree


def _points_of_order(conditions: list[Conditions]) -> tuple[list[float], np.ndarray, np.ndarray]:
    """Where within a step all conditions can be met, though not everywhere; and the conditions.

    What is left over is a polynomial in theta for each condition. Here all are multiples of one,
    and that has roots besides the ends of the step.
    """
    matrix, values = (np.concatenate(parts) for parts in zip(*conditions, strict=True))
    left, sizes, _ = np.linalg.svd(matrix)
    rest = left[:, int(np.sum(sizes > _ROUNDING)) :].T @ values
    _, sizes, powers = np.linalg.svd(rest)
    if sizes[1] > _ROUNDING * sizes[0]:
        return [], matrix, values
    roots = np.roots([*powers[0, ::-1], 0.0])
    inside = roots.real[(np.abs(roots.imag) < _ROUNDING) & (np.abs(roots.real - 0.5) < 0.49)]
    return sorted(inside.tolist()), matrix, values


def _solve(
    end: tuple, conditions: Iterator[Conditions], max_order: int
) -> tuple[ContinuousExtension, int]:
    """Coefficients by flow, power and stage that sum to `end`, and the order that they reach.

    Order by order; the first that cannot be reached is missed by as little as possible. Of all
    such coefficients these are the smallest.
    """
    shape = len(end), len(end[0])
    total = np.array(end, float).ravel()
    found = np.zeros((total.size, _MAX_POWER))
    free = np.eye(total.size)
    reached = 0
    for matrix, values in conditions:
        if np.abs(matrix @ total - values.sum(axis=1)).max() > _ROUNDING:
            # The order of the method itself ends here.
            break
        left, sizes, right = np.linalg.svd(matrix @ free)
        rank = int(np.sum(sizes > _ROUNDING))
        error = left[:, :rank].T @ (values - matrix @ found)
        found += free @ right[:rank].T @ (error / sizes[:rank, None])
        if reached == max_order or np.abs(matrix @ found - values).max() > _ROUNDING:
            break
        free = free @ right[rank:].T
        reached += 1
    num_powers = min(reached + 1, _MAX_POWER)
    found = found[:, :num_powers]
    # What no condition decides, in equal parts; the conditions hold at the end of the step.
    found += ((total - found.sum(axis=1)) / num_powers)[:, None]
    coefficients = found.reshape(*shape, num_powers).swapaxes(1, 2).tolist()
    return tuple(tuple(map(tuple, powers)) for powers in coefficients), reached


def _flow_conditions(tableau: Tableau) -> Iterator[Conditions]:
    rows = [[(k, float(a)) for k, a in enumerate(p[-1]) if a] for p in tableau.prefixes]
    sums = np.array(tableau.beta, float).sum(axis=1)
    before = np.concatenate([[0], np.cumsum(sums)])
    num_flows, num_stages = len(sums), tableau.num_stages

    def parts(left: int, right: int) -> np.ndarray:
        """By flow, the weight of a word for a letter there, so many single nodes to its sides."""
        weights = [
            before[:-1] ** (left - i)
            / factorial(left - i)
            * (sums ** (i + j) / factorial(i + j + 1))
            * (1 - before[1:]) ** (right - j)
            / factorial(right - j)
            for i in range(left + 1)
            for j in range(right + 1)
        ]
        return np.sum(weights, axis=0)

    # By order and tree, at each stage.
    letters: list[dict] = [{(): np.ones(num_stages)}]
    yield np.kron(np.eye(num_flows), letters[0][()]), _at_power(1, sums)
    for n, (stages, _) in enumerate(word_weights(tableau, rows), 2):
        letters.append(
            {tree: np.array([w.get(tree, 0) for w in stages], float) for tree in words(n - 1)}
        )
        matrix, values = [], []
        for size in range(2, n + 1):
            for tree, letter in letters[size - 1].items():
                for left in range(n - size + 1):
                    right = n - size - left
                    word = ((),) * left + (tree,) + ((),) * right
                    matrix.append(np.kron(parts(left, right), letter))
                    values.append(_at_power(size, [float(exact_weight(word))]))
        yield np.array(matrix), np.concatenate(values)


def _tree_conditions(a: tuple, num_stages: int) -> Iterator[Conditions]:
    matrix = np.zeros((num_stages, num_stages))
    for i, row in enumerate(a):
        matrix[i, : len(row)] = row
    values: dict = {}
    for n in range(1, _MAX_POWER + 1):
        for tree in trees(n):
            values[tree] = np.prod([np.ones(num_stages)] + [matrix @ values[t] for t in tree], 0)
        yield (
            np.array([values[tree] for tree in trees(n)]),
            _at_power(n, [float(exact_tree_weight(tree)) for tree in trees(n)]),
        )


def _at_power(power: int, values: np.ndarray | list[float]) -> np.ndarray:
    columns = np.zeros((len(values), _MAX_POWER))
    columns[:, power - 1] = values
    return columns
