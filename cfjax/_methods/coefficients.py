"""Coefficients of a tableau: what may be one, how exact it is, and the rows that they form."""

import math
import sys
from collections.abc import Iterable, Mapping, Set
from fractions import Fraction
from numbers import Integral, Real
from typing import Any, TypeAlias

Coefficient: TypeAlias = Fraction | float
Row: TypeAlias = tuple[Coefficient, ...]
Product: TypeAlias = tuple[Row, ...]
# A product whose coefficients are polynomials without a constant term: by flow, power and stage.
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


# What the caller gives.


def checked_coefficient(where: str, value: Any) -> Coefficient:
    if isinstance(value, Fraction):
        return value
    if isinstance(value, Integral) and not isinstance(value, bool):
        return Fraction(int(value))
    if isinstance(value, Real) and not isinstance(value, bool):
        number = float(value)
        if not math.isfinite(number):
            raise ValueError(f"{where} must be finite, got {value}.")
        if number == value:
            # Arrays of floats write "not used" as 0.0, which is exact.
            return number if number else Fraction(0)
    raise TypeError(
        f"{where} must be an int, a Fraction or a float, got {value!r} of type "
        f"{type(value).__name__}. Coefficients are static numbers, never traced arrays."
    )


def checked_entries(where: str, value: Any, expected: str) -> list[Any]:
    unordered_or_text = isinstance(value, str | bytes | Mapping | Set)
    # An array without dimensions only looks iterable.
    is_scalar = not isinstance(value, Iterable) or getattr(value, "ndim", 1) == 0
    if unordered_or_text or is_scalar:
        raise TypeError(
            f"{where} must be {expected}, got {value!r} of type {type(value).__name__}."
        )
    return list(value)


def checked_product(where: str, value: Any, num_stages: int, num_known: int) -> Product:
    """The rows of one point, of which only the first `num_known` stages may be used."""
    rows = _checked_rows(where, value, num_stages, "flow")
    for j, row in enumerate(rows):
        for k in range(num_known, num_stages):
            if row[k] != 0:
                allowed = f"only stages before {num_known}" if num_known else "no stage"
                raise ValueError(
                    f"{where}[{j}][{k}] is {row[k]}, but the method must be explicit: "
                    f"{where} may use {allowed}, so this entry must be 0."
                )
    return tuple(row for row in rows if any(row))


def checked_end(where: str, value: Any, num_stages: int) -> Product:
    """The rows of an end of the step, which any stage leads to."""
    rows = checked_product(where, value, num_stages, num_stages)
    entries = [b for row in rows for b in row]
    if abs(_sum(entries) - 1) > _sum(map(uncertainty, entries)):
        raise ValueError(
            f"{where} must sum to 1 over all its rows (consistency), got a sum of "
            f"{rounded_sum(entries)}."
        )
    return rows


def checked_extension(value: Any, num_stages: int, beta: Product) -> ContinuousExtension:
    """The coefficients of a continuous extension, which must lead to the end of the step."""
    where = "continuous_extension"
    flows = checked_entries(where, value, "a sequence with one entry for each flow")
    extension = tuple(
        tuple(_checked_rows(f"{where}[{j}]", powers, num_stages, "power"))
        for j, powers in enumerate(flows)
    )
    for k in range(len(beta[0])):
        entries = [row[k] for powers in extension for row in powers]
        end = [row[k] for row in beta]
        if abs(_sum(entries) - _sum(end)) > _sum(map(uncertainty, entries + end)):
            raise ValueError(
                f"{where} must lead to the end of the step: its coefficients of stage {k} sum to "
                f"{rounded_sum(entries)}, and those of beta to {rounded_sum(end)}."
            )
    return extension


def _checked_rows(where: str, value: Any, num_stages: int, each: str) -> list[Row]:
    """A row for each flow or power, with one entry for each stage."""
    found = []
    for j, row in enumerate(
        checked_entries(where, value, f"a sequence of rows, one for each {each}")
    ):
        here = f"{where}[{j}]"
        entries = checked_entries(here, row, "a row with one coefficient for each stage")
        if len(entries) > num_stages:
            raise ValueError(
                f"{here} must have at most {num_stages} entries, one for each stage of alpha, "
                f"got {len(entries)}."
            )
        coefficients = (checked_coefficient(f"{here}[{k}]", a) for k, a in enumerate(entries))
        found.append((*coefficients, *[Fraction(0)] * (num_stages - len(entries))))
    return found
