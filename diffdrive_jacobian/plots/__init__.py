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

"""Pictures of the five documents, each drawn by one function; figures of runs, sweeps and calibrations.

Each function returns a matplotlib figure: `geometry()` the picture that `plot_jacobian geometry` writes,
`run_figure(runs)` that of `plot_run`. Neither ROS nor a display is needed. matplotlib is imported when
something is drawn: without it that raises ModuleNotFoundError.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_jacobian import lazy

if TYPE_CHECKING:
    from diffdrive_jacobian.plots.arm_pictures import arm_ellipses, damping, legs, null_space, spring
    from diffdrive_jacobian.plots.calibration_pictures import calibration_figure
    from diffdrive_jacobian.plots.film import Film
    from diffdrive_jacobian.plots.motion_pictures import lie_bracket, parking, path_laws
    from diffdrive_jacobian.plots.robot_pictures import (
        figure_1,
        figure_2,
        figure_3,
        figure_4,
        geometry,
        velocity_ellipses,
        wheel,
    )
    from diffdrive_jacobian.plots.run_pictures import run_figure
    from diffdrive_jacobian.plots.spatial_pictures import arm_at, elbow
    from diffdrive_jacobian.plots.sweep_pictures import sweep_figure

__all__ = [
    'PICTURES',
    'Film',
    'arm_at',
    'arm_ellipses',
    'calibration_figure',
    'damping',
    'elbow',
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
    'spring',
    'sweep_figure',
    'velocity_ellipses',
    'wheel',
]
_PICTURES = {
    'geometry': ('robot_pictures', 'the robot from above with its symbols, and the point at d (B, E)'),
    'damping': ('arm_pictures', 'where the damping of two links acts, and what it costs (A)'),
    'null_space': ('arm_pictures', 'three links that move while their tip does not (A)'),
    'elbow': (
        'spatial_pictures',
        'seven joints: the elbow moves while the hand stays, and the arm almost stretched (A)',
    ),
    'lie_bracket': ('motion_pictures', 'forward, turn, back, turn back: the gap is sideways (A)'),
    'parking': ('motion_pictures', 'parallel parking by three motions (A)'),
    'path_laws': ('motion_pictures', 'four laws over one figure eight, and their errors (B)'),
    'velocity_ellipses': (
        'robot_pictures',
        'velocities of the axle, a line, and of points at d, a circle at L/2 (B)',
    ),
    'legs': ('arm_pictures', 'a body on two legs: base, hips, knees and the sense of their angles (C)'),
    'wheel': (
        'robot_pictures',
        'a point of a wheel, phi = 0 on top, and the columns of its Jacobian (C)',
    ),
    'spring': ('arm_pictures', 'the spring that pulls and twists an arm to its desired pose (D)'),
    'arm_ellipses': ('arm_pictures', 'velocity and force ellipses of an arm along a motion (D)'),
    'arm_at': ('spatial_pictures', 'velocity and force ellipses of any arm at one configuration (D)'),
    'figure_1': ('robot_pictures', 'figure 1 of E: the robot along the x axis'),
    'figure_2': ('robot_pictures', 'figure 2 of E: the frames, C half way between C_1 and C_2'),
    'figure_3': ('robot_pictures', 'figure 3 of E: a wheel that rolls, and its contact P'),
    'figure_4': ('robot_pictures', 'figure 4 of E: the frames of the wheels on the rigid axle'),
}
"""The pictures: the module with the function of that name, and what it draws."""
PICTURES = {name: what for name, (_, what) in _PICTURES.items()}
"""What each picture shows."""
if not TYPE_CHECKING:
    _FUNCTIONS = {name: f'plots.{module}' for name, (module, _) in _PICTURES.items()}
    _FIGURES = {f'{what}_figure': f'plots.{what}_pictures' for what in ('calibration', 'run', 'sweep')}
    __getattr__, __dir__ = lazy.attach(__name__, _FUNCTIONS | _FIGURES | {'Film': 'plots.film'})
