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

"""Call a function of this folder in a fresh process: `call('lockstep', 'drive', side='bare')`.

As a program: `python child.py MODULE FUNCTION ARGUMENTS`, which prints the result; both are JSON.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

PATIENCE = 240.0
"""A child is killed after this long (s)."""


def start(
    module: str, function: str, *, prefix: Sequence[str] = (), **arguments: Any
) -> subprocess.Popen:
    """Start a child in a world of its own: no other process hears its nodes."""
    command = [*prefix, sys.executable, __file__, module, function, json.dumps(arguments)]
    environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def result(process: subprocess.Popen, patience: float = PATIENCE) -> Any:
    """Wait for a child and give what its function returned; it does not outlive its patience."""
    try:
        output, errors = process.communicate(timeout=patience)
    finally:
        process.kill()
        process.wait()
    if process.returncode != 0:
        raise RuntimeError(f'{process.args} ended with {process.returncode}:\n{errors}')
    return json.loads(output.splitlines()[-1])


def call(module: str, function: str, *, prefix: Sequence[str] = (), **arguments: Any) -> Any:
    """Start a child and wait for its result."""
    return result(start(module, function, prefix=prefix, **arguments))


if __name__ == '__main__':
    module, function, arguments = sys.argv[1:]
    answer = getattr(importlib.import_module(module), function)(**json.loads(arguments))
    print('\n' + json.dumps(answer))
