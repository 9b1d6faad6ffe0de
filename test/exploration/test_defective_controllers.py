"""What the twelve defective controllers do wrong is found, and nothing is found in the right one.

Each defect has one small world that shows it. `explore_defects.py` finds such worlds by itself.
"""

from __future__ import annotations

import pytest
from defective_controllers import DEFECTIVE, PROPERTIES, drive

from diffdrive_jacobian.faults import Duplicate, Hang, Loss, TimeJump
from diffdrive_jacobian.testing import Lockstep, PropertyViolation

GOAL = (0.0, (0.0, 0.0))
ONE_METRE = (1.0, 0.0, 0.0)
WORLDS = {
    'no odometry timeout': ({}, [Loss('odom', start=1.0, duration=2.0)], 'StopsAfterLostOdometry'),
    'wrong wrap of angles': ({}, [], 'StaysWithin'),
    'integrates dt wrongly': ({}, [Hang('controller', start=0.1, duration=0.3)], 'AccelerationWithin'),
    'ignores cancel': (
        {'cancel': 1.0},
        [Loss('odom', duration=2.0)],
        'NoCommandAfterCancel',
    ),
    'acts on stale goals': (
        {'cancel': 1.0},
        [Duplicate('goal_pose', seconds=2.0)],
        'NoStaleGoals',
    ),
    'assumes message order': ({}, [Loss('odom', duration=1.0)], 'TypeError'),
    'divides by distance': ({'start': (0.0, 0.0, 0.0)}, [], 'ZeroDivisionError'),
    'does not stop on shutdown': ({'shutdown': 1.0}, [], 'StopsOnShutdown'),
    'answers twice': ({'start': (0.0, 0.0, 1.0), 'cancel': 1.0}, [], 'StatusProtocol'),
    'drifts with lost messages': ({}, [Loss('odom', start=1.0, duration=0.4)], 'KeepsDriving'),
    'trusts stamps': (
        {},
        [Loss('odom', start=1.0), TimeJump(-5.0, start=1.2)],
        'StopsAfterLostOdometry',
    ),
    'overflows at pi': ({}, [], 'ArrivesOnceFaultsEnd'),
}


def run(controller, name):
    """Run the world of a defect with a controller."""
    case, faults, _ = WORLDS[name]
    quiet = {'start': ONE_METRE, 'goals': [GOAL], 'cancel': None, 'shutdown': None}
    with Lockstep(['--ros-args', '--disable-stdout-logs', '--disable-external-lib-logs']) as world:
        world.inject(*faults)
        world.require(*PROPERTIES)
        drive(world, {**quiet, 'controller': controller, **case})
        world.finish()


@pytest.mark.parametrize('name', DEFECTIVE)
def test_each_defect_is_found(name):
    by = WORLDS[name][2]
    with pytest.raises(Exception) as raised:  # noqa: PT011
        run(name, name)
    error = raised.value
    assert type(error.property if isinstance(error, PropertyViolation) else error).__name__ == by


@pytest.mark.parametrize('name', ['acts on stale goals', 'trusts stamps'])
def test_nothing_is_found_in_the_right_controller(name):
    run('no defect', name)
