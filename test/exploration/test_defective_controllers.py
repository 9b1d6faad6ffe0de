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

"""What each defective controller does wrong is found, and nothing is found in the right one.

Each defect has one small world that shows it. `explore_defects.py` finds such worlds by itself.
"""

from __future__ import annotations

import pytest
from defective_controllers import ARRIVING, DEFECTIVE, PROPERTIES, RELATIONS, drive

from diffdrive_jacobian.faults import Duplicate, Hang, Loss, TimeJump
from diffdrive_jacobian.relations import Moved, Renamed, Repeated, Shifted, check_relation
from diffdrive_jacobian.testing import Lockstep, PropertyViolation

pytestmark = pytest.mark.slow
QUIET = ('--ros-args', '--disable-rosout-logs', '--disable-stdout-logs', '--disable-external-lib-logs')
WORLDS = {
    'no odometry timeout': (
        {},
        [Loss('odom', start=1.0, duration=2.0)],
        'StopsAfterLostOdometry',
    ),
    'wrong wrap of angles': ({}, [], 'StaysWithin'),
    'integrates dt wrongly': (
        {},
        [Hang('controller', start=0.1, duration=0.3)],
        'AccelerationWithin',
    ),
    'ignores cancel': ({'cancel': 1.0}, [Loss('odom', duration=2.0)], 'NoCommandAfterCancel'),
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
"""What is particular in a case, its faults, and the property or the exception that shows the defect."""


def run(controller, name):
    """Run the world of a defect with a controller."""
    particular, faults, _ = WORLDS[name]
    case = {
        'start': (1.0, 0.0, 0.0),
        'goals': [(0.0, (0.0, 0.0))],
        'cancel': None,
        'shutdown': None,
    }
    with Lockstep(QUIET) as world:
        world.inject(*faults)
        world.require(*PROPERTIES)
        drive(world, {**case, 'controller': controller, **particular})
        world.finish()


@pytest.mark.parametrize('name', DEFECTIVE)
def test_each_defect_is_found_by_a_property(name):
    with pytest.raises(Exception) as raised:  # noqa: PT011
        run(name, name)
    error = raised.value
    found = error.property if isinstance(error, PropertyViolation) else error
    assert type(found).__name__ == WORLDS[name][2]


@pytest.mark.parametrize('name', ['acts on stale goals', 'trusts stamps'])
def test_properties_find_nothing_in_the_right_controller(name):
    run('no defect', name)


SHOWN = {
    'wraps angles below -pi only': Moved(),
    'uses old odometry': Repeated('odom', after=0.12),
    'time in single precision': Shifted(),
    'absolute names': Renamed(),
}
"""The relation that shows a defect which no property shows."""


def related(controller, relation):
    """Compare a drive with a controller to two goals."""
    goals = [(0.2, (0.0, 0.0)), (2.0, (-1.0, 0.3))]
    case = {
        'start': (1.0, 0.5, 0.3),
        'goals': goals,
        'cancel': None,
        'shutdown': None,
    }
    check_relation(drive, relation, case={**case, 'controller': controller}, args=QUIET)


@pytest.mark.parametrize('name', ARRIVING)
def test_other_defects_are_found_by_a_relation(name):
    with pytest.raises(PropertyViolation):
        related(name, SHOWN[name])


@pytest.mark.parametrize('relation', RELATIONS, ids=repr)
def test_relations_find_nothing_in_the_right_controller(relation):
    related('no defect', relation)
