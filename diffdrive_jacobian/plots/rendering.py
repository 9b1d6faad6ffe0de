"""Content of a file with a figure. matplotlib is imported when something is drawn."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from diffdrive_jacobian.plots.style import DPI

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROUNDS = 4
"""Largest number of times that a figure is laid out."""
MARGIN = 0.03
"""Least room left of the labels (inches)."""
POINTS = 72
"""Resolution of files without pixels (dots per inch)."""
COMPRESSION = 1
"""Compression level of PNG files: half the time of the default one, for files a tenth larger."""


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
    content = io.BytesIO()
    # Their methods have no type hints.
    canvas: Any
    if ending == 'png':
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        canvas = FigureCanvasAgg(drawing)
        _lay_out(drawing, DPI)
        canvas.print_png(content, pil_kwargs={'compress_level': COMPRESSION})
    elif ending == 'svg':
        from matplotlib.backends.backend_svg import FigureCanvasSVG

        canvas = FigureCanvasSVG(drawing)
        _lay_out(drawing, POINTS)
        canvas.print_svg(content)
    else:
        from matplotlib.backends.backend_pdf import FigureCanvasPdf

        canvas = FigureCanvasPdf(drawing)
        _lay_out(drawing, POINTS)
        canvas.print_pdf(content)
    return content.getvalue()


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
