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

"""What other distributions add by entry points: kinds of faults, and pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, EntryPoints, entry_points

import pytest
from hypothesis import find
from hypothesis import strategies as st
from rclpy.node import Node

from diffdrive_jacobian.exploration import extensions
from diffdrive_jacobian.exploration.scenario import ExplorationError
from diffdrive_jacobian.faults import DeadWheel, Fault, Hang
from diffdrive_jacobian.testing import RecordedRun, fault_schedules


@dataclass(frozen=True, repr=False)
class JointStuck(Fault):
    """A fault of an arm."""

    joint: int
    arm: str = field(default='arm', kw_only=True)

    def install(self, injection):
        injection.during(lambda: None)


KINDS = {JointStuck: lambda: {'joint': st.integers(0, 2)}}
EMPTY, WRONG = None, {int: dict}


def draw(bag, picture, marks):
    """Draw a bag of an arm."""
    if 'arm' not in bag.name:
        return None
    if 'broken' in bag.name:
        return 'it is broken'
    picture.write_text(str(marks))
    return ''


def fail(*_):
    raise ValueError('no arm')


@pytest.fixture
def install(monkeypatch):
    """Return a function that installs a distribution with entry points of a group."""

    def install(group, *lines):
        pairs = [line.split(' = ') for line in lines]
        ours = [EntryPoint(name, value, f'diffdrive_jacobian.{group}') for name, value in pairs]

        def both(**wanted):
            return [*entry_points(**wanted), *EntryPoints(ours).select(**wanted)]

        monkeypatch.setattr(extensions, 'entry_points', both)

    return install


# --- Kinds of faults


def test_another_distribution_has_kinds_of_faults_of_its_own(install):
    install('fault_kinds', 'arm = test_extensions:KINDS')
    strategy = fault_schedules(arms=['left', 'right'], nodes=['driver'], duration=2.0)
    (stuck,) = find(strategy, lambda faults: any(hasattr(one, 'joint') for one in faults))
    assert repr(stuck) == "JointStuck(0, duration=0.1, arm='left')"
    assert find(strategy, lambda faults: any(isinstance(one, Hang) for one in faults))
    # By its class, too.
    with pytest.raises(ValueError, match=r'^JointStuck needs arms$'):
        fault_schedules(nodes=['driver'], kinds=[type(stuck)])
    kinds = [type(stuck), st.just(Hang('driver'))]
    assert find(fault_schedules(arms=['left'], kinds=kinds), lambda faults: Hang('driver') in faults)


def test_names_that_no_distribution_has_faults_for_are_refused():
    for arguments, words in (
        ({'robot': ['a']}, r"no argument 'robot', .*; there are topics, nodes, services, robots$"),
        ({'arms': ['a']}, r"no argument 'arms', and no installed distribution has faults for it"),
        ({}, 'fault_schedules needs topics, nodes, services, robots, fields or kinds'),
        ({'robots': 'robot'}, 'robots must be a list or tuple of names'),
    ):
        with pytest.raises(ValueError, match=words):
            fault_schedules(**arguments)


@pytest.mark.parametrize(
    ('value', 'words'),
    [
        ('test_extensions:JointStuck', r'arm of .*fault_kinds must be a dict of classes of faults'),
        ('test_extensions:EMPTY', r'must be a dict of classes'),
        ('test_extensions:WRONG', r'must be a dict of classes'),
        (
            'test_extensions:NOTHING',
            r'arm = test_extensions:NOTHING of .*fault_kinds cannot be imported',
        ),
        ('arm_ends', r'arm = arm_ends of .* cannot be imported: SystemExit: 3'),
    ],
)
def test_kinds_of_faults_that_are_none_are_named(install, tmp_path, monkeypatch, value, words):
    install('fault_kinds', f'arm = {value}')
    (tmp_path / 'arm_ends.py').write_text('raise SystemExit(3)')
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ExplorationError, match=words):
        fault_schedules(arms=['arm'])
    # Another error is not hidden by that.
    with pytest.raises(ValueError, match=r'^DeadWheel needs robots$'):
        fault_schedules(nodes=['driver'], kinds=[DeadWheel])


def test_an_entry_point_of_another_group_is_another_one(monkeypatch):
    kinds, pictures = extensions.FAULT_KINDS, extensions.PICTURES
    both = (('KINDS', kinds), ('draw', pictures))
    ours = EntryPoints(EntryPoint('arm', f'test_extensions:{one}', group) for one, group in both)
    monkeypatch.setattr(extensions, 'entry_points', lambda **wanted: ours.select(**wanted))
    assert extensions.load(kinds, 'arm').keys() == KINDS.keys()


def test_two_entry_points_of_one_name_are_refused(install):
    install('fault_kinds', 'arm = test_extensions:KINDS', 'arm = other:KINDS')
    words = 'several distributions have an entry point arm of .*: other:KINDS, test_extensions:KINDS'
    with pytest.raises(ExplorationError, match=words):
        fault_schedules(arms=['arm'])


# --- Pictures


def test_a_bag_is_drawn_by_whoever_knows_it(install, tmp_path):
    install('pictures', 'arm = test_extensions:draw', 'leg = no_such_module:draw')
    picture = tmp_path / 'picture'
    assert extensions.draw(tmp_path / 'bag_of_arm', picture, [(1, 'violated')]) == ''
    assert picture.read_text() == "[(1, 'violated')]"
    # Otherwise that of the robot is tried, and what cannot be imported is named.
    why = extensions.draw(tmp_path / 'broken_arm', picture)
    assert why.startswith('it is broken; ')
    assert 'no bag' in why
    assert 'leg = no_such_module:draw of diffdrive_jacobian.pictures cannot be imported' in why


def test_a_picture_that_fails_loses_no_bag_and_hides_no_other(install, tmp_path, lockstep):
    install('pictures', 'arm = test_extensions:fail', 'leg = test_extensions:fail')
    lockstep.create(lambda: Node('arm'))
    run = RecordedRun(lockstep, tmp_path / 'kept')
    kept = run.keep()
    run.close()
    assert (tmp_path / 'kept' / 'run' / 'metadata.yaml').exists()
    words = 'not drawn: arm of diffdrive_jacobian.pictures: ValueError: no arm; leg of'
    assert kept.startswith(f'{run.bag}\n{words}')
