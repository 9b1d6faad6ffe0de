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

"""Our nodes in a few explored worlds. doc/promises.md has what thousands of them gave."""

from __future__ import annotations

import pytest
import related_nodes
from exploration_scenarios import serial
from explored_nodes import SCENARIOS, properties

pytestmark = pytest.mark.slow


@pytest.mark.parametrize('name', SCENARIOS)
def test_nothing_is_found_in_our_nodes(name, tmp_path):
    scenario, cases, schedules = SCENARIOS[name]
    result = serial(scenario, properties(), cases=cases, faults=schedules, worlds=2, output=tmp_path)
    assert not result.findings, f'{result}\nsee {tmp_path}'
    assert result.worlds == 2
    assert result.faults > 0


@pytest.mark.parametrize('law', [None, 'dynamic_feedback'])
def test_relations_find_nothing_in_our_controller(law):
    cases, faults = related_nodes.cases(law), related_nodes.schedules()
    result = serial(
        related_nodes.driven, relations=related_nodes.RELATIONS, cases=cases, faults=faults, worlds=1
    )
    assert not result.findings, str(result)
    assert result.compared > 200
