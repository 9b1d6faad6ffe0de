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
    from diffdrive_jacobian.plots.damping_figure import damping
    from diffdrive_jacobian.plots.derivation_figures import figure_1, figure_2, figure_3, figure_4
    from diffdrive_jacobian.plots.geometry_figure import geometry
    from diffdrive_jacobian.plots.legs_figure import legs
    from diffdrive_jacobian.plots.lie_bracket_figure import lie_bracket
    from diffdrive_jacobian.plots.null_space_figure import null_space
    from diffdrive_jacobian.plots.parking_figure import parking
    from diffdrive_jacobian.plots.path_laws_figure import path_laws
    from diffdrive_jacobian.plots.spring_figure import spring
    from diffdrive_jacobian.plots.velocity_ellipses_figure import velocity_ellipses
    from diffdrive_jacobian.plots.wheel_figure import wheel

__all__ = [
    'PICTURES',
    'arm_ellipses',
    'damping',
    'figure_1',
    'figure_2',
    'figure_3',
    'figure_4',
    'geometry',
    'legs',
    'lie_bracket',
    'null_space',
    'parking',
    'path_laws',
    'run_figure',
    'run_table',
    'spring',
    'sweep_figure',
    'velocity_ellipses',
    'wheel',
]
_PICTURES = {
    'geometry': ('geometry_figure', 'the robot from above with its symbols, and the point at d (B, E)'),
    'damping': ('damping_figure', 'where the damping of two links acts, and what it costs (A)'),
    'null_space': ('null_space_figure', 'three links that move while their tip does not (A)'),
    'lie_bracket': ('lie_bracket_figure', 'forward, turn, back, turn back: the gap is sideways (A)'),
    'parking': ('parking_figure', 'parallel parking by three motions (A)'),
    'path_laws': ('path_laws_figure', 'four laws over one figure eight, and their errors (B)'),
    'velocity_ellipses': (
        'velocity_ellipses_figure',
        'velocities of the axle, a line, and of points at d, a circle at L/2 (B)',
    ),
    'legs': ('legs_figure', 'a body on two legs: base, hips, knees and the sense of their angles (C)'),
    'wheel': ('wheel_figure', 'a point of a wheel, phi = 0 on top, and the columns of its Jacobian (C)'),
    'spring': ('spring_figure', 'the spring that pulls and twists an arm to its desired pose (D)'),
    'arm_ellipses': ('arm_ellipses_figure', 'velocity and force ellipses of an arm along a motion (D)'),
    'figure_1': ('derivation_figures', 'figure 1 of E: the robot along the x axis'),
    'figure_2': ('derivation_figures', 'figure 2 of E: the frames, C half way between C_1 and C_2'),
    'figure_3': ('derivation_figures', 'figure 3 of E: a wheel that rolls, and its contact P'),
    'figure_4': ('derivation_figures', 'figure 4 of E: the frames of the wheels on the rigid axle'),
}
"""The pictures: the module with the function of that name, and what it draws."""
PICTURES = {name: what for name, (_, what) in _PICTURES.items()}
"""What each picture shows."""
if not TYPE_CHECKING:
    _FUNCTIONS = {name: f'plots.{module}' for name, (module, _) in _PICTURES.items()}
    _MODULES = {name: f'plots.{name}' for name in ('run_figure', 'run_table', 'sweep_figure')}
    __getattr__, __dir__ = lazy.attach(__name__, _FUNCTIONS | _MODULES)
