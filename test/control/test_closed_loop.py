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

"""Closed loops in batches compared with robots of the nodes, and robots that get lost."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from diffdrive_jacobian.control import (
    Arrival,
    VelocityLimits,
    Waypoints,
    go_to_goal,
    go_to_pose,
    offset_point,
)
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel
from diffdrive_jacobian.simulation import Robot, RobotModel, closed_loop, closed_loops, trajectories
from diffdrive_jacobian.simulation.actuators import AccelerationLimits, Actuators, AxisLimits

pytestmark = pytest.mark.slow
R, L = 0.033, 0.16
MS = 1_000_000
FREE = VelocityLimits()
LIMITS = VelocityLimits(min_v=-0.5, max_v=0.7, min_omega=-4.0, max_omega=3.0, max_wheel_speed=24.0)
LAWS = {
    'go_to_goal': (lambda pose, to, Kp, Kv: go_to_goal(pose, to[..., :2], Kp, Kv), (6.0, 1.5)),
    'offset_point': (lambda pose, to, k, d: offset_point(pose, to[..., :2], k, d), (1.5, -0.2)),
    'pose': (go_to_pose, (6.0, 1.5)),
}


def random_batch(seed, *shape):
    box = np.array([1.0, 1.0, np.pi])
    return np.random.default_rng(seed).uniform(-box, box, (2, *shape, 3))


def alone(law, start, to, gains, arrival, actuators, steps):
    """Drive a robot of the nodes at 25 Hz; return its poses, and the time of its arrival (s)."""
    model = RobotModel(limits=LIMITS, actuators=actuators)
    robot, way = Robot(model=model, stamp=0, pose=start), Waypoints(to[np.newaxis])
    poses, time, command = [], math.nan, None

    def bound(pose, goal):
        return law(pose, np.array(goal), *gains)

    for step in range(steps):
        poses.append(robot.pose)
        if math.isnan(time):
            way, command = way.follow(robot.pose, bound, arrival, 3.0, robot.twist)
            time = math.nan if command else step / 25.0
        robot = robot.commanded(command or (0.0, 0.0), robot.stamp).at(robot.stamp + 40 * MS)
    return np.array(poses), time


def assert_same(found, expected):
    for name, one, other in zip(found._fields, found, expected, strict=True):
        assert_allclose(one, other, rtol=1e-9, atol=1e-9, err_msg=name)


def row(outcomes, index):
    return type(outcomes)(*(field[index] for field in outcomes))


SLOW = AccelerationLimits(
    v=AxisLimits(
        max_acceleration=1.0,
        max_deceleration=-1.5,
        max_acceleration_reverse=-0.7,
        max_deceleration_reverse=1.2,
    ),
    omega=AxisLimits(max_acceleration=12.0, max_deceleration=-16.0),
)
WHEELS = AccelerationLimits(max_wheel_acceleration=60.0)


@pytest.mark.parametrize('name', LAWS)
@pytest.mark.parametrize(
    'actuators',
    [
        Actuators(),
        Actuators(acceleration=SLOW),
        Actuators(acceleration=WHEELS, delay=40 * MS),
        Actuators(acceleration=SLOW, lag=0.02, delay=33 * MS),
    ],
    ids=['ideal', 'acceleration', 'delay', 'lag'],
)
def test_a_batch_is_each_of_its_robots_alone(name, actuators):
    law, gains = LAWS[name]
    starts, targets = 0.5 * random_batch(7, 3)
    targets[0] = starts[0]
    arrival = Arrival(
        use_heading=name == 'pose',
        offset=gains[1] if name == 'offset_point' else 0.0,
        trans_stopped_velocity=0.01,
        rot_stopped_velocity=0.05,
    )
    how = {'duration': 4.0, 'arrival': arrival, 'limits': LIMITS, 'rate': 25.0, 'actuators': actuators}
    gone = trajectories(law, starts, targets, *gains, **how)
    assert_same(closed_loops(law, starts, targets, *gains, **how), gone.outcomes)
    assert_allclose(gone.times, np.arange(len(gone.poses)) / 25.0, rtol=1e-12)
    for index, (start, to) in enumerate(zip(starts, targets, strict=True)):
        poses, time = alone(law, start, to, gains, arrival, actuators, len(gone.poses))
        assert_allclose(gone.outcomes.time[index], time, rtol=1e-12)
        assert_allclose(se2.log(se2.compose(se2.inverse(poses), gone.poses[:, index])), 0.0, atol=2e-9)
    assert gone.outcomes.arrived.any()
    # A single robot is a batch without axes.
    single = closed_loops(law, starts[1], targets[1], *gains, **how)
    assert [np.shape(field) for field in single] == [()] * 5 + [(3,)]
    assert_same(single, row(gone.outcomes, 1))


def test_outcomes_are_those_of_the_trajectory():
    starts, targets = random_batch(1, 3)
    found = trajectories(go_to_pose, starts, targets, 6.0, 1.5, arrival=Arrival(use_heading=True))
    (v, omega), outcomes = np.moveaxis(found.twists, -1, 0), found.outcomes
    assert_allclose(outcomes.path_length, np.abs(v).sum(axis=0) / 50.0)
    wheels = np.stack(body_to_wheel(v, omega, R, L))
    assert_allclose(outcomes.control_cost, (wheels**2).sum(axis=(0, 1)) / 50.0)
    along = (targets - starts)[:, :2]
    beyond = ((found.poses - targets)[..., :2] * along).sum(axis=-1).max(axis=0)
    beyond /= np.linalg.norm(along, axis=-1)
    assert_allclose(outcomes.overshoot, np.maximum(beyond, 0.0), atol=1e-12)
    assert np.array_equal(outcomes.pose, found.poses[-1])


def test_starts_gains_robots_limits_and_offsets_broadcast():
    starts, targets = random_batch(5, 2, 1, 1, 1)
    k, d = np.array([[[0.8]], [[2.0]]]), np.array([[0.1], [-0.3]])
    r, separation, max_v = np.array([0.02, 0.05]), np.array([0.2, 0.1]), np.array([[0.3], [np.inf]])
    min_omega = np.array([[[[-0.5]]], [[[-np.inf]]]])

    def drive(start, goal, k, d, r, L, max_v, min_omega):
        limits = VelocityLimits(max_v=max_v, min_omega=min_omega, max_wheel_speed=9.0)
        how = {'arrival': Arrival(offset=d), 'limits': limits, 'duration': 3.0, 'rate': 10.0}
        return closed_loops(offset_point, start, goal[..., :2], k, d, r=r, L=L, **how)

    found = drive(starts, targets, k, d, r, separation, max_v, min_omega)
    assert found.time.shape == (2, 2, 2, 2)
    for i, j, m, n in np.ndindex(2, 2, 2, 2):
        place = starts[i, 0, 0, 0], targets[i, 0, 0, 0], k[j, 0, 0], float(d[m, 0])
        one = drive(*place, r[n], separation[n], float(max_v[m, 0]), float(min_omega[i, 0, 0, 0]))
        assert_same(row(found, (i, j, m, n)), one)
    assert len(np.unique(found.control_cost)) > 10


def test_neither_order_nor_block_size_matters_and_steps_are_reported(monkeypatch):
    starts, targets = random_batch(6, 5)
    Kp, arrival = np.linspace(6.0, 12.0, 5), Arrival(use_heading=True)

    def drive(order, drive=closed_loops, **more):
        rows = starts[order], targets[order], Kp[order], 2.0
        how = {'limits': LIMITS, 'arrival': arrival, 'duration': 4.0, 'rate': 25.0}
        return drive(go_to_pose, *rows, **how, **more)

    expected = drive(np.arange(5))
    assert not expected.arrived.all()
    monkeypatch.setattr(closed_loop, 'BLOCK', 3)
    order = np.random.default_rng(7).permutation(5)
    progress, steps = [], []
    found = drive(order, progress=progress.append, on_step=steps.append)
    assert_same(found, [field[order] for field in expected])
    assert_same(drive(order, trajectories).outcomes, [field[order] for field in expected])
    assert progress == sorted(progress)
    assert progress[-1] == 5
    # One that never arrives takes all 100 steps and the sample after the last one.
    assert steps == sorted(steps)
    assert 101 <= len(steps) <= 101 * 2


# --- Who does not arrive, and who is there


def test_who_never_arrives_has_no_time_and_is_where_the_time_ran_out():
    targets = [[0.5, 0.0], [9.0, 0.0], [-1.0, 0.0]]
    found = closed_loops(lambda pose, to: (0.1, 0.0), np.zeros((3, 3)), targets, duration=10.0)
    assert found.arrived.tolist() == [True, False, False]
    assert_allclose(found.time, [4.8, np.nan, np.nan])
    assert_allclose(found.pose[:, 0], [0.48, 1.0, 1.0])


def test_a_law_that_diverges_has_not_arrived_and_leaves_its_company_alone():
    """A gain beyond twice the rate."""
    starts, targets = random_batch(8, 5)
    lost, gains = np.arange(5) == 2, np.full(5, 0.3)
    tame = closed_loops(go_to_goal, starts, targets[:, :2], 3.0, gains, duration=5.0)
    gains[lost] = 1e4
    for drive in (closed_loops, trajectories):
        found = drive(go_to_goal, starts, targets[:, :2], 3.0, gains, duration=5.0)
        found = found.outcomes if drive is trajectories else found
        assert not found.arrived[lost]
        assert np.isnan(found.time[lost])
        assert np.isfinite(found.pose).all()
        assert_same(row(found, ~lost), row(tame, ~lost))


def test_who_has_driven_away_a_thousand_kilometres_is_given_up():
    how = {'rate': 1.0, 'duration': 1e4}
    found = closed_loops(lambda pose, to: (1e3, 0.0), np.zeros(3), [-1.0, 0.0], **how)
    assert not found.arrived
    assert found.pose[0] == pytest.approx(1e6, abs=2e3)


def test_who_is_there_has_no_use_for_the_law_any_more():
    """Which may know no direction there."""

    def straight(poses, goals):
        distance = goals[:, 0] - poses[:, 0]
        return np.where(np.abs(distance) > 0.02, np.sign(distance), np.nan), 0.0

    starts = np.array([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
    found = closed_loops(straight, starts, [0.0, 0.0])
    assert found.arrived.all()
    assert_allclose(found.time, [0.0, 0.98, 1.98], atol=0.021)


def test_a_controller_has_its_default_gains_its_heading_and_its_point():
    start, goal = [0.0, 0.0, 0.0], [1.0, 0.0, 2.0]
    defaults = closed_loops('go_to_goal', start, goal[:2])
    assert_same(defaults, closed_loops(go_to_goal, start, goal[:2], 3.0, 0.5))
    found = closed_loops('pose', start, goal, 1.0, 1.0)
    assert found.arrived
    assert abs(found.pose[2] - 2.0) <= 0.02
    offset = closed_loops('offset_point', start, goal[:2], 0.5, 0.3)
    assert offset.arrived
    assert offset.pose[0] == pytest.approx(0.7, abs=0.03)


def test_an_empty_batch_is_an_empty_result():
    for shape in ((0,), (3, 0)):
        batch = np.zeros((*shape, 3)), [1.0, 0.0]
        found = closed_loops(go_to_goal, *batch, 3.0, 0.5)
        assert [field.shape for field in found] == [shape] * 5 + [(*shape, 3)]
        gone = trajectories(go_to_goal, *batch, 3.0, 0.5)
        assert gone.times.tolist() == [0.0]
        assert (gone.poses.shape, gone.twists.shape) == ((1, *shape, 3), (0, *shape, 2))


# --- Bad input, besides what kinematics/test_arguments.py shows


def test_a_law_that_returns_something_else_is_named():
    for twist in (
        *(None, 1.0, (1.0, 2.0, 3.0), 'vw', (1j, 0.0), (np.zeros(3), 0.0), (0.0, [[1.0], [2.0]])),
        *((math.nan, 0.0), (0.0, math.inf), (np.array([0.0, np.nan]), 0.0)),
    ):
        for limits in (FREE, LIMITS):
            arguments = (lambda *_, twist=twist: twist), np.zeros((2, 3)), [1, 0]
            with pytest.raises(ValueError, match=r'^law must .*got'):
                closed_loops(*arguments, limits=limits)


@pytest.mark.parametrize('drive', [closed_loops, trajectories])
@pytest.mark.parametrize(
    ('name', 'gains', 'options'),
    [
        *(('gain 1', (3.0, bad), {}) for bad in (np.nan, np.ones(3), 'much')),
        ('max_v', (3.0, 0.5), {'limits': VelocityLimits(max_v=np.ones(3))}),
        ('offset', (3.0, 0.5), {'arrival': Arrival(offset=np.ones(3))}),
        ('goals', (3.0, 0.5), {'arrival': Arrival(use_heading=True)}),
        ('finite outcomes', (3.0, 0.5), {'r': 1e-160}),
        ('max_right_speed', (3.0, 0.5), {'actuators': Actuators(max_right_speed=1.0)}),
        ('law rejects the starts, goals and gains: go_to_goal: missing', (3.0,), {}),
    ],
)
def test_invalid_gains_and_options_are_named(drive, name, gains, options):
    with pytest.raises(ValueError, match=rf'\b{name}\b'):
        drive(go_to_goal, np.zeros((2, 3)), [1.0, 0.0], *gains, **options)


def test_an_unknown_option_is_a_type_error():
    with pytest.raises(TypeError, match=r"^trajectories\(\) got an unexpected .* 'rat'"):
        trajectories('go_to_goal', [0.0, 0.0, 0.0], [1.0, 0.0], rat=3.0)


# --- Commands that act late


def test_a_command_that_acts_after_the_duration_does_not_move_the_robot():
    def drive(delay):
        how = {'duration': 2.0, 'actuators': Actuators(delay=delay)}
        return closed_loops('go_to_goal', [0.0, 0.0, 0.0], [1.0, 0.0], **how)

    assert drive(10**9 * MS).pose.tolist() == [0.0, 0.0, 0.0]
    # Two samples before the end the first command acts, with a speed of `kv` (0.5) times 1 m.
    assert_allclose(drive(1960 * MS).pose, [0.02, 0.0, 0.0], atol=1e-12)
