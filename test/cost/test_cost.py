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

"""What one message costs, in counts: a loss of speed that no test of time would notice fails here.

Who raises a limit says why in the commit. Limits are those of today, with 1 % for bytecodes, and 5 % on
the executor, where a busy machine adds up to 4 %.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

COUNTS = Path(__file__).with_name('counts.py')
LIMITS = {
    # One odometry message of robot and controller in lockstep.
    'lockstep': {'calls': 109, 'functions': 76, 'files': 29},
    # The same on the executor of their programs; only functions of the package are counted.
    'executor': {'calls': 88, 'functions': 62, 'files': 24},
    # One step of a batch of 100 closed loops, with the equations of one robot on arrays.
    'batch': {'calls': 88, 'functions': 26, 'files': 7},
    # The start of a program: modules of the package, and all. A ROS installation may have fewer.
    'virtual_robot': {'own modules': 59, 'modules': 500},
    'go_to_goal': {'own modules': 77, 'modules': 502},
    'wheel_bridge': {'own modules': 59, 'modules': 495},
}
BYTECODES = {
    'lockstep': {(3, 10): 4400, (3, 11): 4520, (3, 12): 4245, (3, 13): 4035},
    'executor': {(3, 10): 4800, (3, 11): 4850, (3, 12): 4640, (3, 13): 4330},
    'batch': {(3, 10): 1935, (3, 11): 2050, (3, 12): 1855, (3, 13): 1710},
}
"""Limits by version of Python; others have none."""
SLACK = 0.08
"""Share of a limit by which a count may be below it. A limit that is too high would notice nothing."""
TRIES = 4


def counted(what: str) -> dict[str, float]:
    """Return the figures that `counts.py` prints."""
    program = what if 'modules' in LIMITS[what] else ''
    environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF', 'PROGRAM': program}
    command = [sys.executable, str(COUNTS), 'imports' if program else what]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    figures: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return figures


@pytest.mark.parametrize('what', LIMITS)
def test_a_message_costs_at_most_what_it_did(what):
    limits = dict(LIMITS[what])
    if what in BYTECODES and sys.version_info[:2] in BYTECODES[what]:
        limits['bytecodes'] = BYTECODES[what][sys.version_info[:2]]
    # In real time a busy machine may add something, but not each time.
    for _ in range(TRIES if what == 'executor' else 1):
        figures = counted(what)
        beyond = {
            name: (figures[name], limit) for name, limit in limits.items() if figures[name] > limit
        }
        if not beyond:
            break
    assert not beyond, f'{what}: beyond its limits: {beyond}'
    loose = {
        name: (figures[name], limit)
        for name, limit in limits.items()
        if name != 'modules' and figures[name] < (1.0 - SLACK) * limit
    }
    assert not loose, f'{what}: lower these limits, which would notice nothing: {loose}'
