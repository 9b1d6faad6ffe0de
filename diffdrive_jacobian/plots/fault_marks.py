"""Faults of a lockstep world over time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffdrive_jacobian.bags.run import Run, Series
from diffdrive_jacobian.bags.timeline import Trace, seconds
from diffdrive_jacobian.text import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

COLORS = ('#E69F00', '#56B4E9', '#CC79A7', '#F0E442', '#009E73')
"""Colors of the faults. Later ones share them."""
ALPHA = 0.25
VIOLATION = '#B00020'
"""Color of violations."""
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


class ViolationMark(NamedTuple):
    """When a property was violated."""

    time: int
    """Time of the recorder's clock (ns)."""
    label: str
    """The property, for the legend."""


def fault_spans(one: Trace) -> list[FaultSpan]:
    """Return when the faults of a run began and ended, in the order in which they began."""
    run = one.run
    begun: dict[str, float] = {}
    spans: list[FaultSpan] = []
    times = _times(run, [event[0] for event in run.fault_events])
    for (_, fault, what), time in zip(run.fault_events, times, strict=True):
        if what.startswith('ends') and fault in begun:
            spans.append(FaultSpan(fault, begun.pop(fault), time))
        elif not what.startswith('ends'):
            begun.setdefault(fault, time)
    last = float(one.time[-1])
    spans += [FaultSpan(fault, begin, max(begin, last)) for fault, begin in begun.items()]
    return sorted(spans, key=lambda span: span.begin)


def _times(run: Run, recorded: Sequence[int]) -> list[float]:
    """Return when events were recorded (ns) as times on the axis of the figure (s)."""
    received = np.array(recorded, dtype=np.int64)
    series = Series(received=received, stamps=received, values=np.empty((len(received), 0)))
    return [float(time) for time in seconds(run, series)]


def mark_faults(
    drawing: Figure, panels: Sequence[Axes], one: Trace, violations: Sequence[ViolationMark] = ()
) -> None:
    """Mark the faults of a run, and what was violated, in axes over time, and add their legend."""
    spans = fault_spans(one)
    draw_faults(panels, spans)
    handles = [*fault_legend(spans), *draw_violations(panels, one.run, violations)]
    if handles:
        drawing.legend(handles=handles, loc='outside upper right', ncol=2, fontsize=8.0)


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


def draw_violations(
    panels: Iterable[Axes], run: Run, violations: Sequence[ViolationMark]
) -> list[Line2D]:
    """Draw each violation as a line into axes over time, and return their legend."""
    from matplotlib.lines import Line2D

    times = _times(run, [one.time for one in violations])
    for panel in panels:
        for time in times:
            panel.axvline(time, color=VIOLATION, lw=1.6, ls='--', zorder=4)
    return [
        Line2D([], [], color=VIOLATION, lw=1.6, ls='--', label=_label(one.label)) for one in violations
    ]


def _label(fault: str) -> str:
    fault = printable(fault)
    text = fault if len(fault) <= LABEL else f'{fault[: LABEL - 1]}…'
    # matplotlib reads a dollar as a formula.
    return text.replace('$', r'\$')
