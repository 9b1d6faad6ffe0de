"""How many of twelve defects `explore` finds: the controllers of `defective_controllers.py`.

    python test/exploration/explore_defects.py  all of them, up to 1,000 worlds each
    python test/exploration/explore_defects.py --worlds 100 'no defect' some of them
    python test/exploration/explore_defects.py --page doc/exploration.md  write the table into a page

All controllers are tried in the same worlds and against the same properties. An
exploration stops at the first block of 50 worlds with a violation. The right controller runs in all
worlds. Exit code 1: a defect was not found, or the right controller violates something.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from defective_controllers import CONTROLLERS, DEFECTIVE, LAST_EVENT, PROPERTIES, drive
from hypothesis import strategies as st

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
TABLE = re.compile(r'(<!-- table: defects -->\n).*?(<!-- end -->)', re.DOTALL)


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


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('names', nargs='*', metavar='NAME', help='defects (default: all, and none)')
    parser.add_argument('--worlds', type=int, default=1000, help='worlds of each (default: 1000)')
    parser.add_argument('--seed', type=int, default=0, help='seed of everything random (default: 0)')
    parser.add_argument('--page', type=Path, help='page into which the table is written')
    chosen = parser.parse_args()
    if unknown := sorted(set(chosen.names) - set(CONTROLLERS)):
        parser.error(f'unknown defect {unknown[0]!r}; known: {", ".join(CONTROLLERS)}')
    if chosen.page is not None and not TABLE.search(chosen.page.read_text(encoding='utf-8')):
        parser.error(f'{chosen.page} has no <!-- table: defects --> ... <!-- end -->')
    return chosen


def main():
    chosen = arguments()
    lines, failed = list(HEAD), []
    print('\n'.join(HEAD))
    for name in chosen.names or CONTROLLERS:
        begin = time.monotonic()
        exploration, finding = explored(name, chosen.worlds, chosen.seed)
        lines.append(row(name, exploration, finding, time.monotonic() - begin))
        print(lines[-1], flush=True)
        if bool(exploration.findings) != (name in DEFECTIVE):
            failed.append(name)
            print(exploration, file=sys.stderr)
    if chosen.page is not None:
        table = '\n'.join(lines)
        page = chosen.page.read_text(encoding='utf-8')
        page = TABLE.sub(lambda match: f'{match[1]}{table}\n{match[2]}', page)
        chosen.page.write_text(page, encoding='utf-8')
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
