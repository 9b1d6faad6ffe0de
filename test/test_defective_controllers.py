"""What the twelve defective controllers do wrong is found, and nothing is found in the right one.

Each defect has one world that shows it, as `explore_defects.py` or a tester finds it. `CONTROLLERS` has to
pass all of them where it has no defect.
"""

from __future__ import annotations

import pytest
from defect_scenario import PROPERTIES, drive
from defective_controllers import CONTROLLERS, DEFECTIVE

from diffdrive_jacobian.faults import Delay, Duplicate, Hang, Loss, TimeJump
from diffdrive_jacobian.properties import PropertyViolation

GOAL = (0.0, (0.0, 0.0))
ONE_METRE = (1.0, 0.0, 0.0)
WORLDS = {
    'no odometry timeout': ({}, [Loss('odom', start=1.0, duration=2.0)], 'StopsAfterLostOdometry'),
    'wrong wrap of angles': ({'start': (1.0, 0.0, 3.1)}, [], ''),
    'integrates dt wrongly': ({}, [Hang('controller', start=0.5, duration=0.3)], 'AccelerationWithin'),
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
    'drifts with lost messages': ({}, [Loss('odom', start=1.0, duration=0.4)], 'ArrivesOnceFaultsEnd'),
    'trusts stamps': ({}, [Loss('odom', start=1.0), TimeJump(-5.0, start=1.2)], ''),
    'overflows at pi': ({}, [], 'ArrivesOnceFaultsEnd'),
}
