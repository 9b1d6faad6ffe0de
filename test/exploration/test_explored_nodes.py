"""Our nodes in a few explored worlds. doc/promises.md has what thousands of them gave."""

from __future__ import annotations

import pytest
from explored_nodes import SCENARIOS, client, properties

from diffdrive_jacobian import faults
from diffdrive_jacobian.exploration.trial import MessageDigest
from diffdrive_jacobian.testing import Lockstep, SerialExecutor, explore

WORLDS = 2


@pytest.mark.parametrize('name', SCENARIOS)
def test_nothing_is_found_in_our_nodes(name, tmp_path):
    scenario, cases, schedules = SCENARIOS[name]
    result = explore(
        scenario,
        properties(),
        cases=cases,
        faults=schedules,
        worlds=WORLDS,
        executor=SerialExecutor(),
        output=tmp_path,
    )
    assert not result.findings, f'{result}\nsee {tmp_path}'
    assert result.worlds == WORLDS
    assert result.faults > 0


def test_a_world_is_the_same_each_time():
    case = {'start': (0.0, 0.0, 0.0), 'goal': (0.3, 0.0, 0.0), 'timeout': 3.0, 'interrupted': 1.0}
    digests = set()
    for _ in range(2):
        with Lockstep() as world, MessageDigest(world) as messages:
            world.inject(faults.Loss('odom', probability=0.5, duration=1.0), seed=1)
            client(world, case)
            digests.add(messages.value())
    assert len(digests) == 1
