"""Control laws that turn a goal into a body twist: pure functions and values, no ROS."""

from diffdrive_jacobian.control.go_to_goal import go_to_goal, turn_in_place
from diffdrive_jacobian.control.saturation import VelocityLimits, saturate
from diffdrive_jacobian.control.waypoints import Arrival, Waypoints

__all__ = ['Arrival', 'VelocityLimits', 'Waypoints', 'go_to_goal', 'saturate', 'turn_in_place']
