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

"""Worlds in which our own controller is compared with its images: to goals, and along paths.

`test/benchmark/relations.py` runs a thousand of each.
"""

from __future__ import annotations

from explored_nodes import Operator, go_on_until
from hypothesis import strategies as st
from support.lockstep_nodes import make

from diffdrive_jacobian import faults
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.relations import Late, Mirrored, Moved, Renamed, Repeated, Shifted
from diffdrive_jacobian.testing import fault_schedules, goals, numbers, points, poses

LAWS = ('pure_pursuit', 'kanayama', 'offset_point', 'dynamic_feedback')
DISTURBED = 4.0
"""Time at which the last fault has ended (s)."""
RATE = 20.0
"""Rate of the odometry (Hz)."""
END = 6.0
"""End of a world (s)."""
KINDS = (
    *(faults.Loss, faults.Delay, faults.Stale, faults.Duplicate, faults.Reorder, faults.RateLimit),
    *(faults.Hang, faults.Kill, faults.Slow, faults.TimerJitter, faults.ClockPause, faults.TimeJump),
)
RELATIONS = (
    *(Moved(), Mirrored(), Shifted(), Renamed()),
    *(Repeated('odom'), Repeated('odom', after=0.12), Late('odom')),
)


def driven(world, case):
    """Send goals, or a path, to go_to_goal, and cancel them."""
    x, y, theta = map(float, case['start'])
    world.create(lambda: make(VirtualRobot, publish_rate=RATE, x=x, y=y, theta=theta))
    law = {} if case['law'] is None else {'path_controller': case['law']}
    world.create(lambda: make(GoToGoal, **law))
    operator = Operator(world)

    def script():
        for time, what in case['goals']:
            if case['law'] is None:
                yield time, 'goal', what
            else:
                yield time, 'path', [(x + float(dx), y + float(dy), 0.0) for dx, dy in what]
        if case['cancel'] is not None:
            yield case['cancel'], 'cancel', None

    for time, what, argument in sorted(script(), key=lambda action: action[0]):
        go_on_until(world, time)
        operator.do(what, argument)
    go_on_until(world, END)
    world.settle()


def cases(law):
    """Return the strategies of the cases of a path law; None: goals."""
    times = numbers(0.0, 3.0)
    along = st.lists(points(1.0), min_size=2, max_size=5, unique=True)
    what = goals(1.0) if law is None else along
    return {
        'law': st.just(law),
        'start': poses(1.0),
        'goals': st.lists(st.tuples(times, what), min_size=1, max_size=2),
        'cancel': st.one_of(st.none(), st.none(), times),
    }


def schedules():
    """Return the strategy of the fault schedules."""
    return fault_schedules(
        topics=['odom', 'goal_pose', 'path', 'cmd_vel'],
        nodes=['go_to_goal', 'virtual_robot'],
        services=['cancel_goal'],
        kinds=KINDS,
        duration=DISTURBED,
        max_faults=2,
    )
