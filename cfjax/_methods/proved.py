"""Orders of long methods, which tests prove, so that a solve need not.

The proof takes as long as a small step takes to trace. A tableau that is not here is proved in the
process that uses it.
"""

from typing import TypeVar

from .exponential import ETD43, ETD54, ETDRK4, ExponentialTableau
from .order_conditions import order
from .pairs import CF43, CF54
from .tableau import CG4, CG5, Tableau

T = TypeVar("T", Tableau, ExponentialTableau)

PROVED: dict[Tableau | ExponentialTableau, int] = {CG4: 4, CG5: 5, ETDRK4: 4}


def proved(tableau: T, order: int, embedded_order: int | None = None) -> T:
    """The tableau, of which tests prove this."""
    PROVED[tableau] = order
    if tableau.embedded_method is not None and embedded_order is not None:
        PROVED[tableau.embedded_method] = embedded_order
    return tableau


def order_of(tableau: Tableau | ExponentialTableau) -> int:
    """As `cfjax.order`, which proves it always."""
    return PROVED[tableau] if tableau in PROVED else order(tableau)


proved(CF43, 4, 3)
proved(CF54, 5, 4)
proved(ETD43, 4, 3)
proved(ETD54, 5, 4)
