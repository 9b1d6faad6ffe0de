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

"""The test system knows no robot: the page for any node, where nothing of a robot can be imported."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys

import pytest
from documentation.pages import PAGES, blocks
from documentation.test_imports import FILES, PACKAGE, imports, place

OF_ROBOTS = ('nodes', 'simulation', 'kinematics', 'control', 'calibration')
ROOMS = ('lockstep', 'faults', 'properties', 'relations', 'exploration', 'testing')
# Python imports it first of all in every process, also in those that `explore` starts.
BLOCKER = f"""
import sys

class Blocker:
    def find_spec(self, name, *_):
        if name.startswith({tuple(f'{PACKAGE}.{one}' for one in OF_ROBOTS)}):
            raise ModuleNotFoundError(f'{{name}} is blocked', name=name)

sys.meta_path.insert(0, Blocker())
"""


@pytest.fixture
def folder(tmp_path):
    """Return a folder with the files of the page, as they are before anything is mended."""
    page = blocks(PAGES['doc/any_node.md'].read_text(encoding='utf-8'))
    for block in page:
        if block.file:
            (tmp_path / block.file).write_text(block.code, encoding='utf-8')
    (tmp_path / 'sitecustomize.py').write_text(BLOCKER)
    return tmp_path


def run(folder, *command):
    """Run Python in a folder, and return its exit code and what it printed."""
    paths = os.pathsep.join(filter(None, (str(folder), os.environ.get('PYTHONPATH', ''))))
    ended = subprocess.run(
        [sys.executable, *command],
        cwd=folder,
        env={**os.environ, 'PYTHONPATH': paths},
        capture_output=True,
        text=True,
    )
    return ended.returncode, ended.stdout + ended.stderr


@pytest.mark.process
def test_two_nodes_of_another_kind_are_tested_without_anything_of_a_robot(folder):
    code, printed = run(folder, '-c', f'import {PACKAGE}.nodes.virtual_robot')
    assert (code, 'is blocked' in printed) == (1, True)
    tests = shlex.split('-m pytest -q -p no:cacheprovider -p no:launch_testing --update-golden-runs')
    code, printed = run(folder, *tests)
    assert re.search(r'1 failed, 3 passed', printed), printed
    assert "FieldWithin('joint_states_filtered', 'position[0]', -1.0, 1.0) is violated at 1 s" in printed


def test_no_room_of_the_test_system_imports_anything_of_a_robot():
    """But for names that are imported on first use, and for type checkers."""
    for path in FILES:
        if place(path) in ROOMS and path.name != '__init__.py':
            ours = {name.split('.')[1] for name in imports(path) if name.startswith(f'{PACKAGE}.')}
            assert not ours & {*OF_ROBOTS, 'plots', 'drives', 'robot_testing'}, path
