"""Content of a file with a figure. matplotlib is imported when something is drawn."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from diffdrive_jacobian.plots.style import DPI

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMPRESSION = 1
"""Compression level of PNG files: half the time of the default one, for files a tenth larger."""


def render(drawing: Figure, ending: str) -> bytes:
    """Draw a figure and return the content of a file.

    `Figure.savefig` draws a figure with a layout twice, the first time to lay it out. The canvas lays it
    out when it draws it.

    Args:
        drawing: The figure. Its resolution is changed.
        ending: Format, `png`, `svg` or `pdf`.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    content = io.BytesIO()
    drawing.set_dpi(DPI)
    # Their methods have no type hints.
    canvas: Any
    if ending == 'png':
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        canvas = FigureCanvasAgg(drawing)
        canvas.print_png(content, pil_kwargs={'compress_level': COMPRESSION})
    elif ending == 'svg':
        from matplotlib.backends.backend_svg import FigureCanvasSVG

        canvas = FigureCanvasSVG(drawing)
        canvas.print_svg(content)
    else:
        from matplotlib.backends.backend_pdf import FigureCanvasPdf

        canvas = FigureCanvasPdf(drawing)
        canvas.print_pdf(content)
    return content.getvalue()
