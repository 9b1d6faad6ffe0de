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

"""In how many worlds relations find the defects of `test/exploration/defective_controllers.py`.

    python test/benchmark/relations.py  all defects in 100 worlds each, the right ones in 1,000
    python test/benchmark/relations.py --worlds 20 --right 50 'no defect'  some of them

Right are the controller without a defect, our own with goals, and our own with each law of paths. With
`--speed`, the worlds per second with and without relations, in one run. Exit code 1: nothing was found
in a controller with a defect that a relation can see, or something in a right one.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'exploration'))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import related_nodes
from defective_controllers import ARRIVING, CONTROLLERS, PROPERTIES, RELATIONS, drive
from explore_defects import RIGHT, cases, schedules

from diffdrive_jacobian.testing import explore

OWN = {'go_to_goal': None, **{f'go_to_goal, {law}': law for law in related_nodes.LAWS}}
"""Our controller, with goals or with a law of paths."""


def explored(name, worlds, relations, properties=()):
    """Explore the worlds of one controller."""
    if name in OWN:
        law = OWN[name]
        what = related_nodes.driven, related_nodes.cases(law), related_nodes.schedules()
    else:
        what = drive, cases(name), schedules()
    scenario, drawn, faults = what
    return explore(
        scenario,
        properties,
        relations=relations,
        cases=drawn,
        faults=faults,
        worlds=worlds,
        shrink_worlds=0,
    )


def row(name, result, relations):
    """Return the line of the table of one exploration."""
    counts = {finding.violation.key: finding.count for finding in result.findings}
    found = [str(counts.pop(repr(one), '')) for one in relations]
    errors = '; '.join(f'{key}: {count}' for key, count in counts.items())
    return f'| {name} | {result.worlds} | {" | ".join(found)} | {errors} | {result.rate:.1f} |'


def compare_speed(worlds):
    """Print the worlds per second of the right controller, with and without relations."""
    print('| | worlds/s |\n|---|---|')
    for what, relations in (('properties', ()), ('properties and relations', RELATIONS)):
        begin = time.monotonic()
        result = explored(RIGHT, worlds, relations, PROPERTIES)
        print(f'| {what} | {result.worlds / (time.monotonic() - begin):.1f} |', flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('names', nargs='*', metavar='NAME', help='controllers (default: all)')
    parser.add_argument('--worlds', type=int, default=100, help='worlds of each defect (default: 100)')
    parser.add_argument('--right', type=int, default=1000, help='of each right one (default: 1000)')
    parser.add_argument('--speed', action='store_true', help='compare with worlds without relations')
    chosen = parser.parse_args()
    known = {**OWN, **CONTROLLERS}
    if unknown := sorted(set(chosen.names) - set(known)):
        parser.error(f'unknown controller {unknown[0]!r}; known: {", ".join(known)}')
    if chosen.speed:
        compare_speed(chosen.worlds)
        return 0
    failed = False
    titles = {repr(one): one for one in RELATIONS}
    print(f'| | worlds | {" | ".join(f"`{one}`" for one in titles)} | exceptions | worlds/s |')
    print(f'|---|---|{"---|" * len(titles)}---|---|')
    for name in chosen.names or known:
        right = name in OWN or name == RIGHT
        relations = related_nodes.RELATIONS if name in OWN else RELATIONS
        result = explored(name, chosen.right if right else chosen.worlds, relations)
        print(row(name, result, RELATIONS), flush=True)
        if (right and result.findings) or (name in ARRIVING and not result.findings):
            failed = True
            print(result, file=sys.stderr)
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
