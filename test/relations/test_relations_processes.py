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

"""A node in another process under test."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from std_msgs.msg import Float64

from diffdrive_jacobian.relations import Late, Repeated, check_relation
from diffdrive_jacobian.testing import PropertyViolation

pytestmark = pytest.mark.process
PROGRAM = Path(__file__).parents[1] / 'lockstep' / 'external_nodes.py'


def answering(world, name):
    """Send three numbers to a node of a program."""
    world.start([sys.executable, str(PROGRAM), name])
    publisher = world.node.create_publisher(Float64, f'{name}/in', 10)
    for number in range(3):
        publisher.publish(Float64(data=float(number)))
        world.run_for(0.1)


@dataclass(frozen=True, repr=False)
class Twice(Repeated):
    """Looks at no worlds beside the image: each one starts a process."""

    def nearby(self, first):
        return []


def test_only_a_program_that_counts_is_found():
    check_relation(answering, Late('echo/in', 0.04), case='echo')
    with pytest.raises(PropertyViolation, match=r'is violated at 0\.05 s: /ticker'):
        check_relation(answering, Twice('ticker/in'), case='ticker')
