import dataclasses
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from solver_table import named as named_solvers

from cfjax import Tableau, third_order_a, third_order_b

HALF = Fraction(1, 2)
THIRD = Fraction(1, 3)

NAMED = {name: row.make().tableau for name, row in named_solvers("commutator-free").items()}
LIE_EULER, CF2, CF3, CF4, CG3, CG4 = (
    NAMED[name] for name in ("LieEuler", "CF2", "CF3", "CF4", "CG3", "CG4")
)


# Normal form


def test_every_kind_of_nested_sequence_gives_the_same_tableau():
    rows = [[[0, 0]], [[0.5, 0]]]
    lists = Tableau(rows, [[0, 1]])
    assert lists.alpha == ((), ((HALF, 0),))
    assert lists.beta == ((0, 1),)
    assert Tableau(tuple(map(tuple, rows)), ((0, 1),)) == lists
    assert Tableau(np.array(rows), np.array([[0, 1]])) == lists
    assert Tableau([[], [[0.5]]], [[0, 1]]) == lists
    assert Tableau((r for r in rows), ((b for b in [0, 1]),)) == lists


def test_rows_of_zeros_are_dropped_and_short_rows_padded():
    tableau = Tableau([[], [[0], [HALF], [0, 0]]], [[0, 0], [0, 1], []])
    assert (tableau.alpha, tableau.beta) == (CF2.alpha, CF2.beta)
    assert all(len(row) == 2 for row in (*tableau.alpha[1], *tableau.beta))


def test_coefficients_become_fractions_or_floats():
    beta = [[np.int64(1), 1, HALF, -0.5, np.float32(-0.5), np.float64(-0.5), 0.0]]
    (row,) = Tableau([[]] * 7, beta).beta
    assert [type(b) for b in row] == [Fraction] * 3 + [float] * 3 + [Fraction]
    assert row == (1, 1, 0.5, -0.5, -0.5, -0.5, 0)


def test_numpy_float32_is_converted_without_loss():
    third = np.float32(1) / np.float32(3)
    tableau = Tableau([[], [[third]]], [[0, 1]])
    assert tableau.alpha[1][0][0] == float(third) != 1 / 3


def test_is_compared_and_hashed_by_value():
    for tableau in NAMED.values():
        alpha = [list(map(list, rows)) for rows in tableau.alpha]
        again = Tableau(alpha, tableau.beta, tableau.embedded, tableau.continuous_extension)
        assert again is not tableau
        assert again == tableau
        assert hash(again) == hash(tableau)
        assert {again: 1}[tableau] == 1


def test_named_tableaus_differ():
    assert len(set(NAMED.values())) == len(NAMED)
    assert CF3 != "CF3"


def test_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        CF3.beta = CF2.beta  # pyright: ignore[reportAttributeAccessIssue]


def test_replace_checks_again():
    tableau = Tableau(CF2.alpha, CF2.beta)
    assert dataclasses.replace(tableau, beta=[[HALF, HALF]]).beta == ((HALF, HALF),)
    with pytest.raises(ValueError, match="beta must sum to 1"):
        dataclasses.replace(tableau, beta=[[HALF]])
    with pytest.raises(ValueError, match="continuous_extension must lead to the end"):
        dataclasses.replace(CF2, beta=[[HALF, HALF]])


def test_repr_is_short():
    family = third_order_a(Fraction(2, 3))
    assert repr(family) == "Tableau(alpha=[[], [(1/3)], [(0, 2/3)]], beta=[(1/3), (-1/12, 0, 3/4)])"
    assert repr(CF2) == (
        "Tableau(alpha=[[], [(1/2)]], beta=[(0, 1)], embedded=[(1)], "
        "continuous_extension=[[(1), (-1, 1)]])"
    )


# Derived facts


def test_stage_times_and_flows(subtests):
    flows = {"LieEuler": 1, "CF2": 2, "CF3": 3, "CF4": 5, "CF43": 6, "CF54": 9}
    flows |= {"CG3": 6, "CG4": 15, "CG5": 43, "Williamson3": 3, "CK54": 5, "YRK135": 13}
    low_storage = {name: row.make().tableau for name, row in named_solvers("low-storage").items()}
    assert flows.keys() <= (NAMED | low_storage).keys()
    for name, tableau in (NAMED | low_storage).items():
        with subtests.test(name=name):
            assert len(tableau.c) == tableau.num_stages == tableau.num_evaluations
            for c, rows in zip(tableau.c, tableau.alpha, strict=True):
                assert c == pytest.approx(float(sum(map(sum, rows))), abs=1e-15)
            assert tableau.num_flows == len(tableau.prefixes) == flows.get(name, tableau.num_flows)
            # Prefixes come after their own beginning.
            known = {()}
            for prefix in tableau.prefixes:
                assert prefix not in known
                assert prefix[:-1] in known
                known.add(prefix)
            assert {*tableau.alpha, tableau.beta} <= known


def test_stage_times_are_exact():
    assert LIE_EULER.c == (0,)
    assert CF2.c == (0, HALF)
    assert CF3.c == (0, THIRD, Fraction(2, 3))
    assert CF4.c == (0, HALF, HALF, 1)
    assert CG3.c == (0, Fraction(3, 4), Fraction(17, 24))
    assert all(isinstance(c, Fraction) for c in (*CF3.c, *CF4.c, *CG3.c))
    # Added as floats these would lose the 1.
    tableau = Tableau([[], [[1e16]], [[1e16, 1], [-1e16]]], [[0, 0, 1]])
    assert tableau.c == (0, 1e16, 1)
    assert [type(c) for c in tableau.c] == [Fraction, float, float]


def test_rows_share_flows_only_from_the_start():
    shared = Tableau([[], [[HALF]], [[HALF], [0, HALF]]], [[HALF], [0, HALF]])
    assert shared.num_flows == 2
    swapped = Tableau([[], [[HALF]], [[HALF], [0, HALF]]], [[0, HALF], [HALF]])
    assert swapped.num_flows == 4


def test_is_exact():
    exact = {name for name, tableau in NAMED.items() if tableau.is_exact}
    assert exact == {"LieEuler", "CF2", "CF3", "CF4", "CG3"}
    assert not Tableau([[], [[0.25]]], [[0, 1]]).is_exact
    assert Tableau(np.zeros((1, 1, 1)), [[1]]).is_exact


# Embedded method and continuous extension


def test_what_an_embedded_method_costs():
    for name, embedded_flows, last in (("CF3", 1, False), ("CF4", 1, True), ("CG3", 3, False)):
        tableau = NAMED[name]
        assert tableau.num_embedded_flows == embedded_flows
        assert tableau.uses_last(tableau.embedded) is last
        assert tableau.embedded_method.alpha[-1][0][: tableau.num_stages] == tableau.beta[0]
    assert CG4.embedded_method is None and CG4.num_embedded_flows == 0


def test_a_mistaken_embedded_method_or_continuous_extension(no_shape_hook, subtests):
    both = "embedded", "continuous_extension"
    for error, name, given, message in (
        (ValueError, both[0], [[HALF]], r"embedded must sum to 1 .* got a sum of 1/2"),
        (ValueError, both[0], [[0, 0, 0, 1]], r"embedded\[0\] must have at most 3 entries"),
        (ValueError, both[0], [[float("nan"), 1]], r"embedded\[0\]\[0\] must be finite"),
        (ValueError, both[0], [[0, 1]], "another end point than beta"),
        (ValueError, both[1], [[[1]]], r"must lead to the end.* stage 0 sum to 1, .* to 0"),
        (ValueError, both[1], [[[0, 0, 0, 1]]], r"extension\[0\]\[0\] must have at most 3 entries"),
        (TypeError, both[0], 1, "embedded.* must be a"),
        (TypeError, both[1], [1], "continuous_extension.* must be a"),
        (TypeError, both[1], "ab", "continuous_extension.* must be a"),
    ):
        with subtests.test(case=message), pytest.raises(error, match=message):
            Tableau([[], [[HALF]]], [[0, 1]], **{name: given})
    Tableau([[], [[HALF]]], [[0, 1]], embedded=[[1]])


# The two families


def test_families_at_known_members():
    assert third_order_a(Fraction(2, 3)) == Tableau(CF3.alpha, CF3.beta)
    assert third_order_a(1) == Tableau(
        [[], [[THIRD]], [[-1, 2]]], [[THIRD], [-THIRD, Fraction(3, 4), Fraction(1, 4)]]
    )
    assert third_order_b(Fraction(2, 3)) == Tableau(
        [[], [[Fraction(2, 3)]], [[Fraction(5, 12), Fraction(1, 4)]]],
        [[Fraction(5, 12), Fraction(1, 4)], [Fraction(-1, 6), Fraction(-1, 2), 1]],
    )
    assert third_order_b(0).c == (0, Fraction(2, 3), 0)


def test_family_of_a_float_is_rounded_once():
    for family in (third_order_a, third_order_b):
        exact, rounded = family(Fraction(0.7)), family(0.7)
        assert not rounded.is_exact
        assert rounded.c[2] == 0.7
        assert [tuple(map(float, row)) for row in exact.beta] == list(rounded.beta)
        assert family(np.float64(0.7)) == rounded


def test_bad_parameters_raise(no_shape_hook, subtests):
    a, b = third_order_a, third_order_b
    excluded = (
        *((a, alpha, "0", "6 alpha") for alpha in (0, 0.0, -0.0)),
        *((a, alpha, "1/3", "3 alpha - 1") for alpha in (THIRD, 1 / 3)),
        *((b, alpha, "1", "1 - alpha") for alpha in (1, 1.0)),
        *((b, alpha, "1/3", "3 alpha - 1") for alpha in (THIRD, np.float64(1) / 3)),
    )
    others = (
        (ValueError, float("nan"), "alpha must be finite, got nan"),
        (TypeError, "1/2", "alpha must be an int, a Fraction or a float, got '1/2'"),
        (TypeError, True, r"alpha must be .*, got True of type bool"),
    )
    cases: list[Any] = [
        *(
            (ValueError, family, alpha, f"alpha must not be {shown}, got .*divide by {divisor}, ")
            for family, alpha, shown, divisor in excluded
        ),
        *((error, family, *rest) for error, *rest in others for family in (a, b)),
        (ValueError, a, 5e-324, r"alpha = 5e-324 is out of range"),
        (ValueError, a, 1e308, r"alpha = 1e\+308 is out of range"),
    ]
    for error, family, alpha, text in cases:
        with subtests.test(case=f"{alpha!r}: {text}"), pytest.raises(error, match=text) as raised:
            family(alpha)
        if "divide" in text:
            assert "which is zero there" in str(raised.value)


# Errors


def test_bad_values_raise(subtests):
    more = r"got a sum of"
    for alpha, beta, message in (
        ([], [[1]], r"alpha must have at least one stage, got none"),
        ([[]], [[1, 0]], r"beta\[0\] must have at most 1 entries, .*, got 2"),
        ([[], [[1], [0, 0, 0]]], [[1]], r"alpha\[1\]\[1\] must have at most 2 entries, .*, got 3"),
        (
            [[], [[HALF], [0, HALF]]],
            [[1]],
            r"alpha\[1\]\[1\]\[1\] is 1/2, but .* explicit: alpha\[1\] may use only stages before "
            r"1, so this entry must be 0",
        ),
        ([[[1]]], [[1]], r"alpha\[0\]\[0\]\[0\] is 1, .* alpha\[0\] may use no stage"),
        ([[], [[float("nan")]]], [[1]], r"alpha\[1\]\[0\]\[0\] must be finite, got nan"),
        ([[]], [[float("-inf")]], r"beta\[0\]\[0\] must be finite, got -inf"),
        ([[]], [], rf"beta must sum to 1 over all its rows \(consistency\), {more} 0\."),
        ([[]], [[HALF], [THIRD]], rf"beta must sum to 1 .*, {more} 5/6\."),
        ([[]], [[0.5], [THIRD]], rf"beta must sum to 1 .*, {more} 0.8333"),
        ([[]], [[1 + 1e-14]], rf"beta must sum to 1 .*, {more} 1.00000000000001\."),
        ([[]], [[1 + Fraction(1, 10**30)]], r"beta must sum to 1 .* 10{29}1/10{30}\."),
    ):
        with subtests.test(case=message), pytest.raises(ValueError, match=message):
            Tableau(alpha, beta)


def test_bad_types_raise(no_shape_hook, subtests):
    row, number = r"must be a row .*, got", r"must be an int, .*, got"
    for alpha, beta, message in (
        (1, [[1]], r"alpha must be a sequence with one list of flows .*, got 1 of type int"),
        (np.array(1.0), [[1]], r"alpha must be .*, got array\(1\.\) of type ndarray"),
        ([[], 1], [[1]], r"alpha\[1\] must be a sequence of rows, .*, got 1 of type int"),
        ([[], [0.5]], [[1]], rf"alpha\[1\]\[0\] {row} 0.5 of type float"),
        ([[]], 1, r"beta must be a sequence of rows, .*, got 1 of type int"),
        ([[]], [1], rf"beta\[0\] {row} 1 of type int"),
        ([[]], ["1"], rf"beta\[0\] {row} '1' of type str"),
        ([[]], {0: [1]}, r"beta must be a sequence of rows, .* of type dict"),
        ([[]], [{1}], rf"beta\[0\] {row} \{{1\}} of type set"),
        ([[]], [["1"]], rf"beta\[0\]\[0\] {number} '1' of type str"),
        ([[]], [[None]], rf"beta\[0\]\[0\] {number} None of type NoneType"),
        ([[]], [[1j]], rf"beta\[0\]\[0\] {number} 1j of type complex"),
        ([[]], [[True]], rf"beta\[0\]\[0\] {number} True of type bool"),
        ([[]], [[np.True_]], rf"beta\[0\]\[0\] {number} (np\.)?True_? of type bool"),
        ([[]], [[[1]]], rf"beta\[0\]\[0\] {number} \[1\] of type list"),
        ([[], [[[1]]]], [[1]], rf"alpha\[1\]\[0\]\[0\] {number} \[1\] of type list"),
    ):
        with subtests.test(case=message), pytest.raises(TypeError, match=message):
            Tableau(alpha, beta)


def test_a_number_that_would_lose_digits_raises():
    precise = np.longdouble(1) / 3
    if float(precise) == precise:
        pytest.skip("long double is double here")
    with pytest.raises(TypeError, match=r"alpha\[1\]\[0\]\[0\] must be an int"):
        Tableau([[], [[precise]]], [[1]])


def test_sum_of_rounded_weights_is_accepted():
    assert sum(map(Fraction, [0.1] * 10)) != 1
    assert Tableau([[]] * 10, [[0.1] * 10]).beta == ((0.1,) * 10,)
    assert Tableau([[]] * 3, [[1e6 + 1 / 3, 1 / 3, 1 / 3 - 1e6]]).num_stages == 3
