"""The style of all figures. matplotlib is imported when something is drawn. No display is needed."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = ParamSpec('P')
DPI = 130
"""Resolution of figures (dots per inch)."""
_STYLE: Any = {
    'font.size': 9.5,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.grid': True,
    'grid.color': '#e4e4e4',
    'axes.axisbelow': True,
    'legend.frameon': False,
    'figure.constrained_layout.w_pad': 0.1,
    'figure.constrained_layout.h_pad': 0.08,
}


def styled() -> Any:
    """Return a context manager that sets this style, independent of the user's configuration."""
    import matplotlib

    # The backend is not needed, and would not be restored.
    style: Any = {name: value for name, value in matplotlib.rcParamsDefault.items() if name != 'backend'}
    return matplotlib.rc_context({**style, **_STYLE})


def picture(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Let a function draw its figure in this style."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with styled():
            return draw(*args, **kwargs)

    return drawn
