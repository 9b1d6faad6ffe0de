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

"""record_run killed: recover_run gets all but the last moment, and nothing wrong."""

from __future__ import annotations

import random
import signal

import pytest
from support.crashes import ALLOWED_LOSS, Control, crash, odometry
from support.raw_bags import recover

pytestmark = pytest.mark.process

NOTHING_TO_DO = 1
"""Exit code of recover_run for a complete bag."""


def test_killed_while_it_records_or_makes_the_bag(world, tmp_path, capsys):
    control = Control(world)
    loss, _ = crash(control, tmp_path / 'run', 0.2, lambda path: recover(capsys, path)[0])
    assert loss <= ALLOWED_LOSS
    bag = tmp_path / 'complete'
    recorder = control.record(bag)
    recorder.signal(signal.SIGINT)
    control.after(random.uniform(0.0, 0.1))
    recorder.signal(signal.SIGKILL)
    recorder.exit()
    # It appears whole or not at all; then its journal is there.
    expected = NOTHING_TO_DO if bag.exists() else 0
    assert recover(capsys, bag)[0] == expected
    found = odometry(bag)
    control.lost(found, found[-1])
