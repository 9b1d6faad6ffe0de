"""Bounds of the sampled laws, and the warnings of gains beyond them (doc/mathematics.md, Sampling).

`benchmark/sampled_laws.py` is the same with 10,000 robots.
"""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.lockstep_nodes import Controller, change
from support.ros_messages import goal

from diffdrive_jacobian.control import find_controller
from diffdrive_jacobian.control.goal_laws import by_shorter_turn

TOO_FAST = 'not below the odometry rate'


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
        stated = controller.slope(SimpleNamespace(kp=kp, kv=kv, offset=0.1))
        # Of go_to_goal it is Kp. Kv is what the bearing changes by while the robot drives.
        assert largest <= stated * (1.0 + 1e-6)
        assert stated <= largest + (kv if name == 'go_to_goal' else 0.15 * stated)


def test_by_shorter_turn_the_next_heading_is_the_same():
    omega, rate = np.random.default_rng(1).uniform(-1000.0, 1000.0, 1000), 50.0
    found = by_shorter_turn(omega, rate)
    assert np.abs(np.sin((found - omega) / rate / 2.0)).max() < 1e-12
    assert np.abs(found).max() <= 7.0 / 8.0 * math.tau * rate
    slow = np.abs(omega) < 270.0
    assert np.array_equal(found[slow], omega[slow])
    assert by_shorter_turn(314.0, rate) == pytest.approx(314.0 - math.tau * rate)


# --- The node


def drive(lockstep, controller, period, messages):
    """Send odometry of a robot that does not move, at that period."""
    for _ in range(messages):
        command = controller.at(0.0, 0.0)
        lockstep.run_for(period)
    return command


def test_gains_too_large_for_the_rate_are_warned_about_once(lockstep, capfd):
    controller = Controller(lockstep, odom_timeout=0.0, kp=25.0)
    controller.send(goal(5, 0))
    drive(lockstep, controller, 0.05, 10)
    assert TOO_FAST not in capfd.readouterr().err
    drive(lockstep, controller, 0.05, 12)
    controller.send(goal(4, 0))
    drive(lockstep, controller, 0.05, 12)
    logged = capfd.readouterr().err
    assert logged.count(TOO_FAST) == 1
    assert 'rate of 20 Hz' in logged


def test_the_bound_for_commands_up_to_one_sample_late_is_that_of_the_law(lockstep, capfd):
    controller = Controller(lockstep)
    controller.send(goal(5, 0))
    drive(lockstep, controller, 0.02, 12)
    for warned, gains in (
        (False, {'kp': 45.0, 'kv': 4.5}),
        (True, {'kp': 45.6, 'kv': 4.5}),
        (False, {'kp': 3.0, 'kv': 0.5, 'controller': 'pose'}),
        (True, {'kp': 10.0}),
        (False, {'kp': 55.0, 'controller': 'offset_point'}),
        (True, {'use_goal_heading': True}),
        (True, {'kp': 3.0, 'kv': 55.0}),
    ):
        assert change(controller.node, **gains).successful
        assert (TOO_FAST in capfd.readouterr().err) == warned, gains


def test_the_node_makes_no_whole_turns(lockstep):
    controller = Controller(lockstep, kp=40.0, odom_timeout=0.0)
    controller.send(goal(-5, 1))
    _, omega = drive(lockstep, controller, 0.1, 12)
    wanted = 40.0 * math.atan2(1.0, -5.0)
    assert wanted > 7.0 / 8.0 * math.tau * 10.0
    assert omega == pytest.approx(math.remainder(wanted / 10.0, math.tau) * 10.0)
