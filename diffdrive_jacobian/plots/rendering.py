"""The style of all figures, and the content of a file with one."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

from diffdrive_jacobian.plots.output_files import create, extension

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = ParamSpec('P')
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
DPI, POINTS = 130, 72
"""Resolution of PNG files, and of files without pixels (dots per inch)."""
_CANVASES = {
    'png': ('backend_agg', 'FigureCanvasAgg'),
    'svg': ('backend_svg', 'FigureCanvasSVG'),
    'pdf': ('backend_pdf', 'FigureCanvasPdf'),
}
COMPRESSION = 1
"""Compression level of PNG files: half the time of the default one, for files a tenth larger."""
ROUNDS = 4
"""Largest number of times that a figure is laid out."""
MARGIN = 0.03
"""Least room left of the labels (inches)."""


def styled() -> Any:
    """Return a context manager that sets this style, independent of the user's configuration."""
    import matplotlib

    # The backend is not needed, and would not be restored. With the salt equal figures are equal files.
    kept = ('backend', 'svg.hashsalt')
    style: Any = {name: value for name, value in matplotlib.rcParamsDefault.items() if name not in kept}
    return matplotlib.rc_context({**style, **_STYLE})


def picture(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Let a function draw its figure in this style."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with styled():
            return draw(*args, **kwargs)

    return drawn


def render(drawing: Figure, ending: str) -> bytes:
    """Draw a figure and return the content of a file.

    `Figure.savefig` draws a figure with a layout twice, the first time to lay it out. Here it is only
    laid out, and again with more room if a label is outside: axes of equal scales change their limits
    with their size, and with them the width of their tick labels.

    Args:
        drawing: The figure. Its resolution is changed, and its layout becomes final.
        ending: Format, `png`, `svg` or `pdf`.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    with styled(), warnings.catch_warnings():
        # The font may lack a letter of a bag's name.
        warnings.filterwarnings('ignore', message='Glyph')
        return _render(drawing, ending)


def _render(drawing: Figure, ending: str) -> bytes:
    content = io.BytesIO()
    module, name = _CANVASES[ending]
    canvas = getattr(import_module(f'matplotlib.backends.{module}'), name)(drawing)
    if ending == 'png':
        _lay_out(drawing, DPI)
        canvas.print_png(content, pil_kwargs={'compress_level': COMPRESSION})
    else:
        _lay_out(drawing, POINTS)
        getattr(canvas, f'print_{ending}')(content)
    return content.getvalue()


def write(drawing: Figure, path: Path, *, replace: bool = False) -> None:
    """Write a figure to a new file, which appears only when it is complete.

    Raises:
        FileExistsError: It exists, and is not to be replaced.
        OSError: It cannot be written.
    """
    create(path, render(drawing, extension(path)), replace=replace)


def _lay_out(drawing: Figure, dpi: int) -> None:
    """Compute the layout of a figure at a resolution (dots per inch)."""
    drawing.set_dpi(dpi)
    layout: Any = drawing.get_layout_engine()
    missing = 0.0
    for _ in range(ROUNDS if layout is not None else 0):
        layout.execute(drawing)
        for axes in drawing.axes:
            axes.apply_aspect()
        boxes = [axes.yaxis.get_tightbbox() for axes in drawing.axes]
        outside = max(MARGIN * dpi - box.x0 for box in boxes if box is not None)
        if outside <= 0.0:
            break
        missing += outside / drawing.bbox.width
        layout.set(rect=(missing, 0.0, 1.0 - missing, 1.0))
    drawing.set_layout_engine('none')
