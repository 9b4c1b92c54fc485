"""Colours, an empty figure and the unit sphere, for the pictures of scenes."""

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    import matplotlib.figure

# By its name, as few who import the package need matplotlib.
Figure: TypeAlias = "matplotlib.figure.Figure"

# The colours of Okabe & Ito, which colour-blind readers tell apart.
BLUE, GREEN, ORANGE, VERMILION, PURPLE = "#0072B2", "#009E73", "#E69F00", "#D55E00", "#CC79A7"


def new(width: float, height: float) -> Figure:
    """An empty figure of this size in inches."""
    from matplotlib.figure import Figure

    return Figure((width, height), layout="constrained")


def sphere(figure: Figure, *place: Any, zoom: float, color: str = "0.88") -> Any:
    """Axes with a wire frame of the unit sphere, behind all that is drawn later."""
    axes: Any = figure.add_subplot(*place, projection="3d", computed_zorder=False)
    longitude, latitude = np.mgrid[0 : 2 * np.pi : 37j, 0 : np.pi : 19j]
    ring = np.sin(latitude)
    frame = ring * np.cos(longitude), ring * np.sin(longitude), np.cos(latitude)
    axes.plot_wireframe(*frame, color=color, linewidth=0.5, zorder=0)
    axes.set_axis_off()
    axes.set_box_aspect((1, 1, 1), zoom=zoom)
    return axes
