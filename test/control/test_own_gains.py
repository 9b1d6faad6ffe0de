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

"""Laws with gains and a state of their own: the examples of doc/controllers.md."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from own_laws import EXAMPLES, Site, example
from support import commands
from support.lockstep_nodes import change, make
from support.ros_messages import goal, odometry

from diffdrive_jacobian.control import KP, Controller, Gain
from diffdrive_jacobian.live import settings
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.numerics.formula import formula
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.plots import sweep_figure
from diffdrive_jacobian.simulation import SweepSetup, closed_loops, sweep, sweep_table

POLAR, INTEGRAL = example('polar'), example('integral')


@pytest.fixture
def site(tmp_path, monkeypatch):
    return Site(tmp_path / 'site', monkeypatch)


# --- Parameters of the node


def test_gains_of_an_installed_controller_are_parameters_from_the_start(lockstep, site):
    site.install('polar')
    node = lockstep.add(make(GoToGoal, controller='polar', k_rho=0.7))
    assert node.parameters.k_rho == 0.7
    assert node.get_parameter('k_beta').value == -0.5
    (described,) = node.describe_parameters(['k_beta'])
    assert described.description == 'Gain on the heading [1/s].'
    (limits,) = described.floating_point_range
    assert (limits.from_value, limits.to_value) == (-20.0, 0.0)
    assert 'k_beta' in change(node, k_beta=1.0).reason
    with pytest.raises(ParameterError, match="'k_rho' must be in"):
        make(GoToGoal, controller='polar', k_rho=-1.0)


def test_gains_are_declared_with_their_controller_in_one_change(lockstep, site, monkeypatch):
    site.install('polar')
    node, changes = lockstep.add(make(GoToGoal, k_rho=0.7, k_alpha=-1.0)), []
    react = node.parameters_changed

    def changed(before):
        changes.append(node.parameters.k_rho)
        react(before)

    monkeypatch.setattr(node, 'parameters_changed', changed)
    assert not node.has_parameter('k_rho')
    assert change(node, controller='polar').successful
    # Given at the start. The other one is out of range.
    assert node.get_parameter('k_rho').value == node.parameters.k_rho == 0.7
    assert changes == [0.7]
    assert change(node, k_beta=-2.0).successful
    assert change(node, controller='go_to_goal').successful
    assert change(node, controller='polar').successful
    assert node.parameters.k_beta == -2.0


def test_the_default_of_a_shared_gain_is_that_of_the_controller_chosen():
    own = replace(INTEGRAL, gains=(replace(KP, default=1.5), *INTEGRAL.gains[1:]))
    assert GoToGoalParameters().with_controller(own).at_start({}).kp == 1.5
    assert GoToGoalParameters().kp == 3.0


def test_a_gain_cannot_take_a_name_that_the_node_uses_or_another_range(lockstep):
    """The parameter keeps its range when the controller is changed."""
    used = ('odom_timeout', 'limits', 'at_start', 'linear_x_max_velocity', 'use_sim_time')
    refused = [(Gain(name=one, default=1.0), f"'{one}', a name that go_to_goal uses") for one in used]
    for gain in (
        Gain(name='kp', default=-2.0, bounds=(-10.0, 0.0)),
        Gain(name='offset', default=0.1, unit='m', bounds=(-1.0, 1.0)),
    ):
        refused.append((gain, 'with another unit or other bounds'))
    for gain, words in refused:
        with pytest.raises(ParameterError, match=words):
            GoToGoal(controller=replace(POLAR, gains=(gain, *POLAR.gains[1:])))


def test_help_and_the_page_describe_the_gains_of_the_controller_that_is_chosen(site):
    site.install('polar')
    of_node = commands.run('go_to_goal', '--help', '--ros-args', '-p', 'controller:=polar')
    assert 'Gain on the bearing [1/s]. Must be in [0, 20]' in of_node.out
    assert '--k_alpha' in commands.run('sweep_gains', '--controller', 'polar', '--help').out
    values = {'controller': {'controller': 'polar', 'k_rho': 0.5, 'k_alpha': 2.0, 'kp': 3.0}}
    how = {'path': False, 'imported': True}
    rows = {row['key']: row for row in settings.shown(values, **how)}
    assert rows['controller/k_alpha']['hint'] == 'Gain on the bearing'
    assert (rows['controller/k_alpha']['low'], rows['controller/k_alpha']['high']) == (0.2, 6.0)
    assert 'controller/kp' not in rows
    assert settings.gains({'controller': 'of another machine', 'k_rho': 0.5}, **how) == ()


# --- Sweeps


def test_three_gains_are_swept_two_at_a_time_and_drawn():
    gains = {'k_alpha': (1.5, 3.0), 'k_beta': -0.3}
    setup = SweepSetup(controller=POLAR, gains=gains, grid=3, starts=2, rate=10.0, duration=40.0)
    assert [gain.name for gain in setup.axes] == ['k_rho', 'k_alpha']
    swept = sweep(setup)
    # 0.05/s is too slow.
    assert swept.complete.tolist() == [[False, True, True]] * 3
    header, *rows = sweep_table(swept).splitlines()
    assert header.startswith('k_rho_per_s,k_alpha_per_s,starts,arrived,time_mean_s,')
    assert rows[3].startswith('0.775,1.5,2,2,')
    how = {'arrival': setup.arrival, 'rate': 10.0}
    alone = closed_loops(POLAR, setup.poses(), np.zeros(3), 0.775, 1.5, -0.3, **how)
    np.testing.assert_array_equal(alone.time, swept.outcomes.time[0, 1])
    texts = [text.get_text() for text in sweep_figure(swept).axes[3].get_legend().get_texts()]
    assert 'defaults: k_rho 0.5, k_alpha 2' in texts


def test_the_tool_sweeps_a_gain_that_is_named_as_an_option(site, tmp_path, monkeypatch):
    site.install('polar', EXAMPLES['polar'].replace("'k_rho'", "'grid'"))
    monkeypatch.chdir(tmp_path)
    arguments = ('--gain-grid', '0.3', '0.6', '--k_beta', ' -0.8', ' -0.2', '--k_alpha', '2')
    small = ('--grid', '2', '--starts', '1', '--rate', '10', '--csv', 'a.csv')
    ended = commands.run('sweep_gains', '--controller', 'polar', *arguments, *small)
    assert ended.code == 0
    assert 'fastest: grid 0.6' in ended.out
    header, *rows = (tmp_path / 'a.csv').read_text().splitlines()
    assert header.startswith('grid_per_s,k_beta_per_s,')
    assert len(rows) == 4


def test_a_driven_point_is_swept_with_its_offset():
    gains = {'kv': (0.5, 1.0), 'offset': (-0.3, -0.2)}
    swept = sweep(SweepSetup(controller='offset_point', gains=gains, grid=2, starts=2, rate=20.0))
    assert swept.complete.all()
    x, y, _ = np.moveaxis(swept.outcomes.pose, -1, 0)
    # The axle comes to rest beside the goal: rows are offsets.
    assert np.hypot(x, y)[0] == pytest.approx(0.3, abs=0.021)
    assert np.hypot(x, y)[1] == pytest.approx(0.2, abs=0.021)


def test_what_cannot_be_swept_is_refused():
    setup = SweepSetup(starts=2)
    with pytest.raises(ValueError, match="two gains to be swept, but 'polar' has k_rho"):
        replace(setup, controller=replace(POLAR, gains=POLAR.gains[:1]))
    scalar = replace(POLAR, law=lambda pose, to, *_: (math.hypot(to[0] - pose[0], 0.0), 0.0))
    with pytest.raises(ValueError, match=r"'polar' must accept poses of shape \(\d+, 3\), but failed: "):
        sweep(replace(setup, controller=scalar))
    for bad in ('x', (1.0,), math.nan):
        with pytest.raises(ValueError, match='kp must be'):
            SweepSetup(gains={'kp': bad})
    with pytest.raises(ValueError, match='gains must be of class Mapping'):
        SweepSetup(gains=[('kp', 1.0)])


# --- A state


@pytest.fixture
def clock():
    """A law that counts the time, and what it was called with."""

    def law(pose, goal, kp, state, dt):
        own.calls.append((float(state[0]), round(dt, 9)))
        return 0.0, 0.0, state + dt

    own = SimpleNamespace(calls=[])
    own.controller = Controller(name='clock', law=law, gains=(KP,), state=(5.0,))
    return own


def test_a_state_is_kept_when_a_gain_changes_and_reset_for_the_next_goal(lockstep, clock):
    node = lockstep.add(GoToGoal(controller=clock.controller))
    lockstep.add(make(VirtualRobot))
    lockstep.publish('goal_pose', goal(1.0, 0.0))
    lockstep.run_for(0.1)
    assert change(node, kp=1.0).successful
    lockstep.run_for(0.1)
    count = len(clock.calls)
    times = [dt for _, dt in clock.calls]
    assert times == [0.0] + [0.02] * (count - 1)
    states = [state for state, _ in clock.calls]
    assert states == pytest.approx(5.0 + np.cumsum(times) - np.array(times))
    lockstep.publish('goal_pose', goal(2.0, 0.0))
    lockstep.run_for(0.1)
    assert clock.calls[count] == (5.0, 0.0)


def test_a_state_is_reset_while_the_robot_stands(lockstep, clock):
    """Or the whole gap would be one step of an integral."""
    lockstep.add(GoToGoal(controller=clock.controller))
    lockstep.publish('goal_pose', goal(5.0, 0.0))
    for x, after in ((0.0, 0.1), (0.01, 2.1), (0.02, 0.01)):
        lockstep.publish('odom', odometry(x, 0.0, 0.0))
        lockstep.run_for(after)
    assert clock.calls == [(5.0, 0.0), (5.0, 0.1), (5.0, 0.0)]


def test_an_equation_may_have_a_state_too_and_time_that_goes_back_is_no_time():
    @formula('(3),(2),(),(1),() -> (),(),(1)')
    def law(pose, goal, kp, state, dt):
        (total,) = state
        return 0.0 * kp, kp * total, [total + dt]

    own = Controller(name='equation', law=law, gains=(KP,), state=(1.0,))
    bound = own.bind(SimpleNamespace(kp=2.0))
    turned = []
    for bound.now in (0, 500_000_000, 10**9, 8 * 10**8, 10**9, 10**9):
        _, omega = bound(np.zeros(3), np.zeros(2))
        turned.append(omega)
    assert turned == pytest.approx([2.0, 2.0, 3.0, 4.0, 4.0, 4.4])
    ended = closed_loops(own, [[0.0, 0.0, 0.0]] * 2, [1.0, 0.0], 2.0, rate=10.0, duration=0.3)
    assert ended.pose[:, 2] == pytest.approx([0.1 * 2.0 * (1.0 + 1.0 + 1.1)] * 2)


def test_a_gain_with_a_lower_bound_of_its_own_has_a_usual_range():
    assert Gain(name='a', default=0.0, above=-1.0).usual == (0.0, 100.0)
    assert Gain(name='a', default=1.0, bounds=(0.0, 100.0), above=0.5).usual == (1.0, 3.0)
