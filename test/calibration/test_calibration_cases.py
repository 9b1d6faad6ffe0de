"""Calibrations of robots that other code simulates: cases of the benchmark, a drive in lockstep."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from calibration_data import umbmark
from support.lockstep_nodes import make_complete
from support.recorded import recorded
from support.ros_messages import twist

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmark'))

from calibration_cases import offenders, one_robot, table_row
from independent_robots import cramer_rao_bound, simulate

from diffdrive_jacobian.bags.run import read_run
from diffdrive_jacobian.bags.verification import verify
from diffdrive_jacobian.calibration import PARAMETERS, Geometry, calibrate
from diffdrive_jacobian.calibration.data import read_wheels_and_reference
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.testing import Lockstep


@pytest.mark.slow
@pytest.mark.parametrize(
    ('case', 'noted'),
    [
        ('encoder of 16 steps', False),
        ('skid', True),
        ('slip in tight turns', True),
        ('wheels at 4 Hz', True),
    ],
)
def test_no_value_is_wrong_without_a_note(case, noted):
    row = one_robot((case, 0))
    assert offenders([row]) == []
    assert table_row(case, [row])[1] == ('0, 1, 0' if noted else '1, 0, 0')


@pytest.mark.slow
def test_the_stated_deviations_are_those_of_an_independent_cramer_rao_bound():
    recordings, nominal, _ = simulate('encoder of 2000 steps', 1)
    found = calibrate(recordings, nominal)
    stated = np.diag(found.covariance)[:3] / found.multipliers**2
    np.testing.assert_allclose(
        stated**0.5, cramer_rao_bound('encoder of 2000 steps', 1) ** 0.5, rtol=0.2
    )


# --- The whole circle: a robot with wrong wheels drives UMBmark in lockstep, and its bag is calibrated

TRUE = (0.985, 1.01, 1.03)
WRONG = {f'true_{name}': value for name, value in zip(PARAMETERS, TRUE, strict=True)}
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


@pytest.mark.slow
def test_a_robot_is_calibrated_with_its_bag(tmp_path):
    nominal = Geometry(wheel_radius=0.033, wheel_separation=0.16)
    path, again = tmp_path / 'umbmark', tmp_path / 'again'

    def assert_true(found):
        sigma = np.sqrt(np.diag(found.covariance)[:3])
        assert found.undetermined == []
        assert np.all(np.abs(found.multipliers - TRUE) < 4.0 * sigma)
        assert np.all(sigma < 0.01)

    ends = [driven(path)]
    read = read_wheels_and_reference(path)
    assert read.reference_topic == '/ground_truth'
    found = calibrate([read.recording], nominal)
    assert_true(found)
    # Wheels that are driven with them bring the robot back, to where its odometry says.
    assumed = dict(zip(PARAMETERS, found.multipliers.tolist(), strict=True))
    ends.append(driven(again, assumed, **assumed))
    before, after = (max(math.hypot(x, y) for x, y, _ in one) for one in ends)
    assert before > 0.1
    assert after < before / 3.0
    apart = []
    for run in map(read_run, (path, again)):
        verification = verify(run)
        assert verification.truth is not None
        assert verification.holds(1e-9, 1e-9)
        apart.append(math.dist(run.odometry.values[-1, :2], run.ground_truth.values[-1, :2]))
    assert apart[1] < apart[0] / 3.0
    # The multipliers refer to the nominal dimensions, so that those of the robot are found again.
    assert_true(calibrate([read_wheels_and_reference(again).recording], nominal))
