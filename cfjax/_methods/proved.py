"""Orders of long methods, which tests prove, so that a solve need not.

The proof takes as long as a small step takes to trace. A tableau that is not here is proved in the
process that uses it.
"""

from typing import Any, TypeVar

from .order_conditions import order
from .pairs import CF43, CF54
from .tableau import CG4, CG5

T = TypeVar("T", bound=Any)

# Of tableaus of all kinds.
PROVED: dict[Any, int] = {CG4: 4, CG5: 5}


def proved(tableau: T, order: int, embedded_order: int | None = None) -> T:
    """The tableau, of which tests prove this."""
    PROVED[tableau] = order
    if tableau.embedded_method is not None and embedded_order is not None:
        PROVED[tableau.embedded_method] = embedded_order
    return tableau


def order_of(tableau: Any) -> int:
    """As `cfjax.order`, which proves it always."""
    return PROVED[tableau] if tableau in PROVED else order(tableau)


proved(CF43, 4, 3)
proved(CF54, 5, 4)
