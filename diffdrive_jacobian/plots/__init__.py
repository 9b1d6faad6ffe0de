"""Pictures of the five documents, each drawn by one function; figures and tables of runs and sweeps.

`geometry()` returns a matplotlib figure, which `plot_jacobian geometry` writes to a file. No ROS
is needed. `run_figure.draw` draws runs, `run_table.write_csv` writes a run as CSV, `sweep_figure` draws
sweeps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.plots.damping_figure import damping
    from diffdrive_jacobian.plots.geometry_figure import geometry
    from diffdrive_jacobian.plots.lie_bracket_figure import lie_bracket
    from diffdrive_jacobian.plots.null_space_figure import null_space
    from diffdrive_jacobian.plots.parking_figure import parking

__all__ = [
    'damping',
    'geometry',
    'lie_bracket',
    'null_space',
    'parking',
]
_PICTURES = {
    'geometry': ('geometry_figure', 'the robot from above with its symbols, and the point at d (B, E)'),
    'damping': ('damping_figure', 'where the damping of two links acts, and what it costs (A)'),
    'null_space': ('null_space_figure', 'three links that move while their tip does not (A)'),
    'lie_bracket': ('lie_bracket_figure', 'forward, turn, back, turn back: the gap is sideways (A)'),
    'parking': ('parking_figure', 'parallel parking by three motions (A)'),
}
"""The pictures: the module with the function of that name, and what it draws."""
PICTURES = {name: what for name, (_, what) in _PICTURES.items()}
"""What each picture shows."""
if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy.attach(
        __name__, {name: f'plots.{module}' for name, (module, _) in _PICTURES.items()}
    )
