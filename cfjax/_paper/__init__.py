"""The experiments of the paper: its tables and figures, each beside the printed numbers.

Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
Sections 1 and 3, doi:10.1016/S0167-739X(02)00161-9.
"""

from collections.abc import Callable, Sequence

from rich.progress import Progress

from .._measure.report import Report
from . import complexity, heat, rigid_body, stiefel

EXPERIMENTS: Sequence[Callable[[Progress], Report]] = (
    complexity.report,
    rigid_body.report,
    stiefel.report,
    heat.report,
)
