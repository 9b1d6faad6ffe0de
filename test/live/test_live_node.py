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

"""What is behind the live page: its node, in lockstep with the others, or a robot without nodes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter
from support.lockstep_nodes import QUICK, make_complete

from diffdrive_jacobian.bags import read_run, verify
from diffdrive_jacobian.control.controller import KP
from diffdrive_jacobian.drives.values import START, World, record
from diffdrive_jacobian.live import hand, value_page
from diffdrive_jacobian.live import node as live_node
from diffdrive_jacobian.live.commands import (
    CancelGoal,
    ClearPath,
    DriveByHand,
    Pause,
    Place,
    Release,
    Reset,
    SendGoal,
    SetParameter,
    SetSpeed,
    Step,
)
from diffdrive_jacobian.live.node import LivePage
from diffdrive_jacobian.live.pacing import Pacing
from diffdrive_jacobian.live.session import Session
from diffdrive_jacobian.live.value_page import ValuePage
from diffdrive_jacobian.messages.goal_status import GoalState
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.recording.recording import open_recording

pytestmark = pytest.mark.slow


class Live:
    """An open page, and the node behind it."""

    def __init__(self, world):
        self.world = world
        self.session = Session()
        self.page = self.session.enter()
        self.node = world.add(LivePage(self.session, world.node.context, polled=False))

    def send(self, *commands, page=None):
        for command in commands:
            assert self.session.put(page or self.page, command)

    @property
    def elapsed(self):
        return self.world.elapsed

    def pass_time(self, seconds=0.02):
        end = self.elapsed + seconds
        while self.elapsed < end:
            self.node.work()
            self.world.step(0.02)
        self.node.work()
        self.world.settle()
        self.node.work()

    def until(self, condition, timeout=20.0):
        end = self.elapsed + timeout
        while not condition():
            assert self.elapsed < end, (self.texts, self.robot())
            self.pass_time()

    def commands(self):
        """Return `(v, omega)` of the commands from now on."""
        found = []

        def keep(one):
            found.append((one.linear.x, one.angular.z))

        self.world.node.create_subscription(Twist, 'cmd_vel', keep, 10)
        return found

    def ends(self):
        """Return the ends of goals from now on."""
        found = []
        self.node.robots['/'].on_end = found.append
        return found

    @property
    def snapshot(self):
        return self.session.latest()[1]

    def robot(self, name='/'):
        """Return what the page shows of a robot."""
        return next((one for one in self.snapshot.robots if one['name'] == name), None)

    @property
    def texts(self):
        return [notice['text'] for notice in self.session.notices_after(0)]

    def settings(self, name='/'):
        return {row['key']: row for row in self.snapshot.fixed['settings'][name]}

    def state(self, name='/'):
        return self.robot(name)['goal']['state']


class LiveValues(Live):
    """An open page, and a robot without nodes behind it."""

    def __init__(self, **parameters):
        self.world = World({**QUICK, **parameters}, {}, (), START)
        self.session = Session()
        self.page = self.session.enter()
        self.node = ValuePage(self.session, [self.world], Pacing(), controlled=False)

    @property
    def elapsed(self):
        return self.world.seconds

    def pass_time(self, seconds=0.02):
        end = self.elapsed + seconds
        while self.elapsed < end:
            self.node.work()
            self.world.advance()
        self.node.work()

    def commands(self):
        found = []
        self.world.observers.append(
            lambda topic, value: found.append(value.twist) if topic == 'cmd_vel' else None
        )
        return found

    def ends(self):
        found = []
        self.node.robots['/'].on_end = found.append
        return found


def at_rest(robot):
    return (robot['now']['v'], robot['now']['omega']) == (0.0, 0.0)


@pytest.fixture
def live(lockstep, monkeypatch):
    for module in (live_node, value_page):
        monkeypatch.setattr(module, 'PERIOD', 0.0)
    monkeypatch.setattr(live_node, 'DISCOVERY_PERIOD', 0.0)
    # By the clock on the wall, which has nothing to do with simulated time.
    monkeypatch.setattr(hand, 'DEAD_MAN', math.inf)
    return Live(lockstep)


@pytest.fixture
def by_nodes(live):
    """A robot with controller and wheel bridge, known to the page."""
    for node in (VirtualRobot, WheelBridge, GoToGoal):
        parameters = {'command_interface': 'wheels'} if node is VirtualRobot else {}
        live.world.add(make_complete(node, **parameters, **(QUICK if node is GoToGoal else {})))
    live.until(lambda: live.robot() and len(live.settings()) > 8)
    return live


@pytest.fixture(params=['nodes', 'values'])
def driven(request, monkeypatch):
    """Likewise, by nodes or without."""
    if request.param == 'nodes':
        return request.getfixturevalue('by_nodes')
    monkeypatch.setattr(value_page, 'PERIOD', 0.0)
    monkeypatch.setattr(hand, 'DEAD_MAN', math.inf)
    live = LiveValues()
    live.until(live.robot)
    return live


def goal(x, y, theta=None, *, robot='/', append=False):
    return SendGoal(robot, x, y, theta, append=append)


def test_a_goal_is_driven_to_and_every_number_of_the_chain_is_there(driven):
    driven.send(goal(0.4, 0.3))
    driven.until(lambda: driven.state() == 'executing' and driven.robot()['commanded'])
    robot = driven.robot()
    # Without a heading it is approached straight.
    assert robot['goal']['goals'][0] == pytest.approx([0.4, 0.3, math.atan2(0.3, 0.4)], abs=1e-5)
    assert robot['now']['distance'] == pytest.approx(0.5, abs=0.02)
    assert robot['law']['name'] == 'go_to_goal'
    assert robot['law']['gains']['K_p'] == QUICK['kp']
    assert robot['tolerance'] == 0.02
    chain = robot['chain']
    assert chain['measured']
    assert np.array(chain['inverse']) @ chain['command'] == pytest.approx(chain['wanted'], rel=1e-4)
    # The wheels turn as the odometry says.
    twist = [robot['now'][name] for name in ('v', 'omega')]
    assert chain['twist'] == pytest.approx(twist, rel=1e-3)
    driven.until(lambda: driven.state() == 'succeeded')
    robot = driven.robot()
    assert robot['now']['distance'] == pytest.approx(math.dist(robot['pose'][:2], (0.4, 0.3)), abs=1e-5)
    assert robot['now']['bearing_error'] is None
    assert robot['region']['a'] > robot['region']['b'] > 0.0
    assert len(driven.snapshot.trails['/'].points) > 10


def test_waypoints_are_appended_and_the_ends_of_goals_are_reported(driven):
    ends = driven.ends()
    # To a goal that was sent just now.
    driven.send(goal(0.2, 0.0), goal(0.2, 0.2, append=True))
    driven.until(lambda: driven.state() == 'executing')
    assert [one[:2] for one in driven.robot()['goal']['goals']] == [[0.2, 0.0], [0.2, 0.2]]
    # To an active goal.
    driven.send(goal(0.0, 0.2, 1.0, append=True))
    driven.until(lambda: driven.robot()['goal']['goals'][-1] == [0.0, 0.2, 1.0])
    goals = driven.robot()['goal']['goals']
    assert len(goals) > 1
    driven.until(lambda: driven.robot()['goal']['index'] == len(goals) - 1)
    driven.until(lambda: driven.state() == 'succeeded')
    # To none.
    driven.send(goal(5.0, 5.0, append=True))
    driven.until(lambda: driven.state() == 'executing')
    assert len(driven.robot()['goal']['goals']) == 1
    driven.send(CancelGoal('/'))
    driven.until(lambda: driven.state() == 'canceled')
    driven.pass_time(0.1)
    assert at_rest(driven.robot())
    driven.send(CancelGoal('/'))
    driven.until(lambda: any('no goal is active' in text for text in driven.texts))
    assert [(end.robot, end.state.name) for end in ends] == [('/', 'SUCCEEDED'), ('/', 'CANCELED')]
    np.testing.assert_array_equal([end.goal[:2] for end in ends], [[0.0, 0.2], [5.0, 5.0]])
    for end in ends:
        assert end.distance == pytest.approx(math.dist(end.pose[:2], end.goal[:2]))
    assert ends[0].distance <= 0.021


def test_driving_by_hand_cancels_the_goal_first_and_stops_with_the_page(driven):
    commands = driven.commands()
    driven.send(goal(5.0, 0.0))
    driven.until(lambda: driven.state() == 'executing')
    driven.send(DriveByHand('/', 0.25, 0.5))
    driven.until(lambda: driven.robot()['by_hand'] and driven.robot()['commanded'], timeout=2.0)
    driven.until(lambda: commands[-1][0] == 0.25, timeout=2.0)
    assert driven.state() == 'canceled'
    assert 'driving by hand: the goal is canceled' in driven.texts
    # No command of the controller comes between.
    first = commands.index((0.25, 0.5))
    assert commands[first - 1] == (0.0, 0.0)
    assert set(commands[first:]) == {(0.25, 0.5)}
    driven.session.leave(driven.page)
    driven.pass_time(0.1)
    assert commands[-1] == (0.0, 0.0)
    stopped = len(commands)
    driven.pass_time(0.5)
    assert len(commands) == stopped


def test_a_goal_and_another_page_are_refused_while_the_robot_is_driven_by_hand(driven):
    driven.send(DriveByHand('/', 0.2, 0.0))
    driven.pass_time(0.2)
    driven.send(goal(1.0, 0.0))
    driven.pass_time(0.1)
    assert any('release the keys' in text for text in driven.texts)
    assert not driven.robot()['goal']['active']
    other = driven.session.enter()
    driven.send(DriveByHand('/', -0.9, 0.0), page=other)
    driven.pass_time(0.1)
    assert 'another page drives this robot by hand' in driven.texts
    assert driven.robot()['now']['v'] == pytest.approx(0.2)
    driven.send(Release('/'), page=other)
    driven.pass_time(0.1)
    assert driven.robot()['by_hand']
    driven.send(Release('/'))
    driven.pass_time(0.1)
    assert at_rest(driven.robot())


def test_parameters_are_set_and_refusals_are_shown(driven):
    driven.send(
        SetParameter('/', 'controller/kp', 5.0),
        SetParameter('/', 'controller/controller', 'pose'),
        SetParameter('/', 'robot/max_wheel_velocity', 9.0),
        SetParameter('/', 'controller/linear.x.max_velocity', None),
    )
    driven.until(lambda: driven.settings()['controller/controller']['value'] == 'pose')
    driven.pass_time(0.1)
    rows = driven.settings()
    assert rows['controller/kp']['value'] == 5.0
    assert rows['robot/max_wheel_velocity']['value'] == 9.0
    assert rows['controller/linear.x.max_velocity']['value'] is None
    assert driven.robot()['use_heading']
    assert driven.texts == []
    driven.send(
        SetParameter('/', 'controller/kp', -1.0),
        SetParameter('/', 'controller/use_sim_time', False),
    )
    driven.until(lambda: len(driven.texts) == 2)
    assert any(text.startswith('kp refused') for text in driven.texts)
    assert any('there is no setting' in text for text in driven.texts)
    assert driven.settings()['controller/kp']['value'] == 5.0
    # The nodes serve ranges of all valid values, which are too many for a slider.
    row = driven.settings()['controller/kp']
    assert (row['low'], row['high']) == KP.usual


def test_parameters_that_others_change_are_followed(by_nodes):
    controller = next(node for node in by_nodes.world.nodes if isinstance(node, GoToGoal))
    controller.set_parameters([Parameter('kv', value=1.25)])
    by_nodes.until(lambda: by_nodes.settings()['controller/kv']['value'] == 1.25, timeout=2.0)


class Driver(Node):
    """The driver of a robot, with descriptors of its own."""

    def __init__(self):
        super().__init__('driver')
        self.odometry = self.create_publisher(Odometry, 'odom', 10)
        self.create_timer(0.02, lambda: self.odometry.publish(Odometry()))
        self.declare('max_wheel_velocity', 20.0, (2.0, 120.0))
        self.declare('wheel_travel_variance', 0.001, None)

    def declare(self, name, value, served):
        ranges = [FloatingPointRange(from_value=served[0], to_value=served[1])] if served else []
        self.declare_parameter(name, value, ParameterDescriptor(floating_point_range=ranges))


def test_the_sliders_have_the_ranges_that_a_driver_serves(live):
    driver = live.world.add(Driver())

    def slider(name):
        row = live.settings()[f'robot/{name}']
        return row['low'], row['high']

    live.until(lambda: live.robot() and len(live.settings()) == 2)
    live.until(lambda: slider('max_wheel_velocity') == (2.0, 120.0))
    # It serves no range: the usual one.
    assert slider('wheel_travel_variance') == (0.0, 0.002)
    driver.declare('unrelated', 1.0, (0.0, 1.0))
    live.send(SetParameter('/', 'robot/max_wheel_velocity', 130.0))
    live.until(lambda: live.texts)
    assert 'max_wheel_velocity refused: ' in live.texts[0]
    live.pass_time(0.1)
    assert live.settings()['robot/max_wheel_velocity']['value'] == 20.0
    assert len(live.settings()) == 2


def test_robots_in_namespaces_and_one_too_many_until_another_one_is_gone(live, monkeypatch):
    monkeypatch.setattr(live_node, 'MAX_ROBOTS', 2)
    robots = [live.world.add(make_complete(VirtualRobot, name)) for name in ('/one', '/two')]
    live.world.add(make_complete(GoToGoal, '/two', **QUICK))
    live.until(lambda: live.robot('/one') and live.robot('/two'))
    live.pass_time(0.1)
    live.send(goal(0.1, 0.0, robot='/two'), goal(0.3, 0.0, robot='/three'))
    live.until(lambda: live.state('/two') == 'succeeded')
    assert live.robot('/one')['pose'] == [0.0, 0.0, 0.0]
    assert 'there is no such robot' in live.texts
    live.world.add(make_complete(VirtualRobot, '/three'))

    def notes():
        return live.snapshot.fixed['notes']

    live.until(notes)
    assert notes() == ['at most 2 robots are shown; 1 more publish odometry: /three']
    live.world.remove(robots[0])
    monkeypatch.setattr(live_node, 'LOST', 0.0)
    live.until(lambda: live.robot('/three') and not live.robot('/one') and not notes())


def test_without_a_page_nothing_is_computed(driven):
    driven.session.leave(driven.page)
    before = driven.session.latest()[0]
    driven.pass_time(0.2)
    assert driven.session.latest()[0] == before


@pytest.mark.parametrize('controlled', [True, False])
def test_time_obeys_the_page_without_nodes_where_it_is_simulated(controlled):
    live, pacing = LiveValues(), Pacing()
    live.node = ValuePage(live.session, [live.world], pacing, controlled=controlled)
    live.send(SetSpeed(5.0), Step())
    live.pass_time()
    assert (pacing.speed, pacing.paused) == ((5.0, True) if controlled else (1.0, False))
    live.send(Pause(paused=False))
    live.pass_time()
    assert not pacing.paused
    assert len(live.texts) == (0 if controlled else 3)


def test_a_robot_without_a_controller(live):
    live.world.add(make_complete(VirtualRobot))
    live.until(lambda: live.robot())
    live.send(goal(1.0, 0.0), CancelGoal('/'), SetParameter('/', 'controller/kp', 1.0))
    live.send(Pause(paused=True))
    live.pass_time(0.1)
    assert len(live.texts) == 4
    assert 'nobody is subscribed to /goal_pose: is go_to_goal running?' in live.texts
    assert any('there is no service /cancel_goal' in text for text in live.texts)
    assert 'there is no controller to set kp of' in live.texts
    assert any('time is real here' in text for text in live.texts)


def test_a_slow_robot_takes_stamped_commands_and_the_end_says_how_far_it_rolls(live):
    options = {'linear.x.max_acceleration': 0.1, 'enable_stamped_cmd_vel': True}
    live.world.add(make_complete(VirtualRobot, **options))
    live.until(lambda: live.robot() and 'robot/linear.x.max_acceleration' in live.settings())
    live.send(SetParameter('/', 'robot/linear.x.max_acceleration', 0.2))
    live.until(lambda: live.settings()['robot/linear.x.max_acceleration']['value'] == 0.2)
    live.send(DriveByHand('/', 0.2, 0.0))
    live.until(lambda: live.robot()['now']['v'] == pytest.approx(0.2), timeout=2.0)
    live.send(Release('/'))
    live.until(lambda: any('rolls on for about 0.100 m' in text for text in live.texts), timeout=2.0)


def test_a_node_that_changes_its_name_leaves_nothing_behind(by_nodes):
    robot, refused = by_nodes.node.robots['/'], []
    before = len(list(by_nodes.node.clients))
    for number in range(5):
        robot.use_nodes({role: (f'/{role}_{number}', b'') for role in ('robot', 'controller')})
    robot.links['robot'].set('x', 1.0, refused.append)
    assert len(list(by_nodes.node.clients)) <= before + 2 * 3
    robot.use_nodes({'robot': ('/virtual_robot', b'')})
    assert refused == ['/robot_4 is gone']
    assert not robot.state.controlled
    robot.destroy()
    assert not list(by_nodes.node.clients)


@pytest.mark.parametrize('role', ['robot', 'controller'])
def test_a_node_that_was_started_again_is_asked_again_and_drives_to_nothing(by_nodes, role):
    """It has the same name, and perhaps other parameters. It is known by its publisher."""
    robot = by_nodes.node.robots['/']
    robot.use_nodes({role: ('/name', b'')})
    robot.state.goal.reported(GoalState.EXECUTING, (1, 0))
    link = robot.links[role]
    for gid in (b'', b'again'):
        robot.use_nodes({role: ('/name', gid)})
        assert (robot.links[role] is link) == (gid == b'')
    assert robot.state.goal.active == (role == 'robot')


def test_a_robot_that_slips_is_shown_where_it_truly_is(live):
    slip = {'simulate_slip': True, 'wheel_travel_variance': 2e-3}
    robot = live.world.add(make_complete(VirtualRobot, **slip))
    live.world.add(make_complete(GoToGoal, **QUICK))
    live.until(lambda: live.robot() and len(live.settings()) > 8)
    ends = []
    live.node.robots['/'].on_end = ends.append
    live.send(goal(0.5, 0.25))
    live.until(lambda: live.state() == 'executing')
    live.pass_time(0.2)
    shown = live.robot()
    assert shown['true_distance'] == pytest.approx(math.dist(shown['truth'][:2], (0.5, 0.25)), abs=1e-4)
    assert shown['true_distance'] != shown['now']['distance']
    live.until(lambda: live.state() == 'succeeded')
    live.pass_time(0.2)
    assert live.robot()['truth'] == pytest.approx(robot.truth.tolist(), abs=1e-4)
    (end,) = ends
    assert end.distance <= 0.021 < end.true_distance
    trail = live.snapshot.true_trails['/']
    assert trail.points[-1] == pytest.approx(robot.truth[:2].tolist(), abs=0.011)


def test_the_robot_is_placed_and_the_heading_of_a_goal_is_shown_where_it_counts(driven):
    driven.send(Place('/', 1.0, -2.0, 0.5))
    driven.until(lambda: driven.robot()['pose'] == pytest.approx([1.0, -2.0, 0.5]))
    driven.send(ClearPath('/'))
    driven.pass_time(0.1)
    assert driven.snapshot.trails['/'].points == [(1.0, -2.0)]
    driven.send(Reset('/'))
    driven.until(lambda: driven.robot()['pose'] == [0.0, 0.0, 0.0])
    driven.send(goal(0.3, 0.0), goal(0.3, 0.1, 2.0))
    driven.until(lambda: driven.state() == 'executing')
    assert driven.robot()['now']['goal_heading_error'] is None
    (text,) = driven.texts
    assert 'ignores the heading' in text
    driven.send(SetParameter('/', 'controller/use_goal_heading', value=True))
    driven.until(lambda: driven.robot()['use_heading'])
    shown = driven.robot()
    assert shown['now']['goal_heading_error'] == pytest.approx(2.0 - shown['pose'][2], abs=1e-4)
    assert shown['truth'] is None
    driven.send(goal(0.3, 0.2, 2.0))
    driven.pass_time(0.1)
    assert driven.texts == [text]


@pytest.mark.parametrize('change', ['wheel_lag', 'linear.x.max_acceleration'])
def test_a_robot_that_changes_while_it_drives_is_recorded_without_nodes(tmp_path, monkeypatch, change):
    """It has a place, too, and its odometry is reset: all of that is in the bag."""
    monkeypatch.setattr(hand, 'DEAD_MAN', math.inf)
    live = LiveValues(**{'linear.x.max_velocity': 0.5})
    recording = open_recording('drive', str(tmp_path / 'run'), lossless=True)
    record(live.world, recording)
    live.send(goal(0.5, 9.0))
    live.pass_time(0.5)
    # At the time of a command.
    live.send(SetParameter('/', f'robot/{change}', 0.25))
    live.pass_time(0.5)
    live.send(DriveByHand('/', 0.3, -0.5))
    live.pass_time(0.5)
    live.send(Release('/'))
    live.pass_time(0.1)
    live.send(Place('/', 1.0, -2.0, 0.5), goal(9.0, -2.0))
    live.pass_time(1.0)
    live.send(Reset('/'))
    live.pass_time(0.5)
    live.node.stop()
    recording.finish()
    run = read_run(tmp_path / 'run')
    assert [change.values for _, change in run.parameter_events] == [{change: 0.25}]
    assert len(run.start_pose) == 3
    assert [GoalState(int(one)).name for one in run.goal_status.values[:, 0]] == [
        *('ACCEPTED', 'EXECUTING', 'CANCELED') * 2
    ]
    assert verify(run).agrees(1e-9, 1e-9)
