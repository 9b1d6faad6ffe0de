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

"""Drives without nodes: they drive as the nodes do in lockstep, to the last bit."""

from __future__ import annotations

import math
import signal
from dataclasses import fields, replace

import numpy as np
import pytest

from diffdrive_jacobian.bags import read_run, verify
from diffdrive_jacobian.control import KP, KV, Controller, Gain
from diffdrive_jacobian.control.controllers import find_controller, find_path_controller
from diffdrive_jacobian.control.path_source import PathError
from diffdrive_jacobian.drives import drive, driving, nodes, values
from diffdrive_jacobian.drives.driving import as_goals
from diffdrive_jacobian.drives.outcome import Outcome, Request
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.codecs import Route
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.plots import run_figure
from diffdrive_jacobian.signals import Signals

pytestmark = pytest.mark.slow
QUICK = {'kp': 12.0, 'kv': 3.0}
LIMITS = {
    f'{axis}.{limit}': sign * value
    for axis, value in (('linear.x', 0.4), ('angular.z', 1.5))
    for limit, sign in (('max_acceleration', 1.0), ('max_deceleration', -1.0))
}
go_to_goal_law = find_controller('go_to_goal').law
SERIES = (
    *('odometry', 'ground_truth', 'cmd_vel', 'cmd_vel_out', 'start_pose', 'wheel_commands', 'wheels'),
    *('goals', 'planned_path', 'goal_status'),
)
TO = [[0.2, 0.0], [0.2, 0.2]]
BRIDGE = [word for name, value in LIMITS.items() for word in ('-p', f'wheel_bridge:{name}:={value}')]


def request(goals, timeout=2.5, **given):
    relative = isinstance(goals, str)
    how = {'parameters': {}, 'robot_parameters': {}, 'laws': {}}
    how |= {'recording': None, 'progress': None, 'keep': True}
    return Request(
        goals=as_goals(goals), relative=relative, timeout=timeout, signals=Signals(), **{**how, **given}
    )


def spiral(poses, goals, kp, kv, boost, state, dt):
    """Drive ever faster. Its gain and its state are its own."""
    v, omega = go_to_goal_law(poses, goals, kp, kv)
    return v * (1.0 + boost * state[..., 0]), omega, state + dt


SPIRAL = Controller(
    name='spiral', law=spiral, gains=(KP, KV, Gain(name='boost', default=0.5)), state=(0.0,)
)
CASES = {
    'a law of the caller': {'laws': {'controller': SPIRAL}, 'parameters': {**QUICK, 'boost': 0.7}},
    'goals': {'parameters': QUICK},
    'goals passed by a robot that slips': {
        'parameters': {**QUICK, 'pass_waypoints': True},
        'robot': {'simulate_slip': True, 'slip_seed': 3},
    },
    'a heading, and limits': {
        'goals': [[0.1, 0.2, -2.0]],
        'parameters': {'use_goal_heading': True, **LIMITS, 'stop_in_time': True},
        'robot': LIMITS,
    },
    'lag, delay, and a period that is no whole number': {
        'parameters': QUICK,
        'robot': {'lag': 0.1, 'delay': 0.07, 'publish_rate': 30.0},
    },
    'an offset point from another pose': {
        'parameters': {'controller': 'offset_point', **QUICK},
        'robot': {'x': 0.3, 'theta': 4.0},
    },
    # The robot stops again and again, and the state of the law begins anew.
    'odometry that is rarer than the timeouts': {
        'laws': {'controller': SPIRAL},
        'parameters': {'odom_timeout': 0.3, 'boost': 2.0},
        'robot': {'publish_rate': 1.7},
    },
    'a goal where the robot is': {'goals': [[0.0, 0.0]]},
    # Between two commands its speeds are those that were commanded.
    'limits of the bridge': {
        'parameters': QUICK,
        'robot': {'publish_rate': 3.0},
        'arguments': [*BRIDGE, '-p', 'wheel_bridge:publish_rate:=77.0'],
    },
    'arguments for all': {
        'parameters': QUICK,
        'arguments': ['-p', 'max_wheel_velocity:=2.0', '-p', 'cmd_vel_timeout:=0.015'],
    },
    'pure pursuit': {
        'goals': 'eight:0.5',
        'parameters': {'path_controller': 'pure_pursuit'},
        'robot': LIMITS,
    },
    'kanayama': {
        'goals': 'circle:0.3',
        'parameters': {'path_controller': 'kanayama', **LIMITS},
        'robot': {'lag': 0.05},
    },
    'offset point': {
        'goals': 'circle:0.3',
        'parameters': {'path_controller': 'offset_point'},
        'robot': {'simulate_slip': True},
    },
    'dynamic feedback': {
        'goals': 'eight:0.4',
        'parameters': {
            'path_controller': 'dynamic_feedback',
            'linear.x.max_velocity': 0.1,
        },
    },
    'a path that begins too far away': {
        'goals': as_goals('circle:0.3'),
        'robot': {'x': 3.0},
    },
}


@pytest.mark.parametrize('name', CASES)
def test_it_drives_as_the_nodes_in_lockstep(name):
    case = {'goals': TO, 'parameters': {}, 'robot': {}, 'arguments': [], 'laws': {}, **CASES[name]}
    how = {'parameters': case['parameters'], 'robot_parameters': case['robot'], 'laws': case['laws']}
    arguments = ['--ros-args', '--log-level', 'fatal', *case['arguments']]
    with_nodes = {'runner': None, 'lockstep': True, 'isolated': True}
    one = nodes.drive(request(case['goals'], **how), ros_arguments=arguments, **with_nodes)
    two = values.drive(request(case['goals'], **how), lockstep=True, ros_arguments=arguments)
    for field in fields(Outcome):
        if field.name != 'kept':
            np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
    for name in SERIES:
        of_nodes, of_values = getattr(one.run, name), getattr(two.run, name)
        np.testing.assert_array_equal(of_nodes.received, of_values.received)
        np.testing.assert_array_equal(of_nodes.stamps, of_values.stamps)
        assert of_nodes.values.tobytes() == of_values.values.tobytes(), name
    np.testing.assert_array_equal(one.run.odometry_covariances, two.run.odometry_covariances)
    assert one.run.parameters == two.run.parameters
    assert len(two.run.odometry) > 1


def test_progress_and_signals_are_those_of_the_nodes():
    class Progress:
        def __init__(self, signals=None):
            self.seen, self.signals = [], signals

        def nodes_created(self, names):
            self.names = names

        def driving(self, *state):
            self.seen.append(state)
            if self.signals is not None and len(self.seen) == 10:
                self.signals.count += 1

    one, two = Progress(), Progress()
    asked = request(TO, parameters=QUICK, progress=one)
    nodes.drive(asked, runner=None, lockstep=True, isolated=True, ros_arguments=[])
    values.drive(request(TO, parameters=QUICK, progress=two), lockstep=True)
    assert one.seen == two.seen
    signals = Signals()
    stopped = replace(request(TO, progress=Progress(signals)), signals=signals)
    outcome = values.drive(stopped, lockstep=True)
    assert outcome.interrupted
    assert outcome.seconds < 0.3
    assert outcome.run.odometry.values[-1, 3:].tolist() == [0.0, 0.0]


def test_real_time_passes(monkeypatch):
    slept = []
    monkeypatch.setattr(values.time, 'sleep', slept.append)
    monkeypatch.setattr(values.time, 'monotonic', lambda: 100.0 + sum(slept))
    slow = values.drive(request([[0.5, 0.0]], timeout=0.3), lockstep=False)
    received = slow.run.odometry.received
    assert abs(np.ptp(received) / 1e9 - (len(received) - 1) / 50) < 1e-6
    assert slow.seconds == pytest.approx(0.3, abs=0.03)
    # Also until the robot stands.
    assert sum(slept) == pytest.approx(np.ptp(received) / 1e9, abs=0.03)
    assert min(slept) >= 0.0


def test_advice_is_about_what_is_driven(caplog):
    def advised(topic='', *poses):
        world = values.World({'path_controller': 'kanayama'}, {}, (), values.START)
        if topic:
            world.publish(topic, Route((1, 0), '', poses))
        # A law of goals that spirals, and one of paths that weaves.
        for name, value in (('kp', 0.2), ('k_theta', 0.1)):
            world.set_parameter('go_to_goal', name, value)
        text, _ = caplog.text, caplog.clear()
        return 'spirals' in text, 'weaves' in text

    here, there = (0.0, 0.0, 0.0), (5.0, 0.0, 0.0)
    assert advised() == (True, True)
    assert advised('goals', there) == (True, False)
    assert advised('path', here, there) == (False, True)


WRONG = [
    ({'parameters': {'kpp': 3.0}}, UserError, "go_to_goal has no parameter 'kpp'; did you mean 'kp'?"),
    ({'parameters': {'wheel_radius': 0.1}}, UserError, 'virtual_robot: give it in robot_parameters'),
    ({'robot_parameters': {'kp': 3.0}}, UserError, 'go_to_goal: give it in parameters'),
    ({'robot_parameters': {'x_': 3.0}}, UserError, "virtual_robot has no parameter 'x_'"),
    ({'parameters': {'kp': 'x'}}, UserError, "'kp' must be"),
    ({'parameters': ['kp', 3]}, ValueError, 'parameters must map names'),
    ({'robot_parameters': {3: 3}}, ValueError, 'robot_parameters must map names'),
    ({'path_controller': 'kanayama'}, ValueError, 'path_controller has no effect on goals'),
    ({'ros_arguments': ['-p', 'kp:=3']}, UserError, "that begins with '--ros-args'"),
    ({'ros_arguments': '--ros-args -p kp:=3'}, UserError, "that begins with '--ros-args'"),
    ({'ros_arguments': ['--ros-args', '-p', 'kpp:=1']}, UserError, "parameter 'kpp'; did you mean 'kp'"),
    ({'goals': [[math.nan, 1.0]]}, ValueError, 'goals must be finite'),
    ({'goals': [[1e9, 1.0]]}, ValueError, 'within 1e\\+06 m'),
    ({'goals': np.zeros((2001, 2))}, ValueError, 'goals must be at most 2000'),
    ({'goals': zip([1.0], [2.0], strict=True)}, ValueError, r'goals must be rows \[x, y\]'),
    ({'goals': [['a', 'b']]}, ValueError, r'goals must be rows \[x, y\]'),
]


@pytest.mark.parametrize('ros', [True, False])
@pytest.mark.parametrize(('given', 'error', 'words'), WRONG)
def test_what_would_have_no_effect_or_is_wrong_is_refused_before_the_drive(
    monkeypatch, tmp_path, ros, given, error, words
):
    monkeypatch.setattr(driving, 'has_ros', lambda: ros)
    with pytest.raises(error, match=words):
        drive(**{'goals': TO, 'lockstep': True, **given})


@pytest.mark.parametrize(
    'rule', ['enable_stamped_cmd_vel:=true', 'joint_command_type:=Float64MultiArray']
)
def test_parameters_of_messages_are_refused_where_there_are_none(rule):
    with pytest.raises(UserError, match='chooses a type of messages, and needs rclpy'):
        values.drive(request(TO), lockstep=True, ros_arguments=['--ros-args', '-p', rule])


def test_numbers_of_numpy_and_wheels_that_differ(monkeypatch, caplog):
    monkeypatch.setattr(driving, 'has_ros', lambda: False)
    how = {'lockstep': True, 'timeout': 0.1}
    one, two = (drive(TO, parameters={'kp': kp}, **how) for kp in (np.int64(3), np.float32(3.0)))
    assert one.run.parameters == two.run.parameters
    assert not caplog.text
    drive(TO, robot_parameters={'wheel_radius': 0.05}, **how)
    assert 'virtual_robot has wheel_radius 0.05 m instead of 0.033 m' in caplog.text


def test_the_bag_has_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(driving, 'has_ros', lambda: False)
    outcome = drive('circle:0.3', timeout=1.0, lockstep=True, recording=tmp_path / 'run')
    kept = drive('circle:0.3', timeout=1.0, lockstep=True, keep=True).run
    run = read_run(tmp_path / 'run')
    for name in SERIES:
        assert getattr(run, name).values.tobytes() == getattr(kept, name).values.tobytes(), name
    assert outcome.run.odometry.values.tobytes() == kept.odometry.values.tobytes()
    assert run.parameters.keys() == kept.parameters.keys()
    assert verify(run).holds(1e-9, 1e-9)
    assert not run.notes
    with pytest.raises(UserError, match='exists already'):
        drive('circle:0.3', lockstep=True, recording=tmp_path / 'run')
    with pytest.raises(UserError, match='other processes need rclpy'):
        drive(TO, isolated=False)


def test_an_outcome_shows_its_run():
    outcome = drive(TO, lockstep=True, timeout=1.0, controller='offset_point', parameters=QUICK)
    assert repr(outcome).startswith('Outcome(')
    assert '\n' not in repr(outcome)
    assert len(outcome.table['x_m']) == len(outcome.run.odometry)
    assert outcome.run.parameters['/go_to_goal']['controller'] == 'offset_point'
    assert outcome.plot().axes
    assert 'data:image/svg+xml;base64,' in outcome._repr_html_()
    assert 'timed out at' in repr(outcome)
    for given, names in (
        ([outcome, outcome.run], ['drive 1', 'drive 2']),
        ({'first': outcome, 2: outcome}, ['first', '2']),
    ):
        (legend, *_) = run_figure(given).legends
        assert [text.get_text().partition(':')[0] for text in legend.get_texts()] == names
    for wrong in (3, [3], 'run'):
        with pytest.raises(ValueError, match='runs must be a Run or several, got'):
            run_figure(wrong)
    with pytest.raises(ValueError, match='the run was not kept'):
        replace(outcome, kept=None).plot()


@pytest.mark.parametrize('ros', [True, False])
def test_a_law_of_the_caller_drives_with_its_gains(monkeypatch, ros):
    monkeypatch.setattr(driving, 'has_ros', lambda: ros)
    outcome = drive(TO, controller=SPIRAL, parameters={**QUICK, 'boost': 0.7}, lockstep=True)
    assert outcome.arrived
    used = outcome.run.of_node('go_to_goal')
    assert (used['controller'], used['boost']) == ('spiral', 0.7)
    along = replace(find_path_controller('kanayama'), name='mine')
    assert drive('circle:0.3', path_controller=along, lockstep=True).arrived
    with pytest.raises(UserError, match="no parameter 'boast'; did you mean 'boost'"):
        drive(TO, controller=SPIRAL, parameters={'boast': 0.7}, lockstep=True)
    with pytest.raises(ValueError, match="a name of its own, got 'pose'"):
        drive(TO, controller=replace(SPIRAL, name='pose'), lockstep=True)


@pytest.mark.parametrize('ros', [True, False])
def test_an_interrupt_ends_a_drive_and_its_bag_cleanly(monkeypatch, tmp_path, ros):
    """As of the button Stop of a notebook. It is not lost in a callback."""
    monkeypatch.setattr(driving, 'has_ros', lambda: ros)

    class Progress:
        def nodes_created(self, names):
            pass

        def driving(self, seconds, index, distance, wheels):
            if not 1.0 <= seconds < 1.1 or interrupted:
                return
            interrupted.append(seconds)
            signal.raise_signal(signal.SIGINT)

    interrupted = []
    with pytest.raises(KeyboardInterrupt):
        drive('circle:5', lockstep=True, recording=tmp_path / 'run', progress=Progress())
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    run = read_run(tmp_path / 'run')
    assert GoalState(int(run.goal_status.values[-1, 0])) is GoalState.CANCELED
    assert not run.odometry.values[-1, 3:].any()


def test_a_text_is_a_path(tmp_path):
    poses = tmp_path / 'poses.csv'
    poses.write_text('x,y\n1,1\n2,1\n')
    at = {'x': 1.0, 'y': 1.0}
    # Poses of a file are in the frame of the odometry, shapes begin at the robot.
    for text, x in ((str(poses), 1.0), ('line:1', 1.0)):
        outcome = drive(text, lockstep=True, timeout=0.5, robot_parameters=at)
        assert outcome.run.planned_path.values[0, :2].tolist() == [x, 1.0]
    with pytest.raises(PathError, match='path must be'):
        drive('somewhere')
    assert math.isnan(drive(TO, lockstep=True, timeout=0.1).across)
