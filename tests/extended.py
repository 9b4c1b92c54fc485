"""Methods with output within their steps, and the uniform order that it has there."""

from fractions import Fraction
from typing import Any

import diffrax

import cfjax

# The uniform order of each: at most one below that of the method.
FLOWS: dict[str, Any] = {
    "LieEuler": (cfjax.LieEuler(), 1),
    "CF2": (cfjax.CF2(), 2),
    "CF3": (cfjax.CF3(), 2),
    "CF4": (cfjax.CF4(), 3),
    "CF43": (cfjax.CF43(), 3),
    "CF54": (cfjax.CF54(), 4),
    "CG3": (cfjax.CG3(), 2),
    "CG4": (cfjax.CG4(), 3),
    "CG5": (cfjax.CG5(), 4),
    "Williamson3": (cfjax.Williamson3(), 2),
    "BWRRK33": (cfjax.BWRRK33(), 2),
    "BWRRK53": (cfjax.BWRRK53(), 3),
    "CK34": (cfjax.CK34(), 3),
    "CK54": (cfjax.CK54(), 3),
    "Luscher3": (cfjax.Luscher3(), 2),
    "YRK135": (cfjax.YRK135(), 4),
    "CFEES25": (cfjax.CFEES25(), 2),
    "CFEES27": (cfjax.CFEES27(), 2),
    "first family": (cfjax.CommutatorFree(cfjax.third_order_a(0.5)), 2),
    "second family": (cfjax.CommutatorFree(cfjax.third_order_b(Fraction(2, 3))), 2),
}
SERIES: dict[str, Any] = {
    "Heun": (cfjax.RKMK(diffrax.Heun.tableau), 2),
    "Bosh3": (cfjax.RKMK(diffrax.Bosh3.tableau), 2),
    "Dopri5": (cfjax.RKMK(diffrax.Dopri5.tableau), 4),
    "Tsit5": (cfjax.RKMK(diffrax.Tsit5.tableau), 4),
    "Dopri8": (cfjax.RKMK(diffrax.Dopri8.tableau), 7),
}
