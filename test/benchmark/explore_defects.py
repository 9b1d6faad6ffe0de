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

"""How many defects `explore` finds: those of `test/exploration/defective_controllers.py`.

    python test/benchmark/explore_defects.py  the twelve, and the right one, up to 1,000 worlds each
    python test/benchmark/explore_defects.py --worlds 100 'no defect' some of them

All controllers are tried in the same worlds and against the same properties. An
exploration stops at the first block of 50 worlds with a violation. The right controller runs in all
worlds. Exit code 1: a defect was not found, or the right controller violates something.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1] / 'exploration'))

from defective_controllers import (
    CONTROLLERS,
    DEFECTIVE,
    LAST_EVENT,
    PROPERTIES,
    drive,
)

from diffdrive_jacobian import faults
from diffdrive_jacobian.testing import explore, fault_schedules, numbers, points, poses

RIGHT = 'no defect'
SHRINK_WORLDS = 200
"""Most worlds to shrink one violation."""
KINDS = (
    *(faults.Loss, faults.Delay, faults.Stale, faults.Duplicate, faults.Reorder, faults.RateLimit),
    *(faults.Hang, faults.Kill, faults.Slow, faults.TimerJitter),
    *(faults.LateService, faults.ClockPause, faults.TimeJump),
)
HEAD = (
    '| defect | found | worlds | by | smallest case | worlds to shrink | s |',
    '|---|---|---|---|---|---|---|',
)


def schedules():
    """Return the strategy of the fault schedules."""
    return fault_schedules(
        topics=['odom', 'goal_pose', 'cmd_vel'],
        nodes=['controller', 'virtual_robot'],
        services=['cancel_goal'],
        kinds=KINDS,
        duration=LAST_EVENT,
    )


@st.composite
def goal_lists(draw):
    """Draw one goal, or two, one after the other."""
    first = draw(numbers(0.0, 3.0))
    goals = [(first, draw(points(1.0)))]
    if draw(st.booleans()):
        goals.append((round(first + draw(numbers(0.1, 3.0)), 1), draw(points(1.0))))
    return goals


def cases(controller):
    """Return the strategies of what happens to a controller."""
    moment = numbers(0.0, LAST_EVENT)
    never = st.none()
    return {
        'controller': st.just(controller),
        'start': poses(1.0),
        'goals': goal_lists(),
        # Most worlds go on to the end: there is more to see in them.
        'cancel': st.one_of(never, never, moment),
        'shutdown': st.one_of(never, never, never, never, moment),
    }


def explored(name, worlds, seed):
    """Explore the worlds of one controller, and shrink what is violated first."""

    def explored_for(properties, **kwargs):
        return explore(
            drive,
            properties,
            cases=cases(name),
            faults=schedules(),
            worlds=worlds,
            seed=seed,
            stop_at_first=name != RIGHT,
            **kwargs,
        )

    found = explored_for(PROPERTIES, shrink_worlds=0)
    if not found.findings:
        return found, None
    index = found.findings[0].violation.index
    first = [PROPERTIES[index]] if index >= 0 else []
    return found, explored_for(first, shrink_worlds=SHRINK_WORLDS).findings[0]


def row(name, exploration, finding, seconds):
    """Return the line of the table of one exploration."""
    if finding is None:
        return f'| {name} | no | {exploration.worlds} | | | | {seconds:.0f} |'
    case = finding.trial.case
    parts = [f'start {case["start"]}', f'goals {case["goals"]}']
    parts += [f'{what} at {case[what]:g} s' for what in ('cancel', 'shutdown') if case[what] is not None]
    parts += [f'`{fault!r}`' for fault in finding.trial.faults]
    by = finding.violation.name if finding.violation.index >= 0 else finding.violation.key
    return (
        f'| {name} | yes | {finding.first_world + 1} | {by} | {", ".join(parts)} | '
        f'{finding.shrink_worlds} | {seconds:.0f} |'
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument(
        'names',
        nargs='*',
        metavar='NAME',
        help='defects (default: those that violate a property, and none)',
    )
    parser.add_argument('--worlds', type=int, default=1000, help='worlds of each (default: 1000)')
    parser.add_argument('--seed', type=int, default=0, help='seed of everything random (default: 0)')
    chosen = parser.parse_args()
    if unknown := sorted(set(chosen.names) - set(CONTROLLERS)):
        parser.error(f'unknown defect {unknown[0]!r}; known: {", ".join(CONTROLLERS)}')
    failed = False
    print('\n'.join(HEAD))
    for name in chosen.names or (RIGHT, *DEFECTIVE):
        begin = time.monotonic()
        exploration, finding = explored(name, chosen.worlds, chosen.seed)
        print(row(name, exploration, finding, time.monotonic() - begin), flush=True)
        if bool(exploration.findings) != (name in DEFECTIVE):
            failed = True
            print(exploration, file=sys.stderr)
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
