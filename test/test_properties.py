"""Properties that are required of a run: each is violated and kept by nodes of a few lines."""

from __future__ import annotations

import pickle
from math import cos, inf, nan, sin

import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Twist
from lockstep_nodes import ABORTED, ACCEPTED, CANCELED, EXECUTING, SUCCEEDED, make
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from diffdrive_jacobian import properties
from diffdrive_jacobian.faults import ClockPause, Hang, Kill, Loss, TimeJump
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.properties import (
    AccelerationWithin,
    ArrivesOnceFaultsEnd,
    NeverFasterThan,
    NoCommandAfterCancel,
    PoseFinite,
    PropertyViolation,
    ReachesGoal,
    Settles,
    StatusProtocol,
    StaysNear,
    StaysWithin,
    StopsAfterLastCommand,
    StopsAfterLostOdometry,
    StopsOnShutdown,
)
from diffdrive_jacobian.testing import LockstepError


class Sender:
    """Publishers of a test that need no subscription."""

    def __init__(self, world):
        self._world = world
        self._publishers = {}

    def __call__(self, topic, message):
        key = type(message), topic
        if key not in self._publishers:
            self._publishers[key] = self._world.node.create_publisher(*key, 10)
        self._publishers[key].publish(message)


@pytest.fixture
def send(lockstep):
    return Sender(lockstep)


def twist(v, omega=0.0):
    message = Twist()
    message.linear.x, message.angular.z = float(v), float(omega)
    return message


# --- Requiring


def test_a_violation_names_property_time_value_limit_and_what_was_before(lockstep, send):
    lockstep.require(NeverFasterThan(0.5, 2.0))
    send('cmd_vel', twist(0.25))
    lockstep.run_for(1.0)
    send('cmd_vel', twist(0.75, -1.0))
    with pytest.raises(PropertyViolation) as raised:
        lockstep.run_for(1.0)
    violation = raised.value
    assert str(violation).startswith(
        'NeverFasterThan(0.5, 2.0) is violated at 1 s: /cmd_vel: v 0.75 m/s, omega -1 rad/s; '
        'allowed: |v| <= 0.5 m/s, |omega| <= 2 rad/s\nbefore that:\n'
        '  0 s: /cmd_vel: v 0.25 m/s, omega 0 rad/s'
    )
    assert 'last messages, at 2 s:' in str(violation)
    assert (violation.property, violation.seconds) == (NeverFasterThan(0.5, 2.0), 1.0)
    assert isinstance(violation, LockstepError)
    again = pickle.loads(pickle.dumps(violation))
    assert str(again) == str(violation)
    assert again.property == violation.property


def violated(lockstep, words):
    """Return the text of the violation that a second of simulated time shows."""
    with pytest.raises(PropertyViolation, match=words) as raised:
        lockstep.run_for(1.0)
    return raised.value.text


def test_a_violation_is_raised_once_and_the_other_properties_stay(lockstep, send):
    lockstep.require(NeverFasterThan(0.5, 2.0), NeverFasterThan(1.0, 2.0))
    send('cmd_vel', twist(0.75))
    with pytest.raises(PropertyViolation, match=r'^NeverFasterThan\(0.5, 2.0\)'):
        lockstep.settle()
    lockstep.run_for(1.0)
    send('cmd_vel', twist(1.75))
    with pytest.raises(PropertyViolation, match=r'^NeverFasterThan\(1.0, 2.0\)'):
        lockstep.run_for(1.0)
    lockstep.finish()


def test_a_violation_is_seen_in_every_way_of_advancing_time(lockstep, send):
    lockstep.node.create_timer(0.1, lambda: send('cmd_vel', twist(1.0)))
    advances = (
        lockstep.step,
        lambda: lockstep.run_until(lambda: False, 1.0),
        lambda: lockstep.run_for(0.1),
        lambda: lockstep.jump(5.0),
        lambda: lockstep.jump(-2.0) or lockstep.step(),
    )
    for advance in advances:
        lockstep.require(NeverFasterThan(0.5, 2.0))
        with pytest.raises(PropertyViolation):
            advance()


@pytest.mark.parametrize(
    ('argument', 'words'),
    [
        (NeverFasterThan, r'got the class NeverFasterThan; create one: NeverFasterThan\(...\)'),
        (0.5, 'require takes properties, got an object of the class float'),
    ],
)
def test_what_is_no_property_cannot_be_required(lockstep, argument, words):
    with pytest.raises(LockstepError, match=words):
        lockstep.require(argument)


def test_a_topic_that_nobody_could_publish_on_is_an_error_at_the_end(lockstep, send):
    lockstep.require(NeverFasterThan(0.5, 2.0, topic='cmd_vell'))
    send('cmd_vel', twist(0.1))
    lockstep.run_for(0.1)
    with pytest.raises(
        LockstepError,
        match=r"topic='cmd_vell'\) observes /cmd_vell, which no .* topics and services: /cmd_vel$",
    ) as raised:
        lockstep.finish()
    assert not isinstance(raised.value, PropertyViolation)


def test_nothing_that_a_node_can_notice_is_changed(lockstep):
    def graph():
        count = lockstep.node.count_subscribers
        return [count(topic) for topic in ('cmd_vel', 'odom', 'goal_pose', 'goal_status')]

    before = graph()
    lockstep.require(*(one for one, _ in VALUES))
    assert graph() == before


VALUES = [
    (NeverFasterThan(0.5, 2.0), 'NeverFasterThan(0.5, 2.0)'),
    (
        NeverFasterThan(0.5, float('inf'), topic='odom', namespace='/one'),
        "NeverFasterThan(0.5, float('inf'), namespace='/one', topic='odom')",
    ),
    (AccelerationWithin(1, 2, slack=0.2), 'AccelerationWithin(1.0, 2.0, slack=0.2)'),
    (StatusProtocol(goals=['goal_pose']), "StatusProtocol(goals=('goal_pose',))"),
]


@pytest.mark.parametrize(('one', 'expression'), VALUES, ids=lambda value: type(value).__name__)
def test_properties_are_values(one, expression):
    assert repr(one) == expression
    assert eval(expression, vars(properties)) == one
    assert pickle.loads(pickle.dumps(one)) == one
    hash(one)


@pytest.mark.parametrize(
    ('create', 'words'),
    [
        (lambda: NeverFasterThan(-1.0, 2.0), 'v must be a number of at least 0, got -1.0'),
        (lambda: NeverFasterThan(1.0, float('nan')), 'omega must be a number of at least 0, got nan'),
        (lambda: NeverFasterThan('1', 2.0), "v must be a number of at least 0, got '1'"),
        (
            lambda: NeverFasterThan(1.0, 2.0, topic=''),
            "topic must be a string that is not empty, got ''",
        ),
        (lambda: StatusProtocol(goals='goal_pose'), "goals must be a tuple of names, got 'goal_pose'"),
        (lambda: StatusProtocol(namespace=1), 'namespace must be a string, got 1'),
    ],
)
def test_invalid_fields_are_refused(create, words):
    with pytest.raises(ValueError, match=words):
        create()


# --- Speed


@pytest.mark.parametrize(
    ('v', 'omega', 'allowed'),
    [
        (0.5, 2.0, True),
        (-0.5, -2.0, True),
        (0.501, 0.0, False),
        (-0.501, 0.0, False),
        (0.0, -2.01, False),
        (float('nan'), 0.0, False),
        (0.0, float('inf'), False),
    ],
)
def test_never_faster_than(lockstep, send, v, omega, allowed):
    lockstep.require(NeverFasterThan(0.5, 2.0))
    send('cmd_vel', twist(v, omega))
    if allowed:
        lockstep.run_for(1.0)
        lockstep.finish()
    else:
        assert '/cmd_vel: v ' in violated(lockstep, 'NeverFasterThan')


def test_the_speed_of_odometry_in_a_namespace_as_messages_and_as_bytes(lockstep, send, robot_at):
    lockstep.require(NeverFasterThan(0.25, 1.0, topic='odom', namespace='/one'))
    robot_at(namespace='/one')
    lockstep.publish('/one/cmd_vel', twist(0.25))
    lockstep.run_for(0.1)
    send('/one/odom', Odometry())
    lockstep.publish('/one/cmd_vel', twist(0.3))
    assert violated(lockstep, 'NeverFasterThan').startswith('/one/odom: v 0.3 m/s')


def accelerate(lockstep, send, *commands, period=0.1):
    """Send commands at a period, and finish."""
    for command in commands:
        send('cmd_vel', twist(*command))
        lockstep.run_for(period)
    lockstep.finish()


def test_acceleration_within(lockstep, send):
    lockstep.require(AccelerationWithin(1.0, 2.0))
    # The limit, a stop, and a sequence that is early by the slack.
    accelerate(lockstep, send, (0.1, 0.2), (0.2, 0.4), (0.3, 0.2), (0.0, 0.0), (0.1,), (0.2,), (0.1,))


@pytest.mark.parametrize(
    'commands',
    [
        [(0.11,)],
        [(0.0, 0.21)],
        [(0.05,), (0.1,), (0.31,)],
        [(0.1,), (0.2,), (-0.1,)],
        [(0.1,), (float('nan'),)],
    ],
)
def test_acceleration_exceeded(lockstep, send, commands):
    lockstep.require(AccelerationWithin(1.0, 2.0))
    with pytest.raises(PropertyViolation, match=r'changes of 1 m/s and 2 rad/s per second|finite'):
        accelerate(lockstep, send, *commands)


def test_acceleration_twice_the_limit_is_found_even_with_much_slack(lockstep, send):
    lockstep.require(AccelerationWithin(1.0, 2.0, slack=0.5))
    ramp = [(0.2 * number,) for number in range(1, 12)]
    with pytest.raises(PropertyViolation):
        accelerate(lockstep, send, *ramp)
    assert 0.3 < lockstep.elapsed < 0.6


def test_a_stop_is_an_acceleration_where_it_is_not_allowed(lockstep, send):
    lockstep.require(AccelerationWithin(1.0, 2.0, stops=False))
    with pytest.raises(PropertyViolation):
        accelerate(lockstep, send, (0.1,), (0.2,), (0.3,), (0.0,))


# --- Status


def status(number, stamp=1, uuid=1):
    message = GoalStatus(status=number)
    message.goal_info.stamp.sec = stamp
    message.goal_info.goal_id.uuid[0] = uuid
    return message


KEPT = [
    [ACCEPTED],
    [ACCEPTED, EXECUTING, SUCCEEDED],
    [ACCEPTED, ACCEPTED, EXECUTING, EXECUTING, ABORTED],
    [ACCEPTED, CANCELED],
    [ABORTED],
    [ACCEPTED, EXECUTING, CANCELED, (ACCEPTED, 2), (EXECUTING, 2), (SUCCEEDED, 2)],
    [ACCEPTED, EXECUTING, (ABORTED, 2), EXECUTING, SUCCEEDED],
]
BROKEN = [
    ([EXECUTING], 'EXECUTING of the goal with stamp 1.000000000 s .* as its first status; allowed: ACC'),
    ([ACCEPTED, SUCCEEDED], 'SUCCEEDED of .* after ACCEPTED; allowed: ACCEPTED, EXECUTING, CANCELING'),
    ([ACCEPTED, EXECUTING, ACCEPTED], 'ACCEPTED of .* after EXECUTING'),
    (
        [ACCEPTED, EXECUTING, SUCCEEDED, SUCCEEDED],
        'SUCCEEDED of .* was SUCCEEDED already; allowed: noth',
    ),
    ([ACCEPTED, EXECUTING, SUCCEEDED, CANCELED], 'CANCELED of .* was SUCCEEDED already'),
    ([ABORTED, ACCEPTED], 'ACCEPTED of .* was ABORTED already'),
    ([ACCEPTED, (ACCEPTED, 2)], 'while the goal before is ACCEPTED; allowed: after its terminal status'),
    ([0], '0 of .* as its first status'),
    ([17], '17 of .* as its first status'),
]


def publish_statuses(lockstep, send, sequence, **kwargs):
    for one in sequence:
        number, *stamp = one if isinstance(one, tuple) else (one,)
        send('goal_status', status(number, *stamp, **kwargs))
        lockstep.settle()
    lockstep.finish()


def test_status_protocol(lockstep, send):
    for sequence in KEPT:
        lockstep.require(StatusProtocol())
        publish_statuses(lockstep, send, sequence)


def test_status_protocol_broken(lockstep, send):
    for sequence, words in BROKEN:
        lockstep.require(StatusProtocol())
        with pytest.raises(PropertyViolation, match=words):
            publish_statuses(lockstep, send, sequence)


def test_a_goal_without_identifier_may_be_accepted_again_when_it_is_received_again(lockstep, send):
    publisher = lockstep.node.create_publisher(GoalStatus, 'goal_status', 10)

    def answer(goal):
        for number in (ACCEPTED, EXECUTING, SUCCEEDED):
            message = status(number, uuid=0)
            message.goal_info.stamp = goal.header.stamp
            publisher.publish(message)

    lockstep.node.create_subscription(PoseStamped, 'goal_pose', answer, 10)
    lockstep.require(StatusProtocol())
    goal = PoseStamped()
    goal.header.stamp = Time(sec=3)
    for _ in range(3):
        lockstep.publish('goal_pose', goal)
    with pytest.raises(
        PropertyViolation, match=r'ACCEPTED of the goal with stamp 3.0+ s, which was SUCC'
    ):
        answer(goal) or lockstep.settle()


def test_the_controller_of_this_package_keeps_the_status_protocol(lockstep, robot_at, team):
    lockstep.require(StatusProtocol(), NeverFasterThan(5.0, 30.0))
    goal = PoseStamped()
    goal.pose.position.x = 0.1
    for _ in range(2):
        lockstep.publish('goal_pose', goal)
        lockstep.run_for(0.05)
    lockstep.run_until(lambda: team.statuses[-1] == SUCCEEDED, 10.0)
    goal.header.frame_id = 'map'
    lockstep.publish('goal_pose', goal)
    lockstep.finish()
    assert team.statuses == [ACCEPTED, EXECUTING, CANCELED, ACCEPTED, EXECUTING, SUCCEEDED, ABORTED]


# --- Stopping


class Student(Node):
    """A controller that answers odometry with the command that it is told."""

    def __init__(self, name='student', timeout=0.0):
        super().__init__(name)
        self.command = twist(0.2)
        self.commands = self.create_publisher(Twist, 'cmd_vel', 10)
        self.create_subscription(Odometry, 'odom', self.on_odometry, 10)
        self.create_subscription(PoseStamped, 'goal_pose', lambda _: None, 10)
        self.create_service(Trigger, 'cancel_goal', self.on_cancel)
        self.watchdog = self.create_timer(timeout, self.on_stale) if timeout else None

    def on_odometry(self, _):
        self.commands.publish(self.command)
        if self.watchdog:
            self.watchdog.reset()

    def on_stale(self):
        self.commands.publish(twist(0.0))

    def on_cancel(self, _, response):
        return response


@pytest.mark.parametrize(('timeout', 'within'), [(0.3, 0.3), (0.3, 0.2), (0.0, 0.5)])
def test_stops_after_lost_odometry(lockstep, robot_at, timeout, within):
    lockstep.require(StopsAfterLostOdometry(within))
    robot_at()
    lockstep.add(Student(timeout=timeout))
    lockstep.inject(Loss('odom', start=1.01))
    if timeout == within:
        lockstep.run_for(3.0)
        lockstep.finish()
        return
    with pytest.raises(PropertyViolation) as raised:
        lockstep.run_for(3.0)
    assert raised.value.text.startswith('the last command of /student is v 0.2 m/s, omega 0 rad/s, 0.')
    assert f'received its last message on /odom; allowed: {within:g} s' in raised.value.text
    assert abs(raised.value.seconds - 1.0 - within) < 0.021


def test_only_what_a_node_can_do_is_required_of_it(lockstep, robot_at):
    """A frozen node, a clock that stands or jumps back, and a node that is gone."""
    lockstep.require(StopsAfterLostOdometry(0.3))
    robot_at()
    student = lockstep.add(Student(timeout=0.3))
    lockstep.inject(
        Loss('odom', start=1.01, duration=2.0),
        Hang('student', start=1.1, duration=1.0),
        Loss('odom', start=4.01, duration=3.0),
        ClockPause(start=4.1, duration=2.0),
        Loss('odom', start=8.01, duration=2.0),
        TimeJump(-3.0, start=8.2),
    )
    lockstep.run_for(10.51)
    lockstep.remove(student)
    lockstep.run_for(1.0)
    lockstep.finish()


def test_a_controller_that_measures_by_the_time_of_day_does_not_stop_after_a_jump(lockstep, robot_at):
    class Polling(Student):
        def __init__(self):
            super().__init__()
            self.at = None
            self.create_timer(0.05, self.on_poll)

        def on_odometry(self, odom):
            super().on_odometry(odom)
            self.at = self.get_clock().now()

        def on_poll(self):
            if self.at and (self.get_clock().now() - self.at).nanoseconds > 0.3e9:
                self.commands.publish(twist(0.0))

    lockstep.require(StopsAfterLostOdometry(0.4))
    robot_at()
    lockstep.add(Polling())
    lockstep.inject(Loss('odom', start=1.0, duration=1.0), Loss('odom', start=3.0))
    lockstep.run_for(3.1)
    lockstep.jump(-2.0)
    with pytest.raises(PropertyViolation, match='/student'):
        lockstep.run_for(1.0)


def test_stops_after_last_command(lockstep, robot_at):
    robot = robot_at(cmd_vel_timeout=0.5)
    lockstep.require(StopsAfterLastCommand(0.5))
    for _ in range(3):
        lockstep.publish('cmd_vel', twist(0.2))
        lockstep.run_for(0.45)
    lockstep.run_for(1.0)
    lockstep.finish()
    assert robot.set_parameters([Parameter('cmd_vel_timeout', value=0.0)])[0].successful
    lockstep.require(StopsAfterLastCommand(0.5))
    lockstep.publish('cmd_vel', twist(0.0, 0.2))
    with pytest.raises(PropertyViolation) as raised:
        lockstep.run_for(1.0)
    assert raised.value.text.startswith(
        '/odom: v 0 m/s, omega 0.2 rad/s, 0.51 s after /virtual_robot has received its last message on '
        '/cmd_vel; allowed: 0.5 s'
    )


def test_commands_that_are_lost_do_not_count(lockstep, robot_at):
    robot_at(cmd_vel_timeout=0.0)
    lockstep.add(Student())
    lockstep.require(StopsAfterLastCommand(0.5))
    lockstep.inject(Loss('cmd_vel', start=1.0))
    with pytest.raises(PropertyViolation):
        lockstep.run_for(2.0)
    assert 1.49 < lockstep.elapsed < 1.53


def test_stops_on_shutdown(lockstep, robot_at):
    class Polite(Student):
        def destroy_node(self):
            self.commands.publish(twist(0.0))
            super().destroy_node()

    robot_at()
    lockstep.require(StopsOnShutdown())
    killed, polite, rude = (
        lockstep.add(kind(name))
        for kind, name in ((Student, 'killed'), (Polite, 'polite'), (Student, 'rude'))
    )
    lockstep.run_for(0.1)
    lockstep.remove(killed)
    lockstep.run_for(0.1)
    polite.destroy_node()
    lockstep.run_for(0.1)
    rude.destroy_node()
    with pytest.raises(PropertyViolation, match=r'/rude was shut down after the command v 0.2 m/s'):
        lockstep.run_for(0.1)


# --- Canceling


def test_no_command_after_cancel(lockstep, robot_at):
    robot_at()
    student = lockstep.add(Student())
    other = lockstep.node.create_publisher(Twist, 'cmd_vel', 10)
    lockstep.require(NoCommandAfterCancel())
    lockstep.run_for(0.1)
    student.command = twist(0.0)
    lockstep.call(Trigger, 'cancel_goal')
    other.publish(twist(0.5))
    lockstep.run_for(0.1)
    lockstep.publish('goal_pose', PoseStamped())
    student.command = twist(0.2)
    lockstep.run_for(0.1)
    lockstep.call(Trigger, 'cancel_goal')
    with pytest.raises(
        PropertyViolation,
        match=r'/cmd_vel: v 0.2 m/s, .* 0.02 s after /student has responded to /cancel_goal; allowed',
    ):
        lockstep.run_for(0.1)


def test_a_service_that_no_node_has_is_an_error_at_the_end(lockstep, robot_at):
    robot_at()
    lockstep.add(Student())
    lockstep.require(NoCommandAfterCancel(cancel='cancel'))
    lockstep.run_for(0.1)
    with pytest.raises(LockstepError, match=r'observes /cancel, which no .* /cancel_goal, /cmd_vel'):
        lockstep.finish()


# --- Goals and places


def odometry_at(x, y=0.0, v=0.0, theta=0.0):
    message = Odometry()
    message.pose.pose.position.x, message.pose.pose.position.y = float(x), float(y)
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = sin(theta / 2), cos(theta / 2)
    message.twist.twist.linear.x = float(v)
    return message


def goal_at(x, y=0.0, stamp=0):
    message = PoseStamped()
    message.pose.position.x, message.pose.position.y = float(x), float(y)
    message.pose.orientation.w = 1.0
    message.header.stamp.sec = stamp
    return message


class Scene:
    """Sends goals and odometry, with time between them, and finishes."""

    def __init__(self, world):
        self._world, self._send = world, Sender(world)

    def __call__(self, *events):
        for event in events:
            if isinstance(event, float):
                self._world.run_for(event)
            else:
                self._send('goal_pose' if isinstance(event, PoseStamped) else 'odom', event)
        self._world.finish()


@pytest.fixture
def scene(lockstep):
    return Scene(lockstep)


ARRIVES = [goal_at(1.0), 1.0, odometry_at(0.5, v=0.5), 0.5, odometry_at(0.96), 3.0]


def test_reaches_goal(lockstep, scene):
    lockstep.require(ReachesGoal(2.0))
    scene(*ARRIVES)
    lockstep.require(ReachesGoal(2.0))
    scene(goal_at(1.0), 1.0, goal_at(2.0), odometry_at(2.0, v=0.02), 1.9, odometry_at(2.0))


@pytest.mark.parametrize(
    ('required', 'events', 'words'),
    [
        (ReachesGoal(1.4), ARRIVES, r'1.4 s after .* the robot is 0.5 m from the goal at x 1 m, y 0 m'),
        (ReachesGoal(2.0, tolerance=0.03), ARRIVES, 'allowed: within 0.03 m and standing'),
        (ReachesGoal(1.0), [goal_at(1.0), 1.5], 'there was no odometry on /odom'),
        (
            ReachesGoal(1.0),
            [odometry_at(1.0, v=0.1), goal_at(1.0), 1.5],
            r'the robot is 0 m .* v 0.1 m/s',
        ),
        (
            ReachesGoal(1.0, yaw_tolerance=0.1),
            [goal_at(1.0), odometry_at(1.0, theta=3.1), 2.0],
            'theta 3.1 rad',
        ),
        (
            ReachesGoal(2.0),
            [goal_at(1.0), odometry_at(0.0), 1.0],
            r'the run ended 1 s after the goal was published, and the robot is 1 m .* run for 2 s after',
        ),
        (
            Settles(1.0, 0.1),
            [goal_at(1.0), odometry_at(0.0), 1.1, odometry_at(0.5), 0.1],
            '0.5 m from the',
        ),
        (
            Settles(1.0, 0.1),
            [goal_at(1.0), odometry_at(1.0), 1.5, odometry_at(1.0), 1.0, odometry_at(1.11), 0.1],
            r'2.5 s after the goal was published the robot is 0.11 m .* allowed: 0.1 m',
        ),
        (Settles(1.0, 0.1), [goal_at(1.0), odometry_at(1.0), 0.5], 'the run ended 0.5 s after the goal'),
        (
            StaysWithin((0.0, 1.0), (-1.0, 1.0)),
            [odometry_at(1.01), 0.1],
            'allowed: x from 0 m to 1 m, y fr',
        ),
        (StaysWithin((0.0, 1.0), (-1.0, 1.0)), [odometry_at(nan), 0.1], 'x nan m'),
        (
            StaysNear([(0, 0), (1, 0), (1, 1)], 0.1),
            [odometry_at(0.5), 0.1, odometry_at(1.1, 0.5), 0.1, odometry_at(1.0, 1.2), 0.1],
            r'0.2 s|at most 0.1 m from the path, not 0.2 m',
        ),
        (PoseFinite(), [odometry_at(inf), 0.1], 'x inf m'),
        (PoseFinite(), [odometry_at(0.0, v=nan), 0.1], 'v nan m/s'),
        (PoseFinite(), [odometry_at(2e6), 0.1], 'allowed: finite values, and a position of at most 1e'),
    ],
)
def test_goals_and_places_violated(lockstep, scene, required, events, words):
    lockstep.require(required)
    with pytest.raises(PropertyViolation, match=words):
        scene(*events)


def test_settles_and_places_kept(lockstep, scene):
    lockstep.require(
        Settles(1.0, 0.1),
        StaysWithin((0, 3), (0, 0)),
        StaysNear([(0.0, 0.0), (3.0, 0.0)], 0.0),
        StaysNear([(1.0, 0.0)], 2.0),
        PoseFinite(),
    )
    scene(odometry_at(0), goal_at(1), 1.0, odometry_at(1.1), 1.0, goal_at(3), odometry_at(3), 1.5)


def test_a_goal_that_is_canceled_is_not_due(lockstep, robot_at):
    robot_at()
    lockstep.add(make(GoToGoal))
    lockstep.require(ReachesGoal(2.0), Settles(2.0, 0.1), ArrivesOnceFaultsEnd(2.0))
    lockstep.publish('goal_pose', goal_at(5.0))
    lockstep.run_for(1.0)
    lockstep.call(Trigger, 'cancel_goal')
    lockstep.run_for(3.0)
    lockstep.finish()


# --- Arriving once the faults end


def drive(lockstep, robot_at, *faults, seconds=12.0, goal=None):
    """Drive the robot of this package to a goal three meters away, and finish."""
    robot_at()
    lockstep.create(lambda: make(GoToGoal, kp=4.0, kv=1.0))
    lockstep.inject(*faults)
    lockstep.publish('goal_pose', goal or goal_at(3.0, stamp=1))
    lockstep.run_for(seconds)
    lockstep.finish()


def test_arrives_once_faults_end(lockstep, robot_at):
    lockstep.require(ArrivesOnceFaultsEnd(5.0))
    drive(lockstep, robot_at, Loss('odom', start=0.5, duration=3.0), seconds=9.0)


def test_arrives_too_late(lockstep, robot_at):
    lockstep.require(ArrivesOnceFaultsEnd(0.5))
    with pytest.raises(PropertyViolation) as raised:
        drive(lockstep, robot_at, Loss('odom', start=0.5, duration=3.0))
    assert 4.0 < raised.value.seconds < 4.03
    assert 's after the faults have ended the robot is 0.' in raised.value.text
    assert 'm from the goal of /go_to_goal at x 3 m, y 0 m' in raised.value.text


def test_a_run_that_ends_too_early_shows_nothing(lockstep, robot_at):
    lockstep.require(ArrivesOnceFaultsEnd(5.0))
    with pytest.raises(PropertyViolation, match=r'the run ended 0.5 s after the faults have ended'):
        drive(lockstep, robot_at, Loss('odom', start=0.5, duration=3.0), seconds=4.0)


@pytest.mark.parametrize(
    'faults',
    [
        [Loss('odom', start=1.0)],
        [Loss('goal_pose', duration=1.0)],
        [Kill('go_to_goal', start=1.0, duration=1.0)],
    ],
)
def test_what_cannot_arrive_need_not(lockstep, robot_at, faults):
    """Faults without an end, a goal that was not received, a controller without its memory."""
    lockstep.require(ArrivesOnceFaultsEnd(2.0))
    drive(lockstep, robot_at, *faults, seconds=6.0)


def test_a_goal_that_is_refused_is_not_due(lockstep, robot_at):
    lockstep.require(ArrivesOnceFaultsEnd(2.0))
    goal = goal_at(1.0)
    goal.header.frame_id = 'map'
    drive(lockstep, robot_at, seconds=3.0, goal=goal)
