"""Faults of a lockstep world over time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffdrive_jacobian.reading.run import Run, Series
from diffdrive_jacobian.reading.trace import Trace, seconds
from diffdrive_jacobian.text import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.patches import Patch

COLORS = ('#E69F00', '#56B4E9', '#CC79A7', '#F0E442', '#009E73')
"""Colors of the faults. Later ones share them."""
ALPHA = 0.25
NAMED = 6
"""Number of faults that the legend names."""
LABEL = 60
"""Length beyond which the name of a fault is cut."""


class FaultSpan(NamedTuple):
    """When a fault was there."""

    fault: str
    """The fault as Python source."""
    begin: float
    """Time on the axis of the figure (s)."""
    end: float
    """End (s); that of the run if it is not known."""


def fault_spans(one: Trace) -> list[FaultSpan]:
    """Return when the faults of a run began and ended, in the order in which they began."""
    run = one.run
    begun: dict[str, float] = {}
    spans: list[FaultSpan] = []
    for (_, fault, what), time in zip(run.fault_events, _times(run), strict=True):
        if what.startswith('ends') and fault in begun:
            spans.append(FaultSpan(fault, begun.pop(fault), time))
        elif not what.startswith('ends'):
            begun.setdefault(fault, time)
    last = float(one.time[-1])
    spans += [FaultSpan(fault, begin, max(begin, last)) for fault, begin in begun.items()]
    return sorted(spans, key=lambda span: span.begin)


def _times(run: Run) -> list[float]:
    """Return the times of the events on the axis of the figure (s)."""
    received = np.array([event[0] for event in run.fault_events], dtype=np.int64)
    series = Series(received=received, stamps=received, values=np.empty((len(received), 0)))
    return [float(time) for time in seconds(run, series)]


def draw_faults(panels: Iterable[Axes], spans: list[FaultSpan]) -> None:
    """Draw each fault as a band, and its beginning as a line, into axes over time."""
    for panel in panels:
        for number, span in enumerate(spans):
            color = COLORS[number % len(COLORS)]
            panel.axvspan(span.begin, span.end, color=color, alpha=ALPHA, lw=0.0, zorder=0.5)
            panel.axvline(span.begin, color=color, lw=1.2, zorder=0.6)


def fault_legend(spans: list[FaultSpan]) -> list[Patch]:
    """Return the legend of the faults."""
    from matplotlib.patches import Patch

    named = [
        Patch(color=COLORS[number % len(COLORS)], alpha=2.0 * ALPHA, label=_label(span.fault))
        for number, span in enumerate(spans[:NAMED])
    ]
    if len(spans) > NAMED:
        named[-1].set_label(f'and {len(spans) - NAMED + 1} more faults')
    return named


def _label(fault: str) -> str:
    fault = printable(fault)
    text = fault if len(fault) <= LABEL else f'{fault[: LABEL - 1]}…'
    # matplotlib reads a dollar as a formula.
    return text.replace('$', r'\$')
