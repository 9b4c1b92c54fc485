import pytest
from rich.progress import Progress
from rich.table import Table

from cfjax._paper import complexity
from cfjax._solvers.commutator_free import AbstractCommutatorFree


@pytest.mark.slow
def test_counts_are_the_papers_but_for_order_five():
    counts = {
        (family, order): complexity.flows_and_brackets(method)
        for family, methods in complexity.METHODS.items()
        for order, (_, method) in methods.items()
    }
    for family, printed in complexity.PRINTED.items():
        for order in (3, 4):
            assert counts[family, order] == printed[order]
    # Two at each of 5 stages: the third Bernoulli number is zero. The 45 exponentials were an
    # estimate; it came to be 43.
    assert counts["RKMK", 5] == (6, 10)
    assert counts["C-G", 5] == (43, 0)
    assert counts["this paper", 3] == (3, 0)
    assert counts["this paper", 4] == (5, 0)


@pytest.mark.slow
def test_counts_are_those_of_the_tableaus():
    for methods in (complexity.METHODS["C-G"], complexity.METHODS["this paper"]):
        for _, method in methods.values():
            assert isinstance(method, AbstractCommutatorFree)
            assert complexity.flows_and_brackets(method) == (method.tableau.num_flows, 0)


@pytest.mark.slow
def test_report():
    (table,) = complexity.report(Progress(disable=True)).printed
    assert isinstance(table, Table)
    assert [column.header for column in table.columns][2] == "method"
    assert len(table.rows) == 8
