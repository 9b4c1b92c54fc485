"""Compositions of a symmetric method: their orders, and what they refuse.

Their steps are compared with products of flows in test_splitting.py, and their numbers with
published ones in test_long_times.py.
"""

import problems
import pytest

import cfjax


@pytest.mark.slow
@pytest.mark.parametrize("order, num_steps", [(4, (16, 32)), (6, (8, 16)), (8, (6, 12))])
def test_order_of_strang_composed(order, num_steps, driven_top_answer):
    solver = cfjax.Composition(cfjax.Strang(), order)
    problems.assert_order_of_driven_top(solver, order, num_steps, driven_top_answer)


def test_wrong_arguments(no_shape_hook):
    with pytest.raises(TypeError, match="solver must be a symmetric one"):
        cfjax.Composition(cfjax.CF4(), 4)
    with pytest.raises(ValueError, match="order must be 4, 6 or 8, got 5"):
        cfjax.Composition(cfjax.Strang(), 5)  # pyright: ignore[reportArgumentType]
