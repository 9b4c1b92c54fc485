"""Coefficients of a tableau: their types, their uncertainty, and the rows that they form."""

import math
import sys
from collections.abc import Iterable, Mapping, Set
from fractions import Fraction
from numbers import Integral, Real
from typing import Any, TypeAlias

Coefficient: TypeAlias = Fraction | float
Row: TypeAlias = tuple[Coefficient, ...]
Product: TypeAlias = tuple[Row, ...]
# A product of polynomials in theta without a constant term: coefficients by flow, power and stage.
ContinuousExtension: TypeAlias = tuple[Product, ...]


def uncertainty(coefficient: Coefficient) -> Fraction:
    """How far a coefficient may be from the number its author meant. A fraction is exact.

    A float is allowed four units of rounding, relative above 1 and absolute below: published
    decimals end at a fixed place (5e-17 for 16 digits), and sums or products of a few floats lose
    a unit or two. Zero stays exact, as it says that a stage is not used.
    """
    if isinstance(coefficient, Fraction) or coefficient == 0:
        return Fraction(0)
    return 4 * Fraction(sys.float_info.epsilon) * max(1, abs(Fraction(coefficient)))


def rounded_sum(terms: list[Coefficient]) -> Coefficient:
    """The exact sum of fractions; of floats, rounded once."""
    return _sum(terms) if all(isinstance(a, Fraction) for a in terms) else float(_sum(terms))


def _sum(terms: Iterable[Coefficient]) -> Fraction:
    return sum((Fraction(a) for a in terms), Fraction(0))


# Checks of arguments.


def checked_coefficient(name: str, value: Any) -> Coefficient:
    if isinstance(value, Fraction):
        return value
    if isinstance(value, Integral) and not isinstance(value, bool):
        return Fraction(int(value))
    if isinstance(value, Real) and not isinstance(value, bool):
        number = float(value)
        if not math.isfinite(number):
            raise ValueError(f"{name} must be finite, got {value}.")
        if number == value:
            # Arrays of floats write "not used" as 0.0, which is exact.
            return number if number else Fraction(0)
    raise TypeError(
        f"{name} must be an int, a Fraction or a float, got {value!r} of type "
        f"{type(value).__name__}. Coefficients are static numbers, never traced arrays."
    )


def checked_entries(name: str, value: Any, expected: str) -> list[Any]:
    is_unordered_or_text = isinstance(value, str | bytes | Mapping | Set)
    # An array without dimensions only looks iterable.
    is_scalar = not isinstance(value, Iterable) or getattr(value, "ndim", 1) == 0
    if is_unordered_or_text or is_scalar:
        raise TypeError(f"{name} must be {expected}, got {value!r} of type {type(value).__name__}.")
    return list(value)


def checked_product(name: str, value: Any, num_stages: int, num_usable: int) -> Product:
    """The rows of one point, of which only the first `num_known` stages may be used."""
    rows = _checked_rows(name, value, num_stages, "flow")
    for j, row in enumerate(rows):
        for k in range(num_usable, num_stages):
            if row[k] != 0:
                allowed = f"only stages before {num_usable}" if num_usable else "no stage"
                raise ValueError(
                    f"{name}[{j}][{k}] is {row[k]}, but the method must be explicit: "
                    f"{name} may use {allowed}, so this entry must be 0."
                )
    return tuple(row for row in rows if any(row))


def checked_end(name: str, value: Any, num_stages: int) -> Product:
    """The rows of an end point, which may use every stage."""
    rows = checked_product(name, value, num_stages, num_stages)
    entries = [b for row in rows for b in row]
    if abs(_sum(entries) - 1) > _sum(map(uncertainty, entries)):
        raise ValueError(
            f"{name} must sum to 1 over all its rows (consistency), got a sum of "
            f"{rounded_sum(entries)}."
        )
    return rows


def checked_extension(value: Any, num_stages: int, beta: Product) -> ContinuousExtension:
    """The coefficients of a continuous extension, which must lead to the end of the step."""
    name = "continuous_extension"
    flows = checked_entries(name, value, "a sequence with one entry for each flow")
    extension = tuple(
        tuple(_checked_rows(f"{name}[{j}]", powers, num_stages, "power"))
        for j, powers in enumerate(flows)
    )
    for k in range(len(beta[0])):
        entries = [row[k] for powers in extension for row in powers]
        weights = [row[k] for row in beta]
        if abs(_sum(entries) - _sum(weights)) > _sum(map(uncertainty, entries + weights)):
            raise ValueError(
                f"{name} must lead to the end of the step: its coefficients of stage {k} sum to "
                f"{rounded_sum(entries)}, and those of beta to {rounded_sum(weights)}."
            )
    return extension


def _checked_rows(name: str, value: Any, num_stages: int, unit: str) -> list[Row]:
    """A row for each flow or power, with one entry for each stage."""
    result = []
    for j, row in enumerate(
        checked_entries(name, value, f"a sequence of rows, one for each {unit}")
    ):
        row_name = f"{name}[{j}]"
        entries = checked_entries(row_name, row, "a row with one coefficient for each stage")
        if len(entries) > num_stages:
            raise ValueError(
                f"{row_name} must have at most {num_stages} entries, one for each stage of alpha, "
                f"got {len(entries)}."
            )
        coefficients = (checked_coefficient(f"{row_name}[{k}]", a) for k, a in enumerate(entries))
        result.append((*coefficients, *[Fraction(0)] * (num_stages - len(entries))))
    return result
