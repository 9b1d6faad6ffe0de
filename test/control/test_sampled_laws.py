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

"""Bounds of the sampled laws, and the warnings of gains beyond them (doc/mathematics.md, Sampling).

`benchmark/sampled_laws.py` is the same with 10,000 robots.
"""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.lockstep_nodes import Controller
from support.ros_messages import goal

from diffdrive_jacobian.control import VelocityLimits, find_controller, go_to_pose
from diffdrive_jacobian.control.goal_laws import by_shorter_turn
from diffdrive_jacobian.simulation import closed_loops


@pytest.fixture
def arrived(monkeypatch):
    """The simulation of the benchmark."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / 'benchmark'))
    import sampled_laws

    return sampled_laws.arrived


@pytest.mark.parametrize('law', ['turn in place', 'go_to_goal', 'pose', 'offset_point'])
def test_robots_arrive_within_the_bound(arrived, law):
    # With commands that take effect at once, and with the delay of a sample.
    for delay in (0.0, 1.0):
        assert arrived(law, 1.0, delay, 4).all(), delay
    if law == 'turn in place':
        assert arrived(law, 1.1, 0.0, 8).mean() < 0.8


@pytest.mark.parametrize('name', ['go_to_goal', 'pose'])
def test_the_slope_is_the_largest_that_the_yaw_rate_has_over_the_heading(name):
    controller = find_controller(name)
    alpha = np.linspace(-np.pi, np.pi, 401)[1:-1]
    phi = np.linspace(-np.pi, np.pi, 51)[1:-1, np.newaxis]
    pose = np.stack(np.broadcast_arrays(-np.cos(phi), -np.sin(phi), phi - alpha), axis=-1)
    step = np.array([0.0, 0.0, 1e-6])
    target = [0.0, 0.0, 0.0] if controller.takes_heading else [0.0, 0.0]
    for kp, kv in ((3.0, 0.5), (2.0, 0.5), (10.0, 0.1)):
        omega = [controller.law(pose + sign * step, target, kp, kv)[1] for sign in (1.0, -1.0)]
        largest = np.max((omega[1] - omega[0]) / 2e-6)
        stated = controller.slope(SimpleNamespace(kp=kp, kv=kv))
        # Of go_to_goal it is Kp. Kv is what the bearing changes by while the robot drives.
        assert largest <= stated * (1.0 + 1e-6)
        assert stated <= largest + (kv if name == 'go_to_goal' else 0.15 * stated)


@pytest.mark.parametrize(
    ('name', 'kp', 'limits', 'words'),
    [
        ('go_to_goal', 0.5, VelocityLimits(), ['choose kp > kv']),
        ('go_to_goal', 0.6, VelocityLimits(), []),
        ('pose', 1.0, VelocityLimits(), ['choose kp > 2 kv']),
        ('pose', 1.1, VelocityLimits(), []),
        ('offset_point', 0.1, VelocityLimits(min_v=0.0), ['may not back up']),
        ('offset_point', 0.1, VelocityLimits(), []),
    ],
)
def test_gains_and_limits_that_do_not_suit_are_warned_about(name, kp, limits, words):
    warnings = find_controller(name).warnings(SimpleNamespace(kp=kp, kv=0.5), limits)
    assert [word in one for word, one in zip(words, warnings, strict=True)] == [True] * len(words)


@pytest.mark.parametrize(
    ('name', 'kp', 'kv', 'turns', 'warned'),
    [
        ('go_to_goal', 45.0, 4.5, False, False),
        ('go_to_goal', 45.5, 4.5, False, True),
        ('pose', 10.0, 0.5, False, True),
        ('offset_point', 55.0, 0.5, False, False),
        ('offset_point', 55.0, 0.5, True, True),
        ('offset_point', 3.0, 55.0, True, True),
    ],
)
def test_a_slope_that_is_not_below_the_rate_is_warned_about(name, kp, kv, turns, warned):
    gains = SimpleNamespace(kp=kp, kv=kv)
    warnings = find_controller(name).rate_warnings(gains, 50.0, turns=turns)
    assert ['not below the odometry rate of 50 Hz' in one for one in warnings] == [True] * warned


def test_by_shorter_turn_the_next_heading_is_the_same():
    omega, rate = np.random.default_rng(1).uniform(-1000.0, 1000.0, 1000), 50.0
    found = by_shorter_turn(omega, rate)
    assert np.abs(np.sin((found - omega) / rate / 2.0)).max() < 1e-12
    assert np.abs(found).max() <= 7.0 / 8.0 * math.tau * rate
    slow = np.abs(omega) < 270.0
    assert np.array_equal(found[slow], omega[slow])
    assert by_shorter_turn(314.0, rate) == pytest.approx(314.0 - math.tau * rate)


def test_weights_with_which_it_would_turn_once_per_sample_for_ever_arrive():
    starts = np.random.default_rng(2).uniform([-3.0, -3.0, -3.0], 3.0, (10, 3))
    starts[0] = 2.6080, 1.8942, 2.0064
    h = np.array([[100.0], [215.0]])
    assert closed_loops(go_to_pose, starts, [0.0, 0.0, 0.0], 5.0, 1.0, h).arrived.all()


def test_the_node_makes_no_whole_turns(lockstep):
    controller = Controller(lockstep, kp=40.0, odom_timeout=0.0)
    controller.send(goal(-5, 1))
    for _ in range(12):
        _, omega = controller.at(0.0, 0.0)
        lockstep.run_for(0.1)
    wanted = 40.0 * math.atan2(1.0, -5.0)
    assert wanted > 7.0 / 8.0 * math.tau * 10.0
    assert omega == pytest.approx(math.remainder(wanted / 10.0, math.tau) * 10.0)
