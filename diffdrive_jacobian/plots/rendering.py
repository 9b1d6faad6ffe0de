# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The style of all figures, and the files with them."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from functools import partial, wraps
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
    # Of one long line at a time Agg may have not enough memory.
    'agg.path.chunksize': 10_000,
    'figure.constrained_layout.w_pad': 0.1,
    'figure.constrained_layout.h_pad': 0.08,
}
DPI = 130
"""Resolution of PNG files (dots per inch)."""
COMPRESSION = 1
"""Compression level of PNG files: half the time of the default one, for files a tenth larger."""


def styled() -> Any:
    """Return a context manager that sets this style, independent of the user's configuration."""
    import matplotlib

    # The backend is not needed, and would not be restored. With the salt equal figures are equal files.
    kept = ('backend', 'svg.hashsalt')
    style: Any = {name: value for name, value in matplotlib.rcParamsDefault.items() if name not in kept}
    return matplotlib.rc_context({**style, **_STYLE})


def picture(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Let a function draw its figure in this style, which notebooks show."""

    @wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with styled():
            drawing = draw(*args, **kwargs)
        # IPython calls this. It knows only figures of pyplot.
        drawing._repr_png_ = partial(render, drawing, 'png')  # type: ignore[attr-defined]
        return drawing

    return drawn


def render(drawing: Figure, ending: str) -> bytes:
    """Return the content of a `png`, `svg` or `pdf` file with a figure."""
    content = io.BytesIO()
    how: Any = {'pil_kwargs': {'compress_level': COMPRESSION}} if ending == 'png' else {}
    with styled(), warnings.catch_warnings():
        # The font may lack a letter of a bag's name.
        warnings.filterwarnings('ignore', message='Glyph')
        drawing.savefig(content, format=ending, dpi=DPI, **how)
    return content.getvalue()


def write(drawing: Figure, path: Path, *, replace: bool = False) -> None:
    """Write a figure to a new file, which appears only when it is complete.

    Raises:
        FileExistsError: It exists, and is not to be replaced.
        OSError: It cannot be written.
    """
    create(path, render(drawing, extension(path)), replace=replace)
