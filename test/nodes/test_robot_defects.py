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

"""Defects of a simulated robot, which need no node: whatever has a robot and a time is a simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diffdrive_jacobian.nodes.robot_defects import RobotDefects
from diffdrive_jacobian.simulation.robot import Robot, RobotModel
from diffdrive_jacobian.simulation.slip import Drift

SECOND = 1_000_000_000


class Bench:
    """A robot that drives straight on, and what it is told."""

    def __init__(self):
        self.now = SECOND
        self.nominal = RobotModel()
        self.robot = Robot(model=self.nominal, stamp=0, pose=(0.0, 0.0, 0.0)).commanded((1.0, 0.0), 0)
        self.placed = []
        self.defects = RobotDefects(self)

    def time_and_robot(self):
        return self.now, self.robot

    def follow(self, robot):
        self.robot = robot

    def place(self, robot):
        self.robot = robot
        self.defects.placed(robot)
        self.placed.append(robot.pose_tuple)

    def remodel(self):
        model = self.defects.model(self.nominal)
        self.robot = self.robot.remodelled(model, self.now, wheels_commanded=False)

    def reported(self):
        return self.defects.reported(self.robot.at(self.now))


@pytest.fixture
def bench():
    return Bench()


def test_changes_apply_in_the_order_of_the_calls_until_they_end(bench):
    def with_radius(factor, offset=0.0):
        return lambda model: replace(model, wheel_radius=factor * model.wheel_radius + offset)

    start = bench.nominal.wheel_radius
    end_first = bench.defects.change(with_radius(0.0, 1.0))
    end_second = bench.defects.change(with_radius(2.0))
    assert bench.robot.model.wheel_radius == 2.0
    end_first()
    assert bench.robot.model.wheel_radius == 2.0 * start
    end_second()
    assert bench.robot.model == bench.nominal


def test_the_true_pose_is_not_forgotten_when_a_drift_ends(bench):
    assert bench.robot.model.drift is None
    drift = Drift(left_wheel_radius_multiplier=0.9)
    end = bench.defects.change(lambda model: replace(model, drift=drift))
    bench.now = 2 * SECOND
    end()
    assert bench.robot.model.drift == Drift()
    assert bench.robot.true_pose_tuple != bench.robot.pose_tuple


@pytest.mark.parametrize('noticed', [False, True])
def test_a_push_is_noticed_or_not(bench, noticed):
    bench.defects.push((0.0, 0.5, 0.0), noticed=noticed)
    truth, odometry = bench.robot.true_pose_tuple, bench.robot.pose_tuple
    assert truth == pytest.approx((1.0, 0.5, 0.0))
    assert odometry == pytest.approx(truth if noticed else (1.0, 0.0, 0.0))
    assert len(bench.placed) == noticed


def test_encoders_go_on_from_the_pose_of_those_before_or_where_the_odometry_is_placed(bench):
    bench.defects.set_encoders(4)
    bench.now += SECOND // 3
    before = bench.reported().pose_tuple
    bench.defects.set_encoders(5)
    assert bench.placed == [before]
    assert bench.reported().pose_tuple == before
    bench.place(bench.robot.placed(np.array([5.0, 5.0, 0.0]), np.zeros((3, 3)), bench.now))
    assert bench.defects.odometry_pose(bench.robot).tolist() == [5.0, 5.0, 0.0]
