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

"""The true motion of a robot that slips, or whose wheels are not as nominal."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest

from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.kinematics.diff_drive import wheel_to_body
from diffdrive_jacobian.simulation import Actuators, Robot, RobotModel
from diffdrive_jacobian.simulation.slip import CELL, Drift, _block, normals

SECOND = 1_000_000_000


def robot(stamp=0, variance=1e-5, **drift):
    model = RobotModel(wheel_travel_variance=variance, drift=Drift(**drift))
    return Robot(model=model, stamp=stamp, pose=(0.0, 0.0, 0.0))


def driven(start, commands, end):
    for twist, stamp in commands:
        start = start.commanded(twist, stamp)
    return start.at(end)


def irregular(seed, count, longest=30_000_000):
    """Commands at irregular times: straight, arcs, in place, and stops."""
    generator = np.random.default_rng(seed)
    stamps = np.cumsum(generator.integers(1, longest, count)).tolist()
    twists = [(0.2, 0.0), (0.2, 1.0), (0.0, -2.0), (0.0, 0.0), (-0.1, 0.3), (0.08, 1.0)]
    return [(twists[index % 6], stamp) for index, stamp in enumerate(stamps)]


def test_the_generator_is_philox_with_seed_and_wheel_as_key_and_the_cell_as_counter():
    """The first words for key 0 and counter 0 are those that its authors published."""
    first, second = 0x16554D9ECA36314C, 0xDB20FE9D672D0FDC
    radius = math.sqrt(-2.0 * math.log(((first >> 11) + 1) / 2**53))
    expected = radius * math.cos(2.0 * math.pi * (second >> 11) / 2**53)
    assert normals(0, 0, 0)[0] == pytest.approx(expected, rel=1e-15)
    for seed, cell in ((7, 5), (7, 256), (3, 123_456), (2**63 - 1, 1_700_000_000 * 50)):
        for wheel in (0, 1):
            words = np.random.Philox(key=[seed, wheel], counter=[cell - 1, 0, 0, 0]).random_raw(2)
            u, w = (int(word) >> 11 for word in words)
            expected = math.sqrt(-2.0 * math.log((u + 1) / 2**53)) * math.cos(math.tau * (w / 2**53))
            assert normals(seed, 0, cell)[wheel] == expected
    # Negative times and wide cells have numbers of their own.
    cells = [(level, cell) for level in (0, 1, 20) for cell in (-257, -256, -255, -1, 0, 1, 255, 256)]
    found = {number for level, cell in cells for number in normals(5, level, cell)}
    assert len(found) == 2 * len(cells)


# --- The same motion however it is computed


@pytest.mark.parametrize('drift', [{'seed': 3}, {'right_wheel_radius_multiplier': 1.01}], ids=str)
def test_the_truth_does_not_depend_on_when_it_is_computed(drift):
    commands = irregular(1, 15)
    end = commands[-1][1] + SECOND
    expected = driven(robot(**drift), commands, end)
    generator = np.random.default_rng(2)
    asked = robot(**drift)
    for (twist, stamp), (_, later) in pairwise([*commands, (None, end)]):
        asked = asked.commanded(twist, stamp)
        # In any order, and again after the numbers were forgotten.
        for one in generator.integers(stamp, later, 3, endpoint=True).tolist():
            asked.at(one)
            _block.cache_clear()
    asked = asked.at(end)
    assert (asked.true_pose_tuple, asked.true_twist) == (expected.true_pose_tuple, expected.true_twist)
    assert expected.true_pose_tuple != expected.pose_tuple


def test_odometry_is_that_of_a_perfect_robot():
    commands = irregular(4, 20)
    end = commands[-1][1] + SECOND
    slipping = driven(robot(seed=1, wheel_separation_multiplier=1.1), commands, end)
    perfect = driven(Robot(model=RobotModel(), stamp=0, pose=[0, 0, 0]), commands, end)
    assert slipping.pose_tuple == perfect.pose_tuple == perfect.true_pose_tuple
    assert slipping.covariance_tuple == perfect.covariance_tuple
    assert slipping.wheel_angles == perfect.wheel_angles
    assert perfect.true_twist == perfect.twist


def test_a_robot_at_rest_does_not_slip_after_the_cell_in_which_it_stopped():
    stopped = driven(robot(seed=1), [((0.2, 0.0), 0), ((0.0, 0.0), SECOND + 3)], SECOND + 3)
    assert stopped.true_twist != (0.0, 0.0)
    moved = stopped.at(SECOND + CELL)
    assert moved.true_pose_tuple != stopped.true_pose_tuple
    later = moved.at(3600 * SECOND)
    assert later.true_pose_tuple == moved.true_pose_tuple
    assert later.true_twist == (0.0, 0.0)


def test_a_wheel_at_rest_does_not_slip():
    """The left one, about which the robot turns, also if it is inexact by the rounding of the twist."""
    turned = driven(robot(seed=1), [((0.16, 2.0), 0)], SECOND // 10)
    _, _, theta = turned.true_pose_tuple
    x, y = 0.08 * math.sin(theta), 0.08 - 0.08 * math.cos(theta)
    assert turned.true_pose[:2] == pytest.approx([x, y], abs=1e-12)


def test_a_timeout_stops_the_truth_as_well():
    model = RobotModel(command_timeout=SECOND // 2, drift=Drift(seed=1))
    commanded = Robot(model=model, stamp=0, pose=[0, 0, 0]).commanded((0.2, 0.0), 5)
    expiry = SECOND // 2 + 5
    stopped = driven(robot(seed=1), [((0.2, 0.0), 5), ((0.0, 0.0), expiry)], expiry)
    for later in (expiry, expiry + 1000, SECOND):
        assert commanded.at(later).true_pose_tuple == stopped.at(later).true_pose_tuple


def test_a_robot_that_is_restarted_does_not_slip_on():
    """Also not one that was under way to another speed."""
    model = RobotModel(drift=Drift(seed=1), actuators=Actuators(lag=0.1))
    moving = Robot(model=model, stamp=0, pose=(0, 0, 0)).commanded((0.2, 1.0), 0).at(105_000_000)
    restarted = moving.restarted(0)
    assert restarted.true_twist == (0.0, 0.0)
    assert restarted.at(SECOND).true_pose_tuple == moving.true_pose_tuple


def test_a_nanosecond_does_not_change_what_was_slipped():
    """Whatever the seconds between two commands round to, which are in one cell or two."""
    begin = 5 * CELL - 2_414_970
    for offset in (12_516_919, *np.random.default_rng(9).integers(1, 3 * CELL, 40).tolist()):
        first, second = (
            driven(robot(seed=3), [((0.5, 0.0), begin), ((0.5, 0.1), begin + at)], 9 * CELL).true_pose
            for at in (offset, offset + 1)
        )
        np.testing.assert_allclose(first, second, rtol=0.0, atol=1e-8)


# --- What the noise is


def test_the_slip_in_a_cell_has_the_variance_of_its_distance_whatever_the_commands():
    """Divided by xi, the slip of the whole cell is the square root of k |ds|."""
    k, cell, offsets = 1e-5, 50, (0, 3_000_000, 3_000_001, 11_000_000, 19_000_000)
    begin, end = cell * CELL, (cell + 1) * CELL
    start, durations = robot(begin, seed=4), np.diff([*offsets, CELL]) * 1e-9
    for speeds in ((0.1, 0.3, 0.3, -0.05, 0.9), (0.3, 0.0, 0.3, 0.0, 0.3), (0.0,) * 5):
        commands = [((v, 0.0), begin + offset) for v, offset in zip(speeds, offsets, strict=True)]
        state = driven(start, commands, end)
        # The path is so short that the slip adds up along x.
        along, _, turn = state.true_pose - state.pose
        half = turn * state.model.wheel_separation / 2.0
        expected = math.sqrt(k * float(np.abs(speeds) @ durations))
        for slipped, xi in zip((along + half, along - half), normals(4, 0, cell), strict=True):
            assert slipped / xi == pytest.approx(expected, rel=1e-4)


def test_the_same_command_again_changes_nothing_but_rounding(monkeypatch):
    """Also in the wide cells of a command that is held for long."""
    monkeypatch.setattr('diffdrive_jacobian.simulation.slip.HOLD', SECOND // 2)
    begin = 123_456_789
    once = driven(robot(seed=8), [((0.2, 0.4), begin)], 3 * SECOND)
    often = [((0.2, 0.4), stamp) for stamp in range(begin, 3 * SECOND, 17_777_777)]
    repeated = driven(robot(seed=8), often, 3 * SECOND)
    np.testing.assert_allclose(repeated.true_pose, once.true_pose, rtol=0.0, atol=1e-13)


def test_the_true_pose_is_the_integral_of_the_true_twist(monkeypatch):
    """Within a cell, also after some commands in it, and in the wide cells of a long time."""
    monkeypatch.setattr('diffdrive_jacobian.simulation.slip.HOLD', SECOND)
    start = robot(seed=6, variance=1e-3, left_wheel_radius_multiplier=0.97)
    held = start.commanded((0.2, 0.3), 5)
    states = [held.at(stamp) for stamp in np.geomspace(10, 50 * SECOND, 12).astype(int).tolist()]
    commands = irregular(7, 20)
    states += [driven(start, commands[:count], commands[count - 1][1]) for count in range(1, 20)]
    for state in states:
        # A nanosecond crosses no boundary of cells here.
        x, y, theta = state.at(state.stamp + 1).true_pose - state.true_pose
        v, omega = state.true_twist
        assert math.hypot(x, y) == pytest.approx(abs(v) * 1e-9, abs=2e-14)
        assert math.remainder(theta, math.tau) == pytest.approx(omega * 1e-9, abs=2e-14)


def test_nees_against_the_odometry_is_three():
    """Of 60 seeds. The standard error of the mean is sqrt(6 / 60)."""
    values = []
    for seed in range(60):
        state = driven(robot(seed=seed), irregular(5, 25), SECOND)
        error = state.true_pose - state.pose
        error[2] = math.remainder(error[2], math.tau)
        values.append(error @ np.linalg.solve(state.covariance, error))
    assert np.mean(values) == pytest.approx(3.0, abs=1.0)


# --- Wheels that are not as nominal


def test_wheels_of_other_radii_and_separation_move_as_the_jacobian_says():
    right, left, separation = 1.02, 0.99, 1.05
    start = robot(
        right_wheel_radius_multiplier=right,
        left_wheel_radius_multiplier=left,
        wheel_separation_multiplier=separation,
    )
    state = driven(start, [((0.2, 0.3), 0)], 4 * SECOND)
    omega_R, omega_L = state.wheel_speeds
    # Wheels of one radius, turning as much faster as their radius is larger.
    wheels = state.model.wheel_radius, separation * state.model.wheel_separation
    twist = wheel_to_body(right * omega_R, left * omega_L, *wheels)
    assert state.true_twist == pytest.approx(twist, rel=1e-14)
    np.testing.assert_allclose(state.true_pose, se2.integrate([0, 0, 0], twist, 4.0), rtol=1e-13)


def test_placing_moves_the_robot_and_resetting_its_odometry_does_not():
    moved = driven(robot(seed=1), [((0.2, 0.1), 0)], SECOND)
    placed = moved.placed([5.0, 6.0, 1.0], np.zeros((3, 3)), SECOND)
    assert placed.true_pose_tuple == placed.pose_tuple == (5.0, 6.0, 1.0)
    reset = moved.placed([5.0, 6.0, 1.0], np.zeros((3, 3)), SECOND, odometry_only=True)
    assert reset.pose_tuple == (5.0, 6.0, 1.0)
    assert reset.true_pose_tuple == moved.true_pose_tuple
    assert reset.at(2 * SECOND).true_pose_tuple == moved.at(2 * SECOND).true_pose_tuple


def test_the_robot_stays_where_it_is_when_its_drift_changes():
    moved = driven(robot(seed=1), [((0.2, 0.1), 0)], SECOND)
    other = dataclasses.replace(moved.model, drift=Drift(seed=2))
    changed = moved.remodelled(other, SECOND)
    assert changed.true_pose_tuple == moved.true_pose_tuple
    assert changed.at(2 * SECOND).true_pose_tuple != moved.at(2 * SECOND).true_pose_tuple
    perfect = moved.remodelled(RobotModel(), SECOND)
    assert perfect.true_pose_tuple == perfect.pose_tuple
    assert perfect.remodelled(other, SECOND).true_pose_tuple == perfect.pose_tuple


# --- Long times


def test_a_command_that_is_held_for_long_takes_few_steps(monkeypatch):
    """For a time in cells of the usual width, then half as many for each doubling of the time."""
    hold, steps = 10 * SECOND, []
    monkeypatch.setattr('diffdrive_jacobian.simulation.slip.HOLD', hold)
    monkeypatch.setattr(
        'diffdrive_jacobian.simulation.slip.normals', lambda *cell: steps.append(cell) or (0.1, -0.1)
    )
    commanded = robot(seed=1).commanded((0.2, 0.1), 5)
    commanded.at(hold)
    assert len(steps) == hold // CELL
    commanded.at(16 * hold)
    assert len(steps) == pytest.approx(3 * hold // CELL, rel=0.02)
    before = len(steps)
    commanded.at(16 * hold + CELL)
    assert len(steps) == before + 1


def test_wide_cells_have_the_same_variance(monkeypatch):
    """The turn of a robot that drives straight has the variance 2 k |ds| / L^2."""
    monkeypatch.setattr('diffdrive_jacobian.simulation.slip.HOLD', SECOND // 4)
    turns = []
    for seed in range(60):
        commanded = robot(seed=seed).commanded((0.1, 0.0), 0)
        turns.append(commanded.at(16 * SECOND).true_pose[2] - commanded.at(8 * SECOND).true_pose[2])
    # The standard error of the ratio is sqrt(2 / 60).
    ratio = np.mean(np.square(turns)) / (2.0 * 1e-5 * 0.1 * 8.0 / 0.16**2)
    assert ratio == pytest.approx(1.0, abs=0.7)


def test_a_seed_out_of_range_and_a_motion_that_overflows_are_refused():
    for seed in (1.5, '1', -1, 2**63, True):
        with pytest.raises(ValueError, match=r'^seed must be an integer from 0 to 9223372036854775807'):
            Drift(seed=seed)
    with pytest.raises(ValueError, match='overflow'):
        driven(robot(right_wheel_radius_multiplier=1e200), [((1e200, 0.0), 0)], SECOND)
