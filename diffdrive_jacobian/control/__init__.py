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

"""Control laws that compute velocities from a goal, and controllers by name. No ROS."""

from diffdrive_jacobian.control.controller import (
    KP,
    KV,
    OFFSET,
    Boundary,
    Controller,
    Gain,
    LawError,
    PathController,
)
from diffdrive_jacobian.control.controllers import (
    ControllerError,
    controller_names,
    find_controller,
    find_path_controller,
    path_controller_names,
)
from diffdrive_jacobian.control.goal_laws import go_to_goal, go_to_pose, offset_point, turn_in_place
from diffdrive_jacobian.control.path import Path, Reference
from diffdrive_jacobian.control.path_laws import (
    dynamic_feedback_linearization,
    kanayama,
    offset_point_tracking,
    pure_pursuit,
)
from diffdrive_jacobian.control.path_source import (
    PathError,
    circle_path,
    figure_eight_path,
    line_path,
    planned_path,
)
from diffdrive_jacobian.control.resolved_rate import StraightLine, resolved_rate
from diffdrive_jacobian.control.waypoints import Arrival, Waypoints
from diffdrive_jacobian.kinematics.saturation import VelocityLimits, saturate

__all__ = [
    'KP',
    'KV',
    'OFFSET',
    'Arrival',
    'Boundary',
    'Controller',
    'ControllerError',
    'Gain',
    'LawError',
    'Path',
    'PathController',
    'PathError',
    'Reference',
    'StraightLine',
    'VelocityLimits',
    'Waypoints',
    'circle_path',
    'controller_names',
    'dynamic_feedback_linearization',
    'figure_eight_path',
    'find_controller',
    'find_path_controller',
    'go_to_goal',
    'go_to_pose',
    'kanayama',
    'line_path',
    'offset_point',
    'offset_point_tracking',
    'path_controller_names',
    'planned_path',
    'pure_pursuit',
    'resolved_rate',
    'saturate',
    'turn_in_place',
]
