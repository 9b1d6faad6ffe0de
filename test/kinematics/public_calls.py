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

"""The public functions of kinematics, control and simulation, each with valid arguments."""

from __future__ import annotations

import dataclasses
import inspect

import numpy as np

from diffdrive_jacobian import control, simulation
from diffdrive_jacobian.control import Arrival, StraightLine, VelocityLimits, Waypoints
from diffdrive_jacobian.kinematics import contact, diff_drive, rigid_body, se2, spatial
from diffdrive_jacobian.kinematics import inverse_kinematics as ik
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.mobile_manipulator import (
    MobileManipulator,
    mobile_manipulator_jacobian,
)
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm, arm_forward_kinematics, arm_jacobian
from diffdrive_jacobian.kinematics.spatial_arm import SpatialArm
from diffdrive_jacobian.simulation import Drift, Robot, RobotModel, odometry_noise
from diffdrive_jacobian.simulation.exact_moments import gaussian, propagate_moments

REFERENCE = (0.6, 0.3, 0.4, 0.5, 0.2, -0.05, 0.1, 1.0)
POSE, TWIST, GOAL, TURNED = (0.3, -0.2, 1.0), (0.2, 0.5), (1.0, 2.0), (1.0, -0.2, 0.3)
WHEELS, THETA = {'r': 0.033, 'L': 0.16}, {'theta': 0.5}
LIMITS = VelocityLimits(min_v=-0.1, max_v=0.22, min_omega=-2.0, max_omega=2.0, max_wheel_speed=10.0)
COVARIANCE = np.diag([1e-4, 1e-4, 1e-3])
ODOMETRY = {'L': 0.16, 'wheel_travel_variance': 1e-5}
MODEL = RobotModel(limits=LIMITS, command_timeout=10**9)
ROBOT = Robot(model=MODEL, stamp=0, pose=np.array(POSE)).commanded(TWIST, 0)
DRIFTING = Robot(model=dataclasses.replace(MODEL, drift=Drift(seed=3)), stamp=0, pose=np.array(POSE))
LINE = StraightLine([0.0, 0.0], [1.0, 0.0], 0.1)
ARM = PlanarArm([1.0, 0.7])
MANIPULATOR = MobileManipulator(0.033, 0.16, ARM)
SPATIAL = SpatialArm([0.1, 0.4, 0.3, 0.0, 0.1], [1.5, 0.0, 0.3, -1.5, 0.0], 0.2, prismatic=(2,))
Q, X_DOT, WHOLE_Q = (0.5, 0.9), (0.1, -0.2), (0.1, 0.2, 0.3, 0.5, 0.9)
SQUARE, WIDE = ARM.jacobian(Q), PlanarArm([0.5, 0.4, 0.3]).jacobian([0.1, 0.2, 0.3])
WEIGHTS, RANGE = (1.0, 2.0, 0.5), {'lower': (-3.0, -2.0), 'upper': (2.0, 2.5)}
TASKS = [(WIDE, X_DOT), ([[1.0, 0.0, 2.0]], [0.5])]
VECTOR, OTHER_VECTOR = (*POSE, 0.1, 0.2, 0.3), (*GOAL, 0.5, -0.4, 0.2, 1.0)
HERE, THERE = np.eye(4), np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
LOOP = {
    **{'law': control.go_to_goal, 'starts': POSE, 'goals': GOAL, 'rate': 10.0, 'duration': 0.3},
    **{'turning_gain': 3.0, **WHEELS, 'arrival': Arrival(), 'limits': LIMITS},
}


def closed_loops(starts, goals, law, **options):
    return simulation.closed_loops(law, starts, goals, 3.0, 0.5, **options)


def trajectories(starts, goals, law, **options):
    return simulation.trajectories(law, starts, goals, 3.0, 0.5, **options)


BY_NAME = {
    **{**THETA, **WHEELS, 'd': -0.1, 'pose': POSE, 'twist': POSE, 'first': POSE, 'second': TURNED},
    **{'v': 0.2, 'omega': 0.5, 'omega_R': 2.0, 'omega_L': 3.0, 'q_dot': POSE, 'dt': 0.5},
    **{'x': 0.1, 'phi': 0.5, 'angle': 4.0},
    **{'J': WIDE, 'x_dot': X_DOT, 'q_dot_0': POSE, 'damping': 0.1, 'weights': WEIGHTS, 'cutoff': 1e-9},
    **{'mask': (1.0, 0.5), 'manipulability': 0.1, 'threshold': 0.2, 'maximum': 0.1, 'q': Q, **RANGE},
    **{'jacobian': ARM.jacobian, 'max_velocity': (0.1, 0.4, 0.2), 'tasks': TASKS},
}
"""Arguments of the functions of modules in which a name means the same."""
BROADCASTING = {
    **{
        function: {name: BY_NAME[name] for name in inspect.signature(function).parameters}
        for module in (diff_drive, contact, se2, iv)
        for function in map(vars(module).get, module.__all__)
        if inspect.isfunction(function)
    },
    se2.integrate: {'pose': POSE, 'twist': TWIST, 'dt': 0.5},
    rigid_body.point_velocity: {'v': POSE, 'omega': POSE, 'offset': (0.0, 0.1, 0.2)},
    spatial.spatial_displacement: {'T': HERE, 'T_desired': THERE},
    spatial.pose_vector: {'T': THERE},
    spatial.pose_vector_difference: {'target': VECTOR, 'pose': OTHER_VECTOR},
    spatial.pose_vector_displacement: {'target': VECTOR, 'pose': OTHER_VECTOR},
    spatial.pose_vector_difference_jacobian: {'e': VECTOR, 'J': SPATIAL.jacobian(WHOLE_Q)},
    spatial.spatial_displacement_jacobian: {'Delta': VECTOR, 'J': SPATIAL.jacobian(WHOLE_Q, 'end')},
    **{call: {'q': WHOLE_Q} for call in (SPATIAL.forward_kinematics, SPATIAL.joint_positions)},
    SPATIAL.jacobian: {'q': WHOLE_Q},
    SPATIAL.joint_torques: {'q': WHOLE_Q, 'wrench': (*POSE, *GOAL, 0.4)},
    SPATIAL.integrate: {'q': WHOLE_Q, 'q_dot': (3.0, 2.0, 0.1, 0.2, 0.5), 'dt': 0.1},
    iv.adjugate_inverse: {'J': SQUARE},
    iv.prioritized: {
        'tasks': TASKS,
        'damping': 0.1,
        'weights': WEIGHTS,
        'max_velocity': (1.0, 4.0, 2.0),
    },
    ik.pose_difference: {'target': (1.0, 2.0, 3.0), 'pose': (0.5, 0.5, -3.0)},
    **{call: {'q': Q} for call in (ARM.joint_positions, ARM.forward_kinematics)},
    **{call: {'q': Q} for call in (ARM.jacobian, ARM.determinant)},
    **{call: {'lengths': (1.0, 0.7), 'q': Q} for call in (arm_forward_kinematics, arm_jacobian)},
    mobile_manipulator_jacobian: {
        **{'lengths': (1.0, 0.7), 'theta': 0.5, 'q': Q, 'mount': (0.1, 0.2)},
        **WHEELS,
    },
    ARM.singular_configurations: {'q_1': 0.5},
    ARM.inverse_kinematics: {'position': (1.0, 0.5)},
    ARM.inverse_velocity: {'q': Q, 'x_dot': X_DOT},
    ARM.clearance: {'q': Q, 'obstacle': GOAL},
    ARM.clearance_gradient: {'q': Q, 'obstacle': GOAL},
    ARM.joint_torques: {'q': Q, 'wrench': (0.1, -0.2, 0.3)},
    ARM.integrate: {'q': Q, 'q_dot': X_DOT, 'dt': 0.1},
    **{call: {'q': WHOLE_Q} for call in (MANIPULATOR.forward_kinematics, MANIPULATOR.jacobian)},
    MANIPULATOR.configuration_jacobian: {'q': WHOLE_Q},
    MANIPULATOR.integrate: {'q': WHOLE_Q, 'q_dot': (3.0, 2.0, 0.1, 0.2), 'dt': 0.1},
    control.go_to_goal: {'state': POSE, 'goal': GOAL, 'Kp': 3.0, 'Kv': 0.5},
    control.turn_in_place: {'theta': 0.5, 'heading': 3.0, 'Kp': 3.0},
    control.offset_point: {'state': POSE, 'goal': GOAL, 'k': 0.5, 'd': 0.1},
    control.pure_pursuit: {'state': POSE, 'reference': REFERENCE, 'l_d': 0.2},
    control.kanayama: {'state': POSE, 'reference': REFERENCE, 'K_x': 2.0, 'K_y': 25.0, 'K_theta': 9.0},
    control.offset_point_tracking: {'state': POSE, 'reference': REFERENCE, 'k': 1.5, 'd': 0.1},
    control.dynamic_feedback_linearization: {
        **{'pose': POSE, 'reference': REFERENCE, 'K_p': 4.0, 'K_d': 4.0, 'state': (0.3,), 'dt': 0.02}
    },
    control.go_to_pose: {'state': POSE, 'goal': TURNED, 'Kp': 3.0, 'Kv': 0.5, 'h': 2.0},
    control.saturate: {'v': 3.0, 'omega': 5.0, 'limits': LIMITS, **WHEELS},
    control.resolved_rate: {
        **{'J': WIDE, 'x': Q, 'x_desired': GOAL, 'x_dot_desired': X_DOT, 'gain': 1.0, 'damping': 0.1},
        **{'q_dot_0': POSE, 'max_correction': 0.3, 'weights': WEIGHTS, 'max_velocity': (0.1, 0.4, 0.2)},
    },
    Arrival(offset=0.1).distance: {'x': 0.1, 'y': 0.2, **THETA, 'x_goal': 1.0, 'y_goal': 2.0},
    odometry_noise.twist_covariance: {'twist': TWIST, **ODOMETRY, 'interval': 0.02},
    odometry_noise.propagate_covariance: {
        **{'covariance': COVARIANCE, 'pose': POSE, 'twist': TWIST, 'dt': 0.5},
        **ODOMETRY,
    },
}
"""Functions whose arguments have leading axes that broadcast."""
FIXED = {'limits', 'jacobian', 'tasks'}
"""Arguments of these that are no arrays."""
OTHERS = {
    VelocityLimits: {'min_v': -1.0, 'max_v': 1.0, 'min_omega': -1.0, 'max_omega': 1.0}
    | {'max_wheel_speed': 9.0},
    Arrival: {
        **{'xy_tolerance': 0.02, 'yaw_tolerance': 0.02, 'use_heading': True, 'offset': 0.1},
        **dict.fromkeys(('trans_stopped_velocity', 'rot_stopped_velocity'), 0.1),
    },
    PlanarArm: {'lengths': (1.0, 0.7)},
    SpatialArm: {'a': (0.1, 0.4), 'alpha': (1.5, 0.0), 'd': (0.2, 0.1), 'theta': (0.0, 0.5)},
    MobileManipulator: {**WHEELS, 'arm': ARM, 'mount': (0.1, 0.0)},
    Waypoints: {'poses': [POSE], 'index': 0, 'turning': False},
    StraightLine: {'start': [0.0, 0.0], 'end': [1.0, 0.0], 'speed': 0.1},
    LINE.position: {'t': 0.5},
    Drift: {'seed': 3, 'right_wheel_radius_multiplier': 1.01, 'left_wheel_radius_multiplier': 0.99}
    | {'wheel_separation_multiplier': 1.02},
    RobotModel: {
        **{'wheel_radius': 0.033, 'wheel_separation': 0.16, 'limits': LIMITS},
        **{'command_timeout': 10**9, 'wheel_travel_variance': 1e-5, 'drift': Drift(seed=3)},
    },
    MODEL.limited: {'command': TWIST},
    Robot: {
        **{'model': MODEL, 'stamp': 0, 'pose': POSE, 'covariance': COVARIANCE},
        **{'wheel_angles': TWIST, 'command': TWIST, 'twist': TWIST, 'commanded_at': 0},
    },
    ROBOT.at: {'stamp': 5},
    ROBOT.commanded: {'command': TWIST, 'stamp': 5},
    ROBOT.placed: {'pose': POSE, 'covariance': COVARIANCE, 'stamp': 5},
    ROBOT.reported: {'pose': POSE, 'wheel_angles': TWIST, 'twist': TWIST},
    DRIFTING.pushed: {'displacement': POSE, 'stamp': 5},
    ROBOT.remodelled: {'model': MODEL, 'stamp': 5},
    ROBOT.restarted: {'stamp': 5},
    ROBOT.twist_covariance: {'interval': 0.02},
    ROBOT.twist_covariance_tuple: {'interval': 0.02},
    propagate_moments: {
        **{'moments': tuple(gaussian(COVARIANCE)), 'pose': POSE, 'twist': TWIST, 'dt': 0.5},
        **ODOMETRY,
    },
    closed_loops: LOOP | {'progress': None},
    trajectories: LOOP,
}
"""Constructors, methods of one robot, and drives."""
CALLS = BROADCASTING | OTHERS
