"""Pictures of the five documents, each drawn by one function; figures and tables of runs and sweeps.

`geometry()` returns a matplotlib figure, which `plot_jacobian geometry` writes to a file. No ROS
is needed. `run_figure.draw` draws runs, `run_table.write_csv` writes a run as CSV, `sweep_figure` draws
sweeps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.plots.arm_ellipses_figure import arm_ellipses
    from diffdrive_jacobian.plots.geometry_figure import geometry
    from diffdrive_jacobian.plots.spring_figure import spring

__all__ = [
    'arm_ellipses',
    'geometry',
    'spring',
]
_PICTURES = {
    'geometry': ('geometry_figure', 'the robot from above with its symbols, and the point at d (B, E)'),
    'arm_ellipses': ('arm_ellipses_figure', 'velocity and force ellipses of an arm along a motion (D)'),
    'spring': ('spring_figure', 'the spring that pulls and twists an arm to its desired pose (D)'),
}
"""The pictures: the module with the function of that name, and what it draws."""
PICTURES = {name: what for name, (_, what) in _PICTURES.items()}
"""What each picture shows."""
if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy.attach(
        __name__, {name: f'plots.{module}' for name, (module, _) in _PICTURES.items()}
    )
