"""Control laws that compute velocities from a goal, and controllers by name. No ROS."""

from diffdrive_jacobian.control.arrival import Arrival
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
    Controllers,
    controller_names,
    find_controller,
)
from diffdrive_jacobian.control.go_to_goal import go_to_goal, turn_in_place
from diffdrive_jacobian.control.offset_point import offset_point
from diffdrive_jacobian.control.path import Path, Reference
from diffdrive_jacobian.control.path_source import (
    PathError,
    circle_path,
    figure_eight_path,
    line_path,
    planned_path,
)
from diffdrive_jacobian.control.pose import go_to_pose
from diffdrive_jacobian.control.resolved_rate import StraightLine, resolved_rate
from diffdrive_jacobian.control.waypoints import Waypoints
from diffdrive_jacobian.kinematics.saturation import VelocityLimits, saturate

__all__ = [
    'KP',
    'KV',
    'OFFSET',
    'Arrival',
    'Boundary',
    'Controller',
    'ControllerError',
    'Controllers',
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
    'figure_eight_path',
    'find_controller',
    'go_to_goal',
    'go_to_pose',
    'line_path',
    'offset_point',
    'planned_path',
    'resolved_rate',
    'saturate',
    'turn_in_place',
]
