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

"""Warnings about parameters of go_to_goal that are valid, but do not suit. Imports no ROS."""

from __future__ import annotations

import math

from diffdrive_jacobian.control import KP, KV
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.nodes.stopping import overshoot_warnings
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters

SLOW_TURN = 60.0
"""Time for half a turn above which a limit of the yaw rate is reported (s)."""


def limit_warnings(limits: VelocityLimits) -> list[str]:
    """Return the warnings about limits with which goals take long or cannot be reached."""
    found = []
    if limits.max_v == 0.0:
        found.append(
            'linear.x.max_velocity is 0: the robot may not drive forward, goals cannot be reached'
        )
    slowest = min(-limits.min_omega, limits.max_omega)
    if slowest == 0.0:
        found.append(
            'angular.z.min_velocity or angular.z.max_velocity is 0: the robot may turn in one direction '
            'only or not at all, some goals and headings cannot be reached'
        )
    elif slowest * SLOW_TURN < math.pi:
        found.append(
            f'the yaw rate is limited to {slowest:g} rad/s: half a turn takes more than {SLOW_TURN:g} s'
        )
    return found


def rate_warnings(parameters: GoToGoalParameters, rate: float) -> list[str]:
    """Return the warnings about gains that are too large for the rate of the odometry (Hz)."""
    turns = parameters.arrival().use_heading
    return parameters.chosen_controller().rate_warnings(parameters, rate, turns=turns)


def gain_warnings(parameters: GoToGoalParameters) -> list[str]:
    """Return the warnings about gains of the law of goals, for whatever rate."""
    controller, limits = parameters.chosen_controller(), parameters.limits()
    found = controller.warnings(parameters, limits)
    if not parameters.stop_in_time:
        kv = parameters.kv if KV.name in controller.gain_names else None
        turns = parameters.arrival().use_heading or KP.name in controller.gain_names
        kp = parameters.kp if turns else None
        found += overshoot_warnings(kv, kp, limits, parameters.actuators())
    return found


def path_warnings(parameters: GoToGoalParameters) -> list[str]:
    """Return the warnings about gains of the law of paths."""
    return parameters.chosen_path_controller().warnings(parameters, parameters.limits())
