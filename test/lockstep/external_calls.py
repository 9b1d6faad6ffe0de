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

"""How tests start nodes of `external_nodes`, send them numbers, and read what they answer."""

from __future__ import annotations

import sys
from pathlib import Path

from std_msgs.msg import Float64

SECOND = 1_000_000_000


def command(*names):
    """Return the command that starts a process with some nodes."""
    return [sys.executable, str(Path(__file__).with_name('external_nodes.py')), *names]


def send(world, name, *values):
    """Publish numbers on the input of a node."""
    for value in values:
        world.publish(f'{name}/in', Float64(data=float(value)))


def numbers(messages):
    """Return the numbers that nodes have published."""
    return [float(one.frame_id) for one in messages]


def stamp(message):
    """Return the time of a message of a node (ns)."""
    return message.stamp.sec * SECOND + message.stamp.nanosec
