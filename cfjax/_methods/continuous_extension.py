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

# The conditions of one order: the matrix that multiplies the coefficients of a power of theta, and
# the right-hand sides, one column for each power.
Conditions: TypeAlias = tuple[np.ndarray, np.ndarray]

# The conditions of order 5 on words are no longer all linear.
_MAX_ORDER = 4
# The highest power of theta.
_MAX_POWER = 8
# Smaller numbers are zero: for the methods here singular values are above 7e-6 or below 1e-14.
_ROUNDING = 1e-9
STORED = Path(__file__).with_name("extensions.json")


@lru_cache
def continuous_extension(tableau: Tableau) -> ContinuousExtension:
    """The tableau's own, or one of uniform order p - 1 for a method of order p, but at most 4."""
    return tableau.continuous_extension or _stored(tableau) or derived_extension(tableau)


def derived_extension(tableau: Tableau) -> ContinuousExtension:
    """The extension that satisfies the order conditions.

    It uses the field at the end of the step only where the stages do not suffice.

    With `B_j` the sum of row j of beta, the row of flow j sums to `theta B_j`. Then the conditions
    are linear in the remaining coefficients: in the weight of a word that has one letter besides
    single nodes, the stages' fields occur in that letter only, and up to order 4 one word has two
    such letters, whose weight is half the square of a letter's. The powers of theta do not mix.
    """
    extension, attained = _solve(tableau.beta, _flow_conditions(tableau), _MAX_ORDER)
    if attained < _MAX_ORDER and attained < order(tableau) - 1:
        fsal = Tableau((*tableau.alpha, tableau.beta), tableau.beta)
        extension, _ = _solve(fsal.beta, _flow_conditions(fsal), _MAX_ORDER)
    return extension


class RungeKuttaExtension(NamedTuple):
    """Weights of the stages, and the rows and times of the stages added to the method's own."""

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
    stored = _stored(a, b, order)
    return RungeKuttaExtension(*stored) if stored else derived_runge_kutta_extension(a, b, order)


def derived_runge_kutta_extension(
    a: tuple[tuple[float, ...], ...], b: tuple[float, ...], order: int
) -> RungeKuttaExtension:
    """The extension that satisfies the order conditions.

    The method's own stages suffice up to order 5 with as few as diffrax has. `diffrax.Dopri8` takes
    4 more, which evaluate the field at the end of the step and at three points within. At these
    points the stages so far reach one order more than elsewhere. Where there are no such points
    the order is the one that the stages reach.
    """
    extra_stages = []
    weights, attained = _solve((b,), _tree_conditions(a, len(b)), _MAX_POWER)
    if attained < order - 1:
        extra_stages.append((b, 1.0))
        points = [1.0]
        while points:
            stages = (*a, *(row for row, _ in extra_stages))
            padded = (*b, *[0.0] * (len(stages) - len(b)))
            conditions = list(islice(_tree_conditions(stages, len(stages)), order - 1))
            weights, attained = _solve((padded,), iter(conditions), _MAX_POWER)
            if attained >= order - 1:
                break
            points, matrix, values = _points_of_order(conditions[: attained + 1])
            for c in points:
                right_side = values @ c ** np.arange(1, 1 + _MAX_POWER)
                row = np.linalg.lstsq(matrix, right_side, rcond=_ROUNDING)[0]
                extra_stages.append((tuple(row.tolist()), c))
    rows, times = zip(*extra_stages, strict=True) if extra_stages else ((), ())
    return RungeKuttaExtension(weights, rows, times)


def identity(*method: Any) -> str:
    """The key of these coefficients in the stored file."""
    return sha256(repr(method).encode()).hexdigest()[:16]


def _stored(*method: Any) -> Any:
    """The stored extension, or None for coefficients of a user."""
    return _as_tuples(_by_identity().get(identity(*method)))


@cache
def _by_identity() -> dict[str, Any]:
    return {entry["of"]: entry["extension"] for entry in json.loads(STORED.read_text()).values()}


def _as_tuples(tree: Any) -> Any:
    return tuple(map(_as_tuples, tree)) if isinstance(tree, list) else tree


def _points_of_order(conditions: list[Conditions]) -> tuple[list[float], np.ndarray, np.ndarray]:
    """Where within a step all conditions can be met, though not everywhere; and the conditions.

    The residual of each condition is a polynomial in theta. Where all are multiples of one
    polynomial, the points are the roots of that one within the step.
    """
    matrix, values = (np.concatenate(blocks) for blocks in zip(*conditions, strict=True))
    u, singular_values, _ = np.linalg.svd(matrix)
    residual = u[:, int(np.sum(singular_values > _ROUNDING)) :].T @ values
    _, singular_values, powers = np.linalg.svd(residual)
    if singular_values[1] > _ROUNDING * singular_values[0]:
        return [], matrix, values
    roots = np.roots([*powers[0, ::-1], 0.0])
    inside = roots.real[(np.abs(roots.imag) < _ROUNDING) & (np.abs(roots.real - 0.5) < 0.49)]
    return sorted(inside.tolist()), matrix, values


def _solve(
    weights: tuple, conditions: Iterator[Conditions], max_order: int
) -> tuple[ContinuousExtension, int]:
    """Coefficients by flow, power and stage that sum to `weights`, and the order that they reach.

    The conditions are solved order by order; those of the first order that cannot be reached hold
    as nearly as possible. Of all such coefficients these are the smallest.
    """
    shape = len(weights), len(weights[0])
    flat_weights = np.array(weights, float).ravel()
    coefficients = np.zeros((flat_weights.size, _MAX_POWER))
    null_space = np.eye(flat_weights.size)
    attained = 0
    for matrix, values in conditions:
        if np.abs(matrix @ flat_weights - values.sum(axis=1)).max() > _ROUNDING:
            # The order of the method itself ends here.
            break
        u, singular_values, vt = np.linalg.svd(matrix @ null_space)
        rank = int(np.sum(singular_values > _ROUNDING))
        residual = u[:, :rank].T @ (values - matrix @ coefficients)
        coefficients += null_space @ vt[:rank].T @ (residual / singular_values[:rank, None])
        if attained == max_order or np.abs(matrix @ coefficients - values).max() > _ROUNDING:
            break
        null_space = null_space @ vt[rank:].T
        attained += 1
    num_powers = min(attained + 1, _MAX_POWER)
    coefficients = coefficients[:, :num_powers]
    # Equal parts of what no condition decides: the conditions hold at the end of the step.
    coefficients += ((flat_weights - coefficients.sum(axis=1)) / num_powers)[:, None]
    coefficients = coefficients.reshape(*shape, num_powers).swapaxes(1, 2)
    return _as_tuples(coefficients.tolist()), attained


def _flow_conditions(tableau: Tableau) -> Iterator[Conditions]:
    rows = [[(k, float(a)) for k, a in enumerate(p[-1]) if a] for p in tableau.prefixes]
    sums = np.array(tableau.beta, float).sum(axis=1)
    partial_sums = np.concatenate([[0], np.cumsum(sums)])
    num_flows, num_stages = len(sums), tableau.num_stages

    def letter_factors(num_left: int, num_right: int) -> np.ndarray:
        """By flow, the weight of a letter in a word with so many single nodes on each side."""
        weights = [
            partial_sums[:-1] ** (num_left - i)
            / factorial(num_left - i)
            * (sums ** (i + j) / factorial(i + j + 1))
            * (1 - partial_sums[1:]) ** (num_right - j)
            / factorial(num_right - j)
            for i in range(num_left + 1)
            for j in range(num_right + 1)
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
                for num_left in range(n - size + 1):
                    num_right = n - size - num_left
                    word = ((),) * num_left + (tree,) + ((),) * num_right
                    matrix.append(np.kron(letter_factors(num_left, num_right), letter))
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
