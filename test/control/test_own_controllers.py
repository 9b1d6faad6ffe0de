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

"""Controllers of others: given in Python, or installed with other packages."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import fields, replace
from decimal import Decimal
from types import ModuleType

import numpy as np
import pytest
from own_laws import EXAMPLES, PAGE, Site, example
from support import commands
from support.lockstep_nodes import ABORTED, SUCCEEDED, Topics, arrives, change, make
from support.ros_messages import goal, twists

from diffdrive_jacobian import control
from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.control import KP, KV, OFFSET, ControllerError, LawError, find_controller
from diffdrive_jacobian.control.controllers import CONTROLLERS
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.parameters.nodes import GoToGoalParameters

MINE = example('my_law')


@pytest.fixture
def site(tmp_path, monkeypatch):
    return Site(tmp_path / 'site', monkeypatch)


# --- An installed package


@pytest.mark.pages
def test_the_example_drives_and_its_bag_is_read_without_it(site, tmp_path, monkeypatch):
    (declared,) = re.findall(r'```toml\n(.*?)```', PAGE, re.DOTALL)
    group, entry = re.search(r'entry-points\."(.*?)"\]\n(.*)', declared.replace(' "', ' ')).groups()
    entry = entry.rstrip('"')
    assert f"{group}': ['{entry}']" in PAGE
    site.add('my_law', EXAMPLES['my_law'], 'my-laws', '1.0', f'[{group}]\n{entry}\n')
    monkeypatch.chdir(tmp_path)
    arguments = ('0.4', '0.2', '--controller', 'my_law', '--lockstep', '-o', 'bag', '--no-plot')
    assert commands.run('drive_to', *arguments, '--ros-args', '-p', 'kv:=4.0').code == 0
    # Without the package.
    monkeypatch.delitem(sys.modules, 'my_law')
    monkeypatch.setattr(CONTROLLERS, '_known', dict(CONTROLLERS.built_in))
    read = timeline(read_run(tmp_path / 'bag'))
    assert read.run.of_node('go_to_goal')['controller'] == 'my_law'
    expected = MINE.law(read.run.odometry.values[0, :3], np.array([0.4, 0.2]), 3.0, 4.0)
    assert read.run.cmd_vel.values[0] == pytest.approx(expected, rel=1e-9)
    # Its driven point is not known, so the distance is that of the axle centre.
    distance = math.dist(read.run.odometry.values[-1, :2], (0.4, 0.2))
    assert read.distance[-1] == pytest.approx(distance)
    assert distance <= 0.021
    assert commands.run('replay_run', 'bag', '--verify').code == 0
    assert 'my_law' not in sys.modules


def test_names_are_listed_and_checked_without_an_import(site):
    module = site.install('named')
    names = control.controller_names()
    # A user may have installed others.
    assert {*CONTROLLERS.built_in, 'named'} <= {*names}
    assert list(names) == sorted(names)
    for command in ('drive_to', 'sweep_gains', 'go_to_goal'):
        assert 'named' in commands.run(command, '--help').out
    assert module not in sys.modules
    assert find_controller('named').summary == 'bounded speed'
    assert module in sys.modules


def test_built_in_controllers_cannot_be_replaced(site):
    site.install('pose')
    assert control.controller_names() == tuple(CONTROLLERS.built_in)
    assert find_controller('pose') is CONTROLLERS.built_in['pose']


BROKEN = {
    'raises': ('raise OSError("no\\nlicence")', 'cannot be loaded: OSError: no licence'),
    'exits': ('raise SystemExit(0)', 'cannot be loaded: SystemExit: 0'),
    'empty': ('', "cannot be loaded: AttributeError: module 'provider_"),
    'law-only': ('def CONTROLLER(): pass', 'must be a Controller, got <function'),
    'misnamed': (EXAMPLES['my_law'], "name of its entry point, 'misnamed', got 'my_law'"),
    'invalid': (EXAMPLES['my_law'].replace('summary', 'gains'), 'ValueError: gains must be a tuple'),
}


@pytest.mark.parametrize('name', BROKEN)
def test_a_broken_controller_is_refused_with_package_and_reason(site, name):
    source, reason = BROKEN[name]
    module = site.install(name, source, version='0.3')
    words = f"controller '{name}' of {name}-laws 0.3 ({module}:CONTROLLER) "
    with pytest.raises(ControllerError, match=f'^{re.escape(words)}.*{re.escape(reason)}'):
        find_controller(name)


def test_a_node_refuses_a_broken_controller_and_keeps_its_own(lockstep, site):
    site.install('raises', BROKEN['raises'][0])
    node = lockstep.add(make(GoToGoal))
    result = change(node, controller='raises')
    assert not result.successful
    assert 'no licence' in result.reason
    assert node.get_parameter('controller').value == 'go_to_goal'
    ended = commands.run('go_to_goal', '--ros-args', '-p', 'controller:=raises')
    assert ended.code == 2
    assert len(ended.err.splitlines()) == 1


def test_unknown_and_ambiguous_names_are_refused(site):
    for bad in ('other', 'a\nb', 3):
        with pytest.raises(ControllerError, match=re.escape(f"'pose', got {bad!r}")):
            find_controller(bad)
    site.install('twice', package='first-laws')
    site.install('twice', package='second-laws', version='4')
    several = r"'twice' is provided by several packages: first-laws 1\.2 and second-laws 4"
    with pytest.raises(ControllerError, match=several):
        find_controller('twice')


# --- A controller given in Python


@pytest.mark.lockstep(args=['--ros-args', '-p', 'controller:=pose'])
def test_the_user_can_choose_another_than_the_given_controller(lockstep):
    node = lockstep.add(GoToGoal(controller=MINE))
    assert node.get_parameter('controller').value == 'pose'
    assert change(node, controller='my_law').successful
    assert node.parameters.chosen_controller() is MINE
    assert "'my_law'" in change(node, controller='other').reason
    # Another node has another one of that name, or none.
    other = replace(MINE, law=control.go_to_goal)
    second = lockstep.add(GoToGoal(controller=other, namespace='second'))
    assert change(second, controller='my_law').successful
    assert second.parameters.chosen_controller() is other
    assert not change(lockstep.add(make(GoToGoal, 'third')), controller='my_law').successful


def test_only_controllers_with_a_name_of_their_own_can_be_given():
    for bad in ('pose', MINE.law, None):
        with pytest.raises(ValueError, match='controller must be of class Controller'):
            GoToGoalParameters().with_controller(bad)
    with pytest.raises(ValueError, match="name of its own, got 'pose', which is built in"):
        GoToGoalParameters().with_controller(replace(MINE, name='pose'))


def test_heading_and_driven_point_of_a_given_controller_count(lockstep):
    controller = replace(CONTROLLERS.built_in['offset_point'], name='point', takes_heading=True)
    node = lockstep.add(GoToGoal(controller=controller))
    assert (node.arrival.offset, node.arrival.use_heading) == (0.1, True)
    assert change(node, offset=-0.4).successful
    assert node.arrival.offset == -0.4


def test_advice_is_logged_and_its_failure_does_no_harm(lockstep, capfd):
    def advice(gains, limits):
        if gains.kp > 5.0:
            raise KeyError('kp')
        yield f'kp {gains.kp:g} with {limits.max_v:g} m/s'

    node = lockstep.add(GoToGoal(controller=replace(MINE, advice=advice)))
    lockstep.publish('goal_pose', goal(1.0, 0.0))
    assert 'kp 3 with 1000 m/s' in capfd.readouterr().err
    assert change(node, kp=6.0).successful
    assert "the advice of controller 'my_law' failed: KeyError: 'kp'" in capfd.readouterr().err
    assert MINE.warnings(GoToGoalParameters(), node.parameters.limits()) == []
    failing = replace(MINE, slope=lambda gains: 1.0 / 0.0)
    (warning,) = failing.rate_warnings(GoToGoalParameters(), 50.0, turns=False)
    assert "the slope of controller 'my_law' failed: ZeroDivisionError" in warning


@pytest.mark.parametrize(
    ('state', 'law', 'words'),
    [
        ((), lambda *_: 1.0 / 0.0, "'my_law' failed: ZeroDivisionError"),
        ((), lambda *_: (math.nan, 0.0), 'two finite numbers, got (nan, 0.0)'),
        ((), lambda *_: (1.0, 2.0, 3.0), 'must return (v, omega), two'),
        ((), lambda *_: 0.5, 'two finite numbers, got 0.5'),
        ((), lambda *_: ([1.0], [2.0]), 'two finite numbers, got'),
        ((), lambda *_: ('1', None), 'two finite numbers, got'),
        ((1.0,), lambda *_, **__: (0.0, 0.0), 'and the state, shape (1,), got (0.0, 0.0)'),
        ((1.0,), lambda *_, **__: (0.0, 0.0, [1.0, 2.0]), 'and the state'),
        ((1.0,), lambda *_, **__: (0.0, 0.0, [math.nan]), 'and the state'),
    ],
)
def test_a_law_that_fails_is_an_error_with_its_cause(state, law, words):
    with pytest.raises(LawError, match=re.escape(words)) as caught:
        replace(MINE, law=law, state=state).bind(GoToGoalParameters())(np.zeros(3), np.ones(3))
    assert isinstance(caught.value.__cause__, ZeroDivisionError) == ('Zero' in words)


def test_a_law_that_fails_stops_the_robot_and_aborts_the_goal(lockstep, capfd):
    broken, topics = [], Topics(lockstep)
    lockstep.add(make(VirtualRobot))
    controller = replace(MINE, law=lambda *given: (broken or [MINE.law])[-1](*given))
    node = lockstep.add(GoToGoal(controller=controller))
    lockstep.publish('goal_pose', goal(20.0, 0.5))
    lockstep.run_for(0.1)
    assert twists(topics.commands)[-1] != (0.0, 0.0)
    broken.append(lambda *_: (math.nan, 0.0))
    lockstep.run_for(0.1)
    assert twists(topics.commands)[-1] == (0.0, 0.0)
    assert topics.statuses[-1] == ABORTED
    assert node.waypoint is None
    assert 'two finite numbers, got (nan, 0.0)' in capfd.readouterr().err
    # The node goes on with a law that works.
    assert change(node, controller='go_to_goal', kp=24.0, kv=12.0).successful
    lockstep.publish('goal_pose', goal(0.5, 0.2))
    arrives(lockstep, topics)
    assert topics.statuses[-1] == SUCCEEDED


def test_gains_are_passed_in_order_and_numbers_of_any_kind_returned():
    parameters = GoToGoalParameters(kp=2.0, kv=3.0, offset=5.0)
    own = replace(MINE, gains=(OFFSET, KP, KV), law=lambda pose, goal, d, kp, kv: (d, kp - kv))
    assert own.values(parameters) == (5.0, 2.0, 3.0)
    assert own.bind(parameters)(np.zeros(3), np.ones(3)) == (5.0, -1.0)
    law = replace(MINE, law=lambda *_: (Decimal('0.5'), np.bool_(True)))
    assert law.bind(parameters)((0.0, 0.0, 0.0), (1.0, 1.0, 0.0)) == (0.5, 1.0)


# --- The page on controllers


def test_the_example_of_a_test_passes(lockstep, robot_at, monkeypatch):
    """The other blocks are run with those of all pages."""
    modules = {name: ModuleType(name) for name in ('my_law', 'test_my_law')}
    monkeypatch.setitem(sys.modules, 'my_law', modules['my_law'])
    for name, module in modules.items():
        exec(EXAMPLES[name], module.__dict__)
    modules['test_my_law'].test_my_law_reaches_the_goal(lockstep, robot_at)


def test_every_field_is_described():
    tables = PAGE.split('## Fields')[1].split('A `Gain` has')
    for table, described in zip(tables, (control.Controller, control.Gain), strict=True):
        names = [field.name for field in fields(described)]
        assert re.findall(r'^\| `(\w+)`', table, re.MULTILINE) == names


# --- The objects


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'name': 'two words'}, "'_', '.' or '-', at most 64, got 'two words'"),
        ({'law': 'law'}, 'law must be a function'),
        ({'gains': [KP, KV]}, 'gains must be a tuple of Gain'),
        ({'gains': (KP, KP)}, 'gains must have different names, got kp, kp'),
        ({'state': (math.nan,)}, 'state must be finite'),
        ({'offset': 'd'}, "offset must be '' or one of kp, kv, got 'd'"),
        ({'takes_heading': 1}, 'takes_heading must be True or False'),
    ],
)
def test_invalid_controllers_are_refused(changes, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        replace(MINE, **changes)


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'name': 'K'}, 'name of a gain must be a lower-case letter'),
        ({'name': 'lambda'}, "got 'lambda'"),
        ({'default': 5.0}, 'ki must be in [-1, 2], got 5'),
        ({'above': 1.0}, 'ki must be in (1, 2], got 1'),
        ({'bounds': (1.0,)}, 'bounds must have shape (..., 2)'),
        ({'usual': (1.0, 1.0)}, 'usual must be (first, last) with first < last'),
        ({'usual': (0.0, 3.0)}, 'ki must be in [-1, 2], got 3'),
    ],
)
def test_invalid_gains_are_refused(changes, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        control.Gain(**{'name': 'ki', 'default': 1.0, 'bounds': (-1.0, 2.0)} | changes)
