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

"""Properties of what nodes do, each kept by some and violated by others."""

from __future__ import annotations

from math import inf
from types import SimpleNamespace

import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from property_nodes import Scene, Student, goal_at, odometry_at, status, twist
from std_srvs.srv import Trigger
from support.lockstep_nodes import ACCEPTED, EXECUTING, SUCCEEDED, change, make
from support.ros_messages import goal, path

from diffdrive_jacobian.faults import (
    ActuatorLag,
    ClockPause,
    Delay,
    Duplicate,
    Hang,
    Kill,
    LateService,
    Loss,
    Reorder,
    TimeJump,
)
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.properties import (
    ArrivesOnceFaultsEnd,
    KeepsDriving,
    NoCommandAfterCancel,
    NoStaleGoals,
    ReachesGoal,
    Settles,
    StatusProtocol,
    StaysOnPath,
    StopsAfterLastCommand,
    StopsAfterLostOdometry,
    StopsOnShutdown,
    end_of_faults,
)
from diffdrive_jacobian.testing import Lockstep, PropertyViolation

pytestmark = pytest.mark.slow


@pytest.fixture
def scene(lockstep):
    return Scene(lockstep)


def violated(lockstep, seconds, words=None):
    """Return the violation that so much time shows."""
    with pytest.raises(PropertyViolation, match=words) as raised:
        lockstep.run_for(seconds)
    return raised.value


def finish_after(lockstep, seconds):
    lockstep.run_for(seconds)
    lockstep.finish()


def drive(controller, required, *faults, seconds=12.0, goal=None):
    """Let a controller of a function drive a robot to a goal three meters away, and finish."""
    with Lockstep() as world:
        world.require(required)
        world.add(make(VirtualRobot, publish_rate=50.0, cmd_vel_timeout=0.0))
        world.create(controller)
        world.inject(*faults)
        world.publish('goal_pose', goal or goal_at(3.0, stamp=1))
        finish_after(world, seconds)


def go_to_goal():
    return make(GoToGoal, kp=4.0, kv=1.0)


# --- Status, goals and paths


def test_only_a_goal_without_identifier_may_be_accepted_again(lockstep, scene):
    uuid, goal = 0, goal_at(0.0, stamp=3)

    def answer(goal):
        for number in (ACCEPTED, EXECUTING, SUCCEEDED):
            scene.send(status(number, goal.header.stamp.sec, uuid))

    lockstep.node.create_subscription(PoseStamped, 'goal_pose', answer, 10)
    lockstep.require(StatusProtocol())
    for _ in range(3):
        lockstep.publish('goal_pose', goal)
    answer(goal)
    with pytest.raises(PropertyViolation, match=r'ACCEPTED of .* stamp 3.0+ s, which was SUC'):
        lockstep.settle()
    lockstep.require(StatusProtocol())
    uuid = 1
    lockstep.publish('goal_pose', goal)
    with pytest.raises(PropertyViolation, match='identifier 01000000'):
        lockstep.publish('goal_pose', goal)


def test_no_command_after_cancel(lockstep, robot_at, scene):
    robot_at()
    student = lockstep.add(Student())
    lockstep.require(NoCommandAfterCancel())
    lockstep.run_for(0.1)
    student.command = twist(0.0)
    lockstep.call(Trigger, 'cancel_goal')
    # Of another one.
    scene.send(twist(0.5))
    lockstep.run_for(0.1)
    lockstep.publish('goal_pose', goal_at(1.0))
    student.command = twist(0.2)
    lockstep.run_for(0.1)
    lockstep.call(Trigger, 'cancel_goal')
    # Refused paths are no goals.
    scene.send(path())
    scene.send(path((1.0, 0.0)))
    violated(lockstep, 0.1, r'v 0.2 m/s, .* 0.02 s after /student has responded to /cancel_goal')


# --- Paths beside goals


@pytest.fixture
def with_paths(lockstep):
    """A robot and its controller, and a function that sends a path of a length (m)."""
    lockstep.add(make(VirtualRobot, publish_rate=50.0))
    lockstep.controller = lockstep.add(go_to_goal())
    lockstep.run_for(0.1)
    stamps = iter(range(1, 99))
    lockstep.send_path = lambda length: lockstep.publish(
        'path', path((0.0, 0.0), (length / 2.0, 0.0), (length, 0.0), stamp=next(stamps))
    )
    return lockstep


def test_a_path_after_a_cancel_may_be_driven(with_paths):
    with_paths.require(NoCommandAfterCancel())
    with_paths.require(StatusProtocol())
    with_paths.send_path(2.0)
    with_paths.run_for(0.5)
    assert with_paths.call(Trigger, 'cancel_goal').success
    with_paths.send_path(2.0)
    with_paths.run_for(0.5)
    assert with_paths.last('cmd_vel').linear.x > 0.1
    with_paths.finish()


def test_a_robot_that_stands_at_the_goal_too_late_is_said_to(lockstep, scene):
    lockstep.require(ReachesGoal(1.5))
    scene.send(goal_at(1.0))
    lockstep.node.create_timer(1.75, lambda: scene.send(odometry_at(1.0)))
    words = 'the robot stood at the goal 1.75 s after it was published; allowed: 1.5 s'
    with pytest.raises(PropertyViolation, match=words):
        lockstep.run_for(2.0)


@pytest.mark.parametrize('required', [KeepsDriving, ArrivesOnceFaultsEnd])
def test_a_goal_is_due_after_another_one_was_refused(with_paths, required):
    with_paths.require(required(2.0), NoStaleGoals(), StatusProtocol())
    with_paths.publish('goal_pose', goal_at(5.0, stamp=50))
    with_paths.publish('goal_pose', goal(1.0, 0.0, frame='elsewhere', stamp=60))
    with_paths.publish('path', path((1.0, 0.0), stamp=61))
    with_paths.run_for(0.3)
    assert with_paths.last('goal_status').status == EXECUTING
    assert change(with_paths.controller, **{'linear.x.max_velocity': 0.0}).successful
    violated(with_paths, 5.0, required.__name__)


@pytest.mark.parametrize('required', [KeepsDriving, ArrivesOnceFaultsEnd])
def test_the_end_of_a_path_is_a_goal_of_its_controller(with_paths, required):
    with_paths.require(required(20.0))
    with_paths.send_path(1.0)
    with_paths.run_until(lambda: with_paths.last('goal_status').status == SUCCEEDED, 15.0)
    with_paths.run_for(1.0)
    with_paths.finish()
    assert change(with_paths.controller, **{'linear.x.max_velocity': 0.0}).successful
    with_paths.require(required(1.0))
    with_paths.send_path(3.0)
    violated(with_paths, 9.0, r'the robot (has stood for 1.02 s|is .* of /go_to_goal at x 3 m)')


def test_goals_after_a_jump_of_the_clock_are_not_old(lockstep, scene):
    lockstep.require(NoStaleGoals())
    scene.send(status(ACCEPTED, stamp=5))
    lockstep.run_for(2.0)
    lockstep.jump(-1.0)
    scene(status(ACCEPTED, stamp=2))


def test_a_canceled_goal_is_not_due_for_the_recorder_either(lockstep, robot_at, recorded_run):
    """The recorder receives the goal, too, but its goal is not canceled."""
    robot_at()
    lockstep.add(make(GoToGoal))
    lockstep.require(ReachesGoal(1.0), Settles(1.0, 0.1), ArrivesOnceFaultsEnd(1.0))
    lockstep.publish('goal_pose', goal_at(5.0))
    lockstep.run_for(0.5)
    lockstep.call(Trigger, 'cancel_goal')
    finish_after(lockstep, 1.0)


def test_bytes_that_are_no_path_replace_one(lockstep, scene):
    lockstep.require(StaysOnPath(0.1))
    scene.send(path((0, 0), (1, 0)))
    lockstep.node.create_publisher(Path, 'path', 10).publish(b'')
    scene(odometry_at(0.0, 9.0), 0.1)


# --- Stopping

LOST = Loss('odom', start=1.01)


def test_stops_after_lost_odometry():
    drive(lambda: Student(timeout=0.3), StopsAfterLostOdometry(0.3), LOST, seconds=2.0)
    for timeout, within in ((0.3, 0.2), (0.0, 0.5)):
        with pytest.raises(PropertyViolation) as raised:
            drive(lambda timeout=timeout: Student(timeout=timeout), StopsAfterLostOdometry(within), LOST)
        text = raised.value.text
        assert text.startswith('the last command of /student is v 0.2 m/s, omega 0 rad/s, 0.')
        assert f'received its last message on /odom; allowed: {within:g} s' in text
        assert abs(raised.value.seconds - 1.0 - within) < 0.021


@pytest.mark.parametrize(
    'faults',
    [
        # At the time of the jump the clock has advanced by as much as world time since the pause began.
        [ClockPause(start=1.0, duration=1.0), TimeJump(1.0, start=2.0)],
        [Loss('odom', start=1.01, duration=2.0), Hang('student', start=1.1, duration=1.0)],
        [Loss('odom', start=1.01, duration=3.0), ClockPause(start=1.1, duration=2.0)],
        [Loss('odom', start=1.01, duration=2.0), TimeJump(-3.0, start=1.2)],
        [Loss('odom', start=1.01), Kill('student', start=1.1)],
    ],
)
def test_only_what_a_node_can_do_is_required_of_it(faults):
    """Of a frozen one, with a clock that stands or jumps, and of one that is gone."""
    drive(lambda: Student(timeout=0.3), StopsAfterLostOdometry(0.3), *faults, seconds=4.51)


def test_a_jump_while_a_robot_stands_counts_from_the_jump(lockstep, robot_at):
    """A controller that begins to drive long after it is late at once."""
    lockstep.require(StopsAfterLostOdometry(0.3))
    robot_at()
    student = lockstep.add(Student())
    student.command = twist(0.0)
    lockstep.inject(Loss('odom', start=1.0), TimeJump(1.0, start=1.1))
    lockstep.run_for(2.0)
    student.commands.publish(twist(0.2))
    assert 2.0 <= violated(lockstep, 1.0).seconds < 2.03


def test_the_test_itself_is_no_controller(lockstep, robot_at):
    lockstep.require(StopsAfterLostOdometry(0.1))
    robot = robot_at()
    lockstep.listen(Odometry, 'odom')
    lockstep.publish('cmd_vel', twist(0.2))
    lockstep.run_for(0.2)
    lockstep.remove(robot)
    finish_after(lockstep, 0.5)


def test_stops_after_last_command(lockstep, robot_at):
    robot = robot_at(cmd_vel_timeout=0.5)
    lockstep.require(StopsAfterLastCommand(0.5))
    for _ in range(3):
        lockstep.publish('cmd_vel', twist(0.2))
        lockstep.run_for(0.45)
    finish_after(lockstep, 1.0)
    assert change(robot, cmd_vel_timeout=0.0).successful
    lockstep.require(StopsAfterLastCommand(0.5))
    lockstep.publish('cmd_vel', twist(0.0, 0.2))
    assert violated(lockstep, 1.0).text.startswith(
        '/odom: v 0 m/s, omega 0.2 rad/s, 0.51 s after /virtual_robot has received its last message on '
        '/cmd_vel; allowed: 0.5 s'
    )


def test_motors_that_lag_roll_on(lockstep, robot_at):
    lockstep.require(StopsAfterLastCommand(0.6))
    robot_at(cmd_vel_timeout=0.5)
    lockstep.inject(ActuatorLag(0.2, start=0.1, duration=2.0))
    lockstep.publish('cmd_vel', twist(0.5))
    finish_after(lockstep, 3.0)


def test_commands_that_are_lost_do_not_count():
    with pytest.raises(PropertyViolation) as raised:
        drive(Student, StopsAfterLastCommand(0.5), Loss('cmd_vel', start=1.0))
    assert 1.49 < raised.value.seconds < 1.53


class Polite(Student):
    """Leaves a robot that stands."""

    def destroy_node(self):
        self.commands.publish(twist(0.0))
        super().destroy_node()


def test_stops_on_shutdown(lockstep, robot_at):
    robot_at()
    lockstep.require(StopsOnShutdown())
    killed, polite, rude = map(lockstep.add, (Student('killed'), Polite('polite'), Student('rude')))
    lockstep.run_for(0.1)
    for leave in (lambda: lockstep.remove(killed), polite.destroy_node):
        leave()
        lockstep.run_for(0.1)
    rude.destroy_node()
    assert '/rude was shut down after the command v 0.2 m/s' in violated(lockstep, 0.1).text


# --- Arriving once the faults end


@pytest.mark.parametrize(
    ('required', 'faults', 'seconds', 'goal'),
    [
        (ArrivesOnceFaultsEnd(5.0), [Loss('odom', start=0.5, duration=3.0)], 9.0, None),
        # Faults without an end, a goal that was not received or is refused, a controller without memory.
        (ArrivesOnceFaultsEnd(2.0), [Loss('odom', start=1.0)], 4.0, None),
        (ArrivesOnceFaultsEnd(2.0), [Loss('goal_pose', duration=1.0)], 4.0, None),
        (ArrivesOnceFaultsEnd(2.0), [], 3.0, goal(1.0, 0.0, frame='map')),
        (ArrivesOnceFaultsEnd(2.0), [Kill('go_to_goal', start=1.0, duration=1.0)], 5.0, None),
        # Without odometry it stands, which counts only when the fault is over.
        (
            KeepsDriving(0.5),
            [Loss('odom', start=0.5, duration=3.0), Hang('go_to_goal', start=4.0, duration=1.0)],
            8.0,
            None,
        ),
    ],
)
def test_what_cannot_arrive_need_not(required, faults, seconds, goal):
    drive(go_to_goal, required, *faults, seconds=seconds, goal=goal)


def test_arriving_too_late_or_not_in_the_run_is_a_violation():
    for within, seconds, words in (
        (0.5, 12.0, r's after the faults have ended the robot is 0\..* of /go_to_goal at x 3 m, y 0 m'),
        (5.0, 4.0, r'the run ended 0.5 s after the faults have ended'),
    ):
        lost = Loss('odom', start=0.5, duration=3.0)
        with pytest.raises(PropertyViolation, match=words) as raised:
            drive(go_to_goal, ArrivesOnceFaultsEnd(within), lost, seconds=seconds)
        assert 4.0 <= raised.value.seconds < 4.03


def test_a_robot_that_stands_on_its_way(lockstep, robot_at):
    robot_at()
    student = lockstep.add(Student())
    lockstep.require(KeepsDriving(0.5))
    lockstep.inject(Loss('cmd_vel', start=1.0, duration=1.0))
    lockstep.publish('goal_pose', goal_at(3.0))
    lockstep.run_for(3.0)
    student.command = twist(0.0)
    violation = violated(lockstep, 2.0)
    assert 3.5 < violation.seconds < 3.56
    assert violation.text.startswith('1.54 s after the faults have ended the robot has stood for 0.5')


def test_faults_have_ended_when_what_they_delayed_has_arrived():
    for faults, end in (
        ([], 0.0),
        ([Loss('odom', start=1.0, duration=2.0), Kill('a', duration=0.5)], 3.0),
        ([Delay('odom', 2.0, spread=0.5, growth=0.5, start=1.0, duration=2.0)], 6.5),
        ([Duplicate('odom', copies=2, seconds=0.5, duration=2.0)], 3.0),
        ([Reorder('odom', 0.5, 0.25, duration=1.0), LateService('a', 1.0, duration=1.0)], 2.25),
        ([Reorder('odom', 0.5, 0.25, duration=1.0), LateService('a', inf, duration=1.0)], 1.25),
        ([TimeJump(-1.0, start=2.0)], 2.0),
        ([Delay('odom', 1.0)], inf),
    ):
        assert end_of_faults(SimpleNamespace(faults=faults)) == end
