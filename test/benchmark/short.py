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

"""Every benchmark once, in its shortest form, so that none is broken unnoticed.

    python test/benchmark/short.py

CI runs it. The figures mean nothing: the machine is busy, and few values are measured. The flood of the
nodes has a test of its own. Exit code 1: a benchmark has failed, and what it printed is shown.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
COMMANDS = (
    ('run.py', '--quick'),
    ('calibration_cases.py', '--robots', '1', 'UMBmark'),
    ('explore_defects.py', '--worlds', '50', 'divides by distance'),
    ('drift.py', '--seeds', '20', '--limited'),
    ('inverse_kinematics.py', '--quick'),
    ('limiter.py',),
    ('overshoot.py', '--quick'),
    ('path_tracking.py', '--quick'),
    ('sampled_laws.py', '--robots', '2'),
    ('soak.py', '--minutes', '0.2'),
    ('uncertainty.py', '--quick'),
)
LIMIT = 900.0
"""Longest time for one (s)."""


def main() -> int:
    """Run them, and return the exit code."""
    failed = False
    for name, *options in COMMANDS:
        begin = time.monotonic()
        command = [sys.executable, str(HERE / name), *options]
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT
        )
        print(f'{name}: exit code {done.returncode}, {time.monotonic() - begin:.0f} s', flush=True)
        if done.returncode:
            failed = True
            print(done.stdout)
    return int(failed)


if __name__ == '__main__':
    sys.exit(main())
