"""The whole circle: a robot with wrong wheels drives UMBmark in lockstep, and its bag is calibrated."""

from __future__ import annotations

import math

import numpy as np
import pytest
from calibration_data import umbmark
from support.lockstep_nodes import make_complete
from support.recorded import recorded
from support.ros_messages import twist

from diffdrive_jacobian.bags.run_reader import read_run
from diffdrive_jacobian.bags.verification import verify
from diffdrive_jacobian.calibration import PARAMETERS, Geometry, calibrate
from diffdrive_jacobian.calibration.data import read_wheels_and_reference
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.testing import Lockstep

LEFT, RIGHT, SEPARATION = TRUE = 0.985, 1.01, 1.03
WRONG = {
    'true_left_wheel_radius_multiplier': LEFT,
    'true_right_wheel_radius_multiplier': RIGHT,
    'true_wheel_separation_multiplier': SEPARATION,
}
COMMANDS = umbmark(side=1.0, runs=1, speed=0.5, turn=2.0)


def driven(path, assumed=None, **multipliers):
    """Drive the squares through wheel_bridge and record them. Give where the robot truly was at the end
    of each. `assumed` are the multipliers of the robot, the others are those of the bridge."""
    with Lockstep() as world:
        drift = {'simulate_slip': True, 'slip_seed': 5, **WRONG}
        names = {'command_interface': 'wheels', 'cmd_vel_timeout': 0.0, 'publish_rate': 25.0}
        ends = []
        robot = make_complete(VirtualRobot, **names, **drift, **(assumed or {}))
        with recorded(world, path) as made:
            world.add(robot)
            world.add(make_complete(WheelBridge, cmd_vel_timeout=0.0, **multipliers))
            made.look()
            for duration, v, omega in COMMANDS:
                if v == omega == 0.0:
                    ends.append(robot.truth)
                world.publish('cmd_vel', twist(v, omega))
                world.run_for(duration)
        return np.array(ends)


@pytest.fixture(scope='module')
def uncalibrated(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags') / 'umbmark'
    return path, driven(path)


def test_the_multipliers_of_a_robot_come_out_of_its_bag(uncalibrated, tmp_path):
    path, ends = uncalibrated
    read = read_wheels_and_reference(path)
    assert read.reference_topic == '/ground_truth'
    found = calibrate([read.recording], Geometry(wheel_radius=0.033, wheel_separation=0.16))
    sigma = np.sqrt(np.diag(found.covariance)[:3])
    assert found.undetermined == []
    assert np.all(np.abs(found.multipliers - TRUE) < 4.0 * sigma)
    assert np.all(sigma < 0.01)
    # Wheels that are driven with them bring the robot back.
    left, right, separation = found.multipliers.tolist()
    again = driven(
        tmp_path / 'again',
        left_wheel_radius_multiplier=left,
        right_wheel_radius_multiplier=right,
        wheel_separation_multiplier=separation,
    )
    before, after = (max(math.hypot(x, y) for x, y, _ in one) for one in (ends, again))
    assert before > 0.1
    assert after < before / 3.0


def test_a_calibrated_robot_is_where_its_odometry_says(uncalibrated, tmp_path):
    path, _ = uncalibrated
    nominal = Geometry(wheel_radius=0.033, wheel_separation=0.16)
    found = calibrate([read_wheels_and_reference(path).recording], nominal)
    assumed = dict(zip(PARAMETERS, found.multipliers.tolist(), strict=True))
    again = tmp_path / 'again'
    driven(again, assumed, **assumed)
    apart = []
    for run in map(read_run, (path, again)):
        verification = verify(run)
        assert verification.truth is not None
        assert verification.holds(1e-9, 1e-9)
        off = run.odometry.values[-1, :2] - run.ground_truth.values[-1, :2]
        apart.append(math.hypot(*off))
    assert apart[1] < apart[0] / 3.0
    # The multipliers refer to the nominal dimensions, so that those of the robot are found again.
    second = calibrate([read_wheels_and_reference(again).recording], nominal)
    sigma = np.sqrt(np.diag(second.covariance))
    assert np.all(np.abs(second.multipliers - TRUE) < 4.0 * sigma)
