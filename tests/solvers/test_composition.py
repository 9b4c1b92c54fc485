"""Compositions of a symmetric method: their orders, and what they refuse.

Their numbers are compared with published ones in test_long_times.py.
"""

import problems
import pytest

import cfjax


@pytest.mark.parametrize(
    "order, num_steps",
    [
        (4, (16, 32)),
        pytest.param(6, (8, 16), marks=pytest.mark.slow),
        pytest.param(8, (6, 12), marks=pytest.mark.slow),
    ],
)
def test_order_of_strang_composed(order, num_steps, driven_top_answer):
    solver = cfjax.Composition(cfjax.Strang(), order)
    problems.assert_order_of_driven_top(solver, order, num_steps, driven_top_answer)


@pytest.mark.parametrize(
    "make, kind, text",
    [
        (lambda: cfjax.Composition(cfjax.CF4(), 4), TypeError, "solver must be a symmetric one"),
        (
            lambda: cfjax.Composition(cfjax.Strang(), 5),
            ValueError,
            "order must be 4, 6 or 8, got 5",
        ),
    ],
)
def test_wrong_arguments(make, kind, text, no_shape_hook):
    with pytest.raises(kind, match=text):
        make()
