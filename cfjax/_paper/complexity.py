"""Table 1 of the paper: exponentials and commutators of one step."""

from typing import Any, cast

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float
from rich.progress import Progress
from rich.table import Table

from .. import CF3, CF4, CG3, CG4, CG5, RKMK, RKMK3, RKMK4, AbstractAlgebraElement, LieTerm
from .._measure.cost import Problem, calls_of_steps
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
        caption="RKMK(Dopri5) takes two commutators a stage, as the series has no third; the "
        "paper counts more. "
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
    """How many flows and brackets a step of `method` takes."""
    term = LieTerm(lambda t, y, args: _Translation(y))
    t0, h, y0 = jnp.asarray(0.0), jnp.asarray(0.1), jnp.ones(3)
    method = cast(Any, method).without_estimate()
    _, step = calls_of_steps(Problem(term, method, t0, h, h, y0, None))
    return int(step.flows), int(step.brackets)


class _Translation(AbstractAlgebraElement):
    """A field that compiles quickly: only the numbers of its flows and brackets matter."""

    v: Float[Array, "3"]

    def flow(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        return point + self.v

    def tangent(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        return self.v

    def bracket(self, other: Any) -> "_Translation":
        return self
