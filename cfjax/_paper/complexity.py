"""Table 1 of the paper: exponentials and commutators of one step."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from rich.progress import Progress
from rich.table import Table

from .. import CF3, CF4, CG3, CG4, CG5, RKMK, RKMK3, RKMK4, AbstractAlgebraElement, LieTerm
from .._integrate.integrate import without_estimate
from .._measure.report import Report

# Exponentials and commutators for each order as printed. The paper's 45 is an estimate.
PRINTED = {"RKMK": {3: (3, 1), 4: (4, 2), 5: (6, 12)}, "C-G": {3: (6, 0), 4: (15, 0), 5: (45, 0)}}

METHODS: dict[str, dict[int, tuple[str, diffrax.AbstractSolver]]] = {
    "RKMK": {
        3: ("RKMK3", RKMK3()),
        4: ("RKMK4", RKMK4()),
        5: ("RKMK(Dopri5)", RKMK(diffrax.Dopri5.tableau)),
    },
    "C-G": {3: ("CG3", CG3()), 4: ("CG4", CG4()), 5: ("CG5", CG5())},
    "this paper": {3: ("CF3", CF3()), 4: ("CF4", CF4())},
}


def report(progress: Progress) -> Report:
    """Table 1."""
    del progress  # Nothing here takes time.
    table = Table(
        title="Table 1: exponentials and commutators of one step",
        caption="RKMK(Dopri5) keeps every commutator of the series; the paper counts fewer. "
        "The paper's 45 exponentials are an estimate: no such method was known to it.",
    )
    table.add_column("order")
    table.add_column("family")
    table.add_column("method")
    for heading in ("exponentials", "paper", "commutators", "paper"):
        table.add_column(heading, justify="right")
    for order in (3, 4, 5):
        for family, methods in METHODS.items():
            if order in methods:
                name, method = methods[order]
                printed = PRINTED.get(family, {}).get(order, ("", ""))
                row = zip(flows_and_brackets(method), printed, strict=True)
                table.add_row(str(order), family, name, *(str(x) for pair in row for x in pair))
        table.add_section()
    return Report(printed=[table], figures={})


def flows_and_brackets(method: diffrax.AbstractSolver) -> tuple[int, int]:
    """How many flows and brackets one step of `method` asks a field for."""
    flows = brackets = 0

    class Counted(AbstractAlgebraElement):
        a: jax.Array

        def flow(self, point: Any) -> Any:
            nonlocal flows
            flows += 1
            return point + self.a

        def tangent(self, point: Any) -> Any:
            return self.a

        def bracket(self, other: Any) -> "Counted":
            nonlocal brackets
            brackets += 1
            return Counted(self.a + other.a)

    term, method = LieTerm(lambda t, y, args: Counted(y)), without_estimate(method)
    jax.eval_shape(
        lambda y: method.step(term, 0.0, 0.1, y, None, None, made_jump=False)[0], jnp.zeros(8)
    )
    return flows, brackets
