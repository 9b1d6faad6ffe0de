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

"""The node virtual_robot with wheels that slip or are not as nominal, and its topic ground_truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger
from support.lockstep_nodes import Topics, change, make_complete
from support.recorded import recorded
from support.ros_messages import instants, placement, pose_of, twist

from diffdrive_jacobian.bags.verification import COVARIANCE_TOLERANCE, verify
from diffdrive_jacobian.messages.codecs import Changes
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.nodes import VirtualRobotParameters
from diffdrive_jacobian.plots import run_figure
from diffdrive_jacobian.plots.run_plane import COLOR
from diffdrive_jacobian.simulation import Drift, Robot, RobotModel
from diffdrive_jacobian.testing import Lockstep
from diffdrive_jacobian.tools.verify_run import report

MULTIPLIERS = {
    'true_left_wheel_radius_multiplier': 0.99,
    'true_right_wheel_radius_multiplier': 1.02,
    'true_wheel_separation_multiplier': 1.05,
}
ASSUMED = {name.removeprefix('true_'): value for name, value in MULTIPLIERS.items()}
SLIPPING = {'simulate_slip': True, 'slip_seed': 7, 'wheel_travel_variance': 1e-4}


# --- What is published


def test_a_perfect_robot_has_no_ground_truth_and_is_where_its_odometry_says(lockstep, robot_at):
    topics, truths = Topics(lockstep), lockstep.listen(Odometry, 'ground_truth')
    robot = robot_at(1.0, 2.0, 0.5, slip_seed=4)
    lockstep.publish('cmd_vel', twist(0.2, 0.5))
    lockstep.run_for(0.4)
    assert not truths
    assert robot.truth == pytest.approx(pose_of(topics.odom[-1]), abs=1e-15)
    assert 'ground_truth' not in dict(robot.get_topic_names_and_types())


def test_ground_truth_is_that_of_the_library_and_odometry_that_of_a_perfect_robot(
    lockstep, robot_at, capfd
):
    topics, truths = Topics(lockstep), lockstep.listen(Odometry, 'ground_truth')
    robot = robot_at(1.0, 2.0, 0.5, **SLIPPING, **MULTIPLIERS)
    lockstep.publish('cmd_vel', twist(0.2, 0.5))
    lockstep.run_for(0.4)
    assert instants(truths) == instants(topics.odom)
    model = RobotModel(drift=Drift(seed=7, **ASSUMED), wheel_travel_variance=1e-4)
    start = Robot(model=model, stamp=instants(truths)[0], pose=[1.0, 2.0, 0.5])
    start = start.commanded((0.2, 0.5), start.stamp)
    for message, odometry in zip(truths[1:], topics.odom[1:], strict=True):
        (stamp,) = instants([message])
        expected = start.at(stamp)
        np.testing.assert_allclose(pose_of(message), expected.true_pose, rtol=1e-15)
        np.testing.assert_allclose(pose_of(odometry), expected.pose, rtol=1e-15)
        velocity = message.twist.twist
        assert (velocity.linear.x, velocity.angular.z) == expected.true_twist
        assert odometry.twist.twist == twist(0.2, 0.5)
    assert robot.truth.tolist() == expected.true_pose.tolist()
    assert np.linalg.norm(robot.truth - expected.pose) > 1e-4
    assert not np.any([message.pose.covariance, message.twist.covariance])
    assert (message.header.frame_id, message.child_frame_id) == ('map', 'base_link')
    assert 'publishing /odom, /ground_truth' in capfd.readouterr().err
    assert change(robot, ground_truth_frame_id='earth').successful
    lockstep.run_for(0.02)
    assert truths[-1].header.frame_id == 'earth'


def test_a_robot_that_assumes_its_true_dimensions_is_where_its_odometry_says(lockstep, robot_at):
    topics = Topics(lockstep)
    robot = robot_at(1.0, 2.0, 0.5, **MULTIPLIERS, **ASSUMED)
    lockstep.publish('cmd_vel', twist(0.2, 0.5))
    lockstep.run_for(0.4)
    assert robot.truth == pytest.approx(pose_of(topics.odom[-1]), abs=1e-14)
    # Its wheels turn for its true dimensions, not for the nominal ones.
    right, left = (0.2 + 0.5 * 0.16 * 1.05 / 2.0) / 1.02, (0.2 - 0.5 * 0.16 * 1.05 / 2.0) / 0.99
    assert list(topics.states[-1].velocity) == pytest.approx([left / 0.033, right / 0.033])
    # They can change during a drive: then the truth differs from the odometry from there on.
    assert change(robot, **dict.fromkeys(ASSUMED, 1.0)).successful
    lockstep.run_for(0.2)
    assert abs(robot.truth - pose_of(topics.odom[-1])).max() > 1e-3


def test_initialpose_places_the_robot_and_reset_odometry_its_odometry_alone(lockstep, robot_at):
    topics, truths = Topics(lockstep), lockstep.listen(Odometry, 'ground_truth')
    robot = robot_at(1.0, 0.0, 0.0, **SLIPPING)
    lockstep.publish('cmd_vel', twist(0.5, 0.0))
    lockstep.run_for(0.2)
    lockstep.publish('initialpose', placement(3.0, 4.0, 1.0))
    lockstep.run_for(0.02)
    assert math.dist(pose_of(truths[-1])[:2], (3.0, 4.0)) < 0.03
    before = robot.truth
    assert lockstep.call(Trigger, 'reset_odometry').success
    assert robot.truth.tolist() == before.tolist()
    lockstep.run_for(0.02)
    assert math.dist(pose_of(topics.odom[-1])[:2], (1.0, 0.0)) < 0.03
    assert math.dist(pose_of(truths[-1])[:2], (3.0, 4.0)) < 0.05


# --- Parameters


def test_invalid_parameters_are_named():
    frames = "parameters 'ground_truth_frame_id' and '{}' must differ"
    for parameters, named in (
        ({'slip_seed': -1}, "'slip_seed' must be"),
        ({'simulate_slip': 1}, "'simulate_slip' must be a bool"),
        *(({name: 0.099}, f"'{name}' must be in .0.1, 10., got 0.099") for name in MULTIPLIERS),
        ({'simulate_slip': True, 'ground_truth_frame_id': 'odom'}, frames.format('odom_frame_id')),
        ({**MULTIPLIERS, 'base_frame_id': 'map'}, frames.format('base_frame_id')),
    ):
        with pytest.raises(ParameterError, match=named):
            VirtualRobotParameters().changed(parameters)
    # A perfect robot has no ground truth.
    VirtualRobotParameters().changed({'odom_frame_id': 'map', 'slip_seed': 2**63 - 1})


def test_slip_cannot_change_while_the_robot_drives(lockstep, robot_at):
    robot = robot_at(**SLIPPING)
    for name, value in {'simulate_slip': False, 'slip_seed': 3, **MULTIPLIERS}.items():
        result = change(robot, wheel_separation=0.2, **{name: value})
        assert not result.successful
        assert 'read-only' in result.reason
    assert robot.parameters.wheel_separation == 0.16


# --- Bags


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """Record a drive with a placement, a reset and a timeout."""
    robot = {'cmd_vel_timeout': 0.3, **SLIPPING, **MULTIPLIERS}
    with Lockstep() as world, recorded(world, tmp_path_factory.mktemp('bags') / 'run') as made:
        world.add(make_complete(VirtualRobot, **robot))
        made.look()
        for index in range(20):
            world.publish('cmd_vel', twist(0.3, (-1) ** index * 1.3))
            world.run_for(0.0723)
            if index == 8:
                world.publish('initialpose', placement(2.0, 1.0, variances=(1e-4, 1e-4, 1e-3)))
            if index == 14:
                assert world.call(Trigger, 'reset_odometry').success
        world.run_for(0.6)
    return made.run


def test_a_run_has_the_ground_truth_and_is_verified_with_it_bit_for_bit(run):
    assert len(run.ground_truth) == len(run.odometry) > 90
    assert np.max(np.abs(run.ground_truth.values[:, :2] - run.odometry.values[:, :2])) > 1e-3
    verification = verify(run)
    assert verification.holds(1e-9, 1e-9)
    assert len(verification.truth.distances) == len(run.ground_truth)
    assert verification.truth.distances.max() == 0.0
    assert verification.truth.headings.max() < 1e-15
    assert verification.covariance_difference <= COVARIANCE_TOLERANCE
    assert 'ground truth: maximum error 0 m' in report(verification, 1e-9, 1e-9)


def test_a_changed_ground_truth_and_another_seed_are_found(run):
    values = run.ground_truth.values.copy()
    values[50, 0] += 1e-6
    verification = verify(replace(run, ground_truth=replace(run.ground_truth, values=values)))
    assert not verification.holds(1e-9, 1e-9)
    assert 'NOT as recorded' in report(verification, 1e-9, 1e-9)
    (name,) = run.parameters
    other = {name: run.parameters[name] | {'slip_seed': 8}}
    assert verify(replace(run, parameters=other)).truth.distances.max() > 1e-3


def test_without_the_dimensions_of_the_robot_the_odometry_alone_is_verified(run):
    (name,) = run.parameters
    at = run.odometry.received[50]
    changed = (at, Changes(name, {'left_wheel_radius_multiplier': 1.1}, at))
    for unknown in ({'parameters': {}}, {'parameter_events': (changed,)}):
        verification = verify(replace(run, **unknown))
        assert verification.truth is None
        assert verification.holds(1e-9, 1e-9)
        assert any(note.startswith('ground_truth was not compared') for note in verification.notes)


def test_the_figure_shows_truth_and_odometry(run):
    drawn = run_figure([run])
    shown, *_ = (
        path
        for line in drawn.axes[0].lines
        if line.get_color() == COLOR and len(path := line.get_xydata()) > 1
    )
    # Broken where the robot was placed.
    assert np.count_nonzero(np.isnan(shown[:, 0])) == 1
    assert shown[~np.isnan(shown[:, 0])].tolist() == run.ground_truth.values[:, :2].tolist()
    labels = [text.get_text() for text in drawn.legends[0].get_texts()]
    assert 'where the robot truly was' in labels
