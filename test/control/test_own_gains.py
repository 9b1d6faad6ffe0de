"""Laws with gains and a state of their own: the examples of doc/controllers.md driven and swept."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.lockstep_nodes import SUCCEEDED, Topics, arrives, change, make
from support.ros_messages import goal, pose_of

from diffdrive_jacobian import control
from diffdrive_jacobian.control import KP, Gain, LawError
from diffdrive_jacobian.live import settings
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.numerics.formula import formula
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.simulation import SweepSetup, closed_loops, sweep, sweep_table
from diffdrive_jacobian.tools import sweep_gains
from diffdrive_jacobian.tools.run_node import run_node

PAGE = (Path(__file__).parents[2] / 'doc' / 'controllers.md').read_text()
SOURCES = dict(re.findall(r'```python\n# (polar|integral)\.py\n(.*?)```', PAGE, re.DOTALL))


def example(name):
    namespace = {}
    exec(SOURCES[name], namespace)
    return namespace['CONTROLLER']


POLAR, INTEGRAL = example('polar'), example('integral')


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install an example as a package; return its name."""

    def install(name):
        module = f'{name}_{tmp_path.name.replace("-", "_")}'
        (tmp_path / f'{module}.py').write_text(SOURCES[name])
        information = tmp_path / f'{module}-1.0.dist-info'
        information.mkdir()
        (information / 'METADATA').write_text(f'Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n')
        (information / 'entry_points.txt').write_text(
            f'[diffdrive_jacobian.controllers]\n{name} = {module}:CONTROLLER\n'
        )
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.setattr('diffdrive_jacobian.control.controllers._loaded', {})
        settings.gains.cache_clear()
        return name

    return install


# --- Parameters of the node


def test_a_law_with_three_gains_drives_to_a_pose(lockstep):
    topics = Topics(lockstep)
    lockstep.add(make(VirtualRobot))
    node = lockstep.add(GoToGoal(controller=POLAR))
    assert change(node, k_alpha=4.0, k_rho=1.0, k_beta=-1.0).successful
    lockstep.publish('goal_pose', goal(-0.4, 0.2, 1.0))
    arrives(lockstep, topics)
    assert topics.statuses[-1] == SUCCEEDED
    x, y, theta = pose_of(topics.odom[-1])
    assert math.dist((x, y), (-0.4, 0.2)) < 0.021
    assert abs(theta - 1.0) < 0.021


def test_gains_of_an_installed_controller_are_parameters_from_the_start(lockstep, install):
    node = lockstep.add(make(GoToGoal, controller=install('polar'), k_rho=0.7))
    assert node.parameters.k_rho == 0.7
    assert node.get_parameter('k_beta').value == -0.5
    (described,) = node.describe_parameters(['k_beta'])
    assert described.description == 'Gain on the heading [1/s].'
    (limits,) = described.floating_point_range
    assert (limits.from_value, limits.to_value) == (-20.0, 0.0)
    result = change(node, k_beta=1.0)
    assert not result.successful
    assert 'k_beta' in result.reason
    with pytest.raises(ParameterError, match="'k_rho' must be in"):
        make(GoToGoal, controller='polar', k_rho=-1.0)


def test_gains_are_declared_when_their_controller_is_chosen(lockstep, install, capfd):
    node = lockstep.add(make(GoToGoal, k_rho=0.7, k_alpha=-1.0))
    assert not node.has_parameter('k_rho')
    assert change(node, controller=install('polar')).successful
    # Given at the start. The other one is out of range.
    assert node.get_parameter('k_rho').value == node.parameters.k_rho == 0.7
    assert change(node, k_beta=-2.0).successful
    assert node.parameters.k_beta == -2.0
    assert change(node, controller='go_to_goal').successful
    assert change(node, controller='polar').successful
    assert node.parameters.k_beta == -2.0


def test_the_default_of_a_shared_gain_is_that_of_the_controller_chosen():
    own = replace(INTEGRAL, gains=(replace(KP, default=1.5), *INTEGRAL.gains[1:]))
    assert GoToGoalParameters.with_controller(own).extended({})().kp == 1.5
    assert GoToGoalParameters().kp == 3.0


def test_a_gain_cannot_take_a_name_that_the_node_uses_or_another_range(lockstep):
    """The parameter keeps its range when the controller is changed."""
    used = ('odom_timeout', 'limits', 'check', 'extended', 'linear_x_max_velocity', 'use_sim_time')
    refused = [(Gain(name=one, default=1.0), f"'{one}', a name that go_to_goal uses") for one in used]
    for gain in (
        Gain(name='kp', default=-2.0, bounds=(-10.0, 0.0)),
        Gain(name='offset', default=0.1, unit='m', bounds=(-1.0, 1.0)),
    ):
        refused.append((gain, 'with another unit or other bounds'))
    for gain, words in refused:
        with pytest.raises(ParameterError, match=words):
            GoToGoal(controller=replace(POLAR, gains=(gain, *POLAR.gains[1:])))


def test_help_describes_the_gains_of_the_controller_that_is_chosen(install, capsys):
    name = install('polar')
    with pytest.raises(SystemExit):
        run_node('go_to_goal', ['--help', '--ros-args', '-p', f'controller:={name}'], Signals())
    assert 'Gain on the bearing [1/s]. Must be in [0, 20]' in capsys.readouterr().out
    with pytest.raises(SystemExit):
        sweep_gains.main(['--controller', name, '--help'], Signals())
    assert '--k_alpha' in capsys.readouterr().out


# --- The page


def test_the_page_offers_the_gains_of_the_controller(install):
    values = {'controller': {'controller': install('polar'), 'k_rho': 0.5, 'k_alpha': 2.0, 'kp': 3.0}}
    rows = {row['key']: row for row in settings.shown(values, settings.gains('polar'))}
    assert rows['controller/k_alpha']['hint'] == 'Gain on the bearing'
    assert (rows['controller/k_alpha']['low'], rows['controller/k_alpha']['high']) == (0.2, 6.0)
    assert 'controller/kp' not in rows
    assert settings.gains('of another machine') == ()


# --- Sweeps


@pytest.mark.slow
def test_three_gains_are_swept_two_at_a_time(install, tmp_path, monkeypatch, capsys):
    gains = {'k_alpha': (1.5, 3.0), 'k_beta': -0.3}
    setup = SweepSetup(controller=POLAR, gains=gains, grid=3, starts=2, rate=10.0)
    assert [gain.name for gain in setup.axes] == ['k_rho', 'k_alpha']
    swept = sweep(setup)
    # 0.05/s is too slow for a minute.
    assert swept.complete.tolist() == [[False, True, True]] * 3
    header, *rows = sweep_table(swept).splitlines()
    assert header.startswith('k_rho_per_s,k_alpha_per_s,starts,arrived,time_mean_s,')
    assert rows[3].startswith('0.775,1.5,2,2,')
    how = {'arrival': setup.arrival, 'rate': 10.0}
    alone = closed_loops(POLAR, setup.poses(), np.zeros(3), 0.775, 1.5, -0.3, **how)
    np.testing.assert_array_equal(alone.time, swept.outcomes.time[0, 1])
    monkeypatch.chdir(tmp_path)
    arguments = ['--controller', install('polar'), '--k_beta', ' -0.8', ' -0.2', '--k_rho', '0.5']
    small = ['--grid', '2', '--starts', '2', '--rate', '10', '--csv', 'a.csv', '-o', 'a.png']
    assert sweep_gains.main([*arguments, *small], Signals()) == 0
    assert (tmp_path / 'a.csv').read_text().startswith('k_alpha_per_s,k_beta_per_s,')
    assert 'fastest: k_alpha' in capsys.readouterr().out


# --- A state


def test_a_state_is_kept_during_a_goal_and_begins_anew_with_the_next(lockstep):
    seen = []

    def law(pose, to, kp, state, dt):
        seen.append((float(state[0]), round(dt, 9)))
        return 0.0, 0.0, state + dt

    clock = control.Controller(name='clock', law=law, gains=(KP,), state=(5.0,))
    node = lockstep.add(GoToGoal(controller=clock))
    lockstep.add(make(VirtualRobot))
    lockstep.publish('goal_pose', goal(1.0, 0.0))
    lockstep.run_for(0.1)
    assert change(node, kp=1.0).successful
    lockstep.run_for(0.1)
    count = len(seen)
    times = [dt for _, dt in seen]
    assert times == [0.0] + [0.02] * (count - 1)
    assert [state for state, _ in seen] == pytest.approx(5.0 + np.cumsum(times) - np.array(times))
    lockstep.publish('goal_pose', goal(2.0, 0.0))
    lockstep.run_for(0.1)
    assert seen[count] == (5.0, 0.0)


def test_the_integral_removes_a_bias_in_node_and_batch_alike():
    def biased(controller):
        def law(*arguments, **more):
            v, omega, *state = controller.law(*arguments, **more)
            return (v, omega - 1.0, *state)

        return replace(controller, law=law)

    ends = []
    for ki in (0.0, 2.0):
        bound = biased(INTEGRAL).bind(SimpleNamespace(kp=2.0, kv=0.0, ki=ki))
        theta = 0.3
        for step in range(250):
            bound.now = step * 20_000_000
            _, omega = bound((0.0, 0.0, theta), (1.0, 0.0, 0.0))
            theta += omega * 0.02
        ends.append(theta)
        batch = closed_loops(biased(INTEGRAL), [[0.0, 0.0, 0.3]], [1.0, 0.0], 2.0, 0.0, ki, duration=5.0)
        assert batch.pose[0, 2] == pytest.approx(theta, abs=1e-12)
    assert ends[0] == pytest.approx(-0.5, abs=2e-3)
    assert abs(ends[1]) < 2e-2


def test_robots_of_a_batch_have_states_of_their_own():
    poses = np.array([[0.0, 0.0, 0.0], [-1.0, 0.5, 2.0], [0.3, 0.0, -1.0]])
    together = closed_loops(INTEGRAL, poses, [1.0, 0.0], 3.0, 0.5, 0.7)
    for index, pose in enumerate(poses):
        alone = closed_loops(INTEGRAL, [pose], [1.0, 0.0], 3.0, 0.5, 0.7)
        np.testing.assert_array_equal(alone.pose[0], together.pose[index])


def test_an_equation_may_have_a_state_too():
    @formula('(3),(2),(),(1),() -> (),(),(1)')
    def law(pose, goal, kp, state, dt):
        (total,) = state
        return 0.0 * kp, kp * total, [total + dt]

    own = control.Controller(name='equation', law=law, gains=(KP,), state=(1.0,))
    bound = own.bind(SimpleNamespace(kp=2.0))
    assert bound(np.zeros(3), np.zeros(2)) == (0.0, 2.0)
    bound.now = 500_000_000
    assert bound(np.zeros(3), np.zeros(2)) == (0.0, 2.0)
    bound.now = 10**9
    assert bound(np.zeros(3), np.zeros(2)) == (0.0, 3.0)
    ended = closed_loops(own, [[0.0, 0.0, 0.0]] * 2, [1.0, 0.0], 2.0, rate=10.0, duration=0.3)
    assert ended.pose[:, 2] == pytest.approx([0.1 * 2.0 * (1.0 + 1.0 + 1.1)] * 2)


def test_an_invalid_state_is_named():
    for result, words in (
        ((0.0, 0.0), 'two numbers, and the state, shape (1,), got (0.0, 0.0)'),
        ((0.0, 0.0, [1.0, 2.0]), 'and the state, shape (1,)'),
        ((0.0, 0.0, [math.nan]), 'must return finite (v, omega), got (0, 0) and the state [nan]'),
    ):
        own = replace(INTEGRAL, law=lambda *_, result=result, **__: result)
        with pytest.raises(LawError, match=re.escape(words)):
            own.bind(SimpleNamespace(kp=1.0, kv=1.0, ki=1.0))(np.zeros(3), np.ones(3))


def test_time_that_goes_back_is_no_time():
    seen = []

    def law(pose, to, kp, state, dt):
        seen.append(dt)
        return 0.0, 0.0, state

    own = control.Controller(name='back', law=law, gains=(KP,), state=(0.0,))
    bound = own.bind(SimpleNamespace(kp=1.0))
    for bound.now in (10**9, 5 * 10**8, 10**9):
        bound(np.zeros(3), np.zeros(2))
    assert seen == [0.0, 0.0, 0.5]


def test_gains_named_as_options_are_swept_under_another_name(capsys, monkeypatch, tmp_path):
    odd = replace(
        POLAR,
        gains=(
            Gain(name='grid', default=0.5, bounds=(0.0, 10.0)),
            Gain(name='max_velocity', default=2.0, bounds=(0.0, 20.0)),
            Gain(name='k_beta', default=-0.5),
        ),
    )
    monkeypatch.setattr(sweep_gains.CONTROLLERS, '_given', {'polar': odd})
    monkeypatch.chdir(tmp_path)
    arguments = ['--controller', 'polar', '--gain-grid', '0.3', '0.6', '--gain-max_velocity', '1', '2']
    more = ['--k_beta', '-0.3', '--max-velocity', '1', '--grid', '2', '--starts', '1', '--csv', 'a.csv']
    assert sweep_gains.main([*arguments, *more], Signals()) == 0
    assert 'fastest: grid 0.6, max_velocity' in capsys.readouterr().out


def test_gains_of_a_setup_are_numbers_or_ranges():
    for bad in ('x', None, (1.0,), [1.0, 2.0, 3.0], 1j, math.nan):
        with pytest.raises(ValueError, match='kp must be'):
            SweepSetup(gains={'kp': bad})
    with pytest.raises(ValueError, match='gains must be of class Mapping'):
        SweepSetup(gains=[('kp', 1.0)])
