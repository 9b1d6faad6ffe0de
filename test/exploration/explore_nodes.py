"""Explore our own nodes.

python test/exploration/explore_nodes.py [--worlds 10000] [--output DIRECTORY]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from explored_nodes import SCENARIOS, properties

from diffdrive_jacobian.testing import explore


def main() -> int:
    """Explore both scenarios and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--worlds', type=int, default=10_000, help='number of worlds of each scenario')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--scenario', choices=tuple(SCENARIOS), help='only this one')
    parser.add_argument('--output', help='folder for what is found')
    options = parser.parse_args()
    found = False
    for name, (scenario, cases, schedules) in SCENARIOS.items():
        if options.scenario not in (None, name):
            continue
        output = options.output and f'{options.output}/{name}'
        result = explore(
            scenario,
            properties(),
            cases=cases,
            faults=schedules,
            worlds=options.worlds,
            seed=options.seed,
            output=output,
        )
        print(f'{name}: {result}')
        found |= bool(result.findings)
    return int(found)


if __name__ == '__main__':
    sys.exit(main())
