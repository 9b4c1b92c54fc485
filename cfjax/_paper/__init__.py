"""The experiments of the paper: its tables and figures, each beside the printed numbers.

Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
Section 3.
"""

from collections.abc import Callable, Sequence

from rich.progress import Progress

from .._report import Report
from . import rigid_body

EXPERIMENTS: Sequence[Callable[[Progress], Report]] = (rigid_body.report,)
