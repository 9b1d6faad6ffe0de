"""Nodes in processes of their own that take part in a lockstep world."""

from __future__ import annotations

import itertools
import math
import os
import random
import signal
import socket
import subprocess
import sys
import time

import external_nodes
import pytest
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_srvs.srv import Trigger
from support.domains import domain_id
from support.processes import PROGRAM

from diffdrive_jacobian.faults import ClockPause, Kill, Loss, TimeJump
from diffdrive_jacobian.lockstep._clock import Agenda, Clocks
from diffdrive_jacobian.lockstep._gate import Gates
from diffdrive_jacobian.lockstep._links import Links
from diffdrive_jacobian.lockstep.external import process as external_process
from diffdrive_jacobian.lockstep.external.expectations import AnswersDue, TicksDue
from diffdrive_jacobian.lockstep.external.topic import ExternalTopic
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.properties import NeverFasterThan
from diffdrive_jacobian.testing import Answers, Every, Idle, Lockstep, LockstepError, PropertyViolation

SECOND = 1_000_000_000
SCRIPT = external_nodes.__file__
GO_TO_GOAL = (sys.executable, '-c', PROGRAM.format('go_to_goal'))
QUICK = ('--ros-args', '-p', 'kp:=24.0', '-p', 'kv:=12.0')
_starts = itertools.count(100, step=100)


def odometry(x=0.0):
    message = Odometry()
    message.pose.pose.position.x = x
    message.pose.pose.orientation.w = 1.0
    return message


def stamp(message):
    return message.header.stamp.sec * SECOND + message.header.stamp.nanosec


@pytest.fixture(scope='module')
def gallery():
    """Start all controllers but the mortal one in one process, for all worlds. Return its domain."""
    domain = domain_id()
    environment = {
        **external_process.os.environ,
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_DOMAIN_ID': str(domain),
    }
    environment.pop(external_process.VARIABLE, None)
    names = [name for name in external_nodes.NODES if name != 'mortal']
    process = subprocess.Popen([sys.executable, SCRIPT, *names], env=environment)
    yield domain
    process.kill()
    process.wait()


@pytest.fixture
def world_of(gallery):
    """Return a function that opens a world with declarations in the domain of the gallery.

    Each starts later than all before, so that the timers of the gallery keep their phases.
    """
    worlds = []

    def open_world(*external):
        world = Lockstep(external=external, domain_id=gallery, start=float(next(_starts)))
        worlds.append(world)
        return world

    yield open_world
    for world in worlds:
        world.close()


# --- What is right


def drive(world):
    """Drive to a goal for two seconds, with a controller that is there. Return the odometry."""
    received = world.listen(Odometry, 'odom')
    goal = PoseStamped()
    goal.pose.position.x, goal.pose.position.y, goal.pose.orientation.w = 0.6, 0.4, 1.0
    world.publish('goal_pose', goal)
    world.run_for(2.0)
    return [repr(message) for message in received]


@pytest.mark.lockstep(external=[])
def test_a_controller_in_its_own_process_drives_as_in_the_same_one(lockstep, robot_at):
    robot = robot_at()
    controller = lockstep.start(*GO_TO_GOAL, *QUICK, answers=[Idle('go_to_goal')])
    received = drive(lockstep)
    assert math.dist(robot.truth[:2], (0.6, 0.4)) < 0.05
    assert lockstep.last('odom') is not None
    # From here on nothing is awaited from it, and the robot stops by its timeout.
    controller.kill()
    assert controller.returncode == -signal.SIGKILL
    lockstep.publish('cmd_vel', Twist())
    lockstep.run_for(1.0)
    lockstep.close()
    with Lockstep(QUICK) as isolated:
        isolated.add(VirtualRobot())
        isolated.add(GoToGoal())
        assert received == drive(isolated)


def test_each_message_is_answered_before_the_next_callback(world_of):
    world = world_of(Answers('echo/cmd_vel', to='echo/odom'))
    commands = world.listen(TwistStamped, 'echo/cmd_vel')
    stale = 0
    for number in range(100):
        world.publish('echo/odom', odometry(float(number)))
        assert [command.twist.linear.x for command in commands] == list(range(number + 1))
        stale += stamp(commands[-1]) != world.now
        world.run_for(0.01)
    # The time may arrive after the odometry, which DDS permits, but it practically never does.
    assert stale <= 2
    assert world.last('echo/cmd_vel').twist.linear.x == 99.0
    assert '/echo/cmd_vel: 100 from other processes' in world.report()
    assert 'not added' not in world.report()


def test_a_chain_of_processes_is_awaited_to_its_end(world_of):
    world = world_of(
        Answers('follower/cmd_vel', to='echo/cmd_vel'), Answers('echo/cmd_vel', to='echo/odom')
    )
    order = []
    world.node.create_subscription(
        TwistStamped, 'echo/cmd_vel', lambda m: order.append(('echo', m.twist.linear.x)), 10
    )
    world.node.create_subscription(
        TwistStamped, 'follower/cmd_vel', lambda m: order.append(('follower', m.twist.linear.x)), 10
    )
    for number in (1.0, 2.0):
        world.publish('echo/odom', odometry(number))
    # In the order of the declarations, although the echo was first.
    assert order == [('follower', 2.0), ('echo', 1.0), ('follower', 4.0), ('echo', 2.0)]


def test_an_answer_that_arrives_while_it_is_counted_what_is_due_is_answered_first(world_of, monkeypatch):
    update = AnswersDue.update

    def update_late(due, now, published):
        update(due, now, published)
        end = time.monotonic() + 10.0
        while due.topic == '/echo/cmd_vel' and published(due.topic) < due.due:
            assert time.monotonic() < end

    monkeypatch.setattr(AnswersDue, 'update', update_late)
    world = world_of(
        Answers('follower/cmd_vel', to='echo/cmd_vel'), Answers('echo/cmd_vel', to='echo/odom')
    )
    order = []
    for name in ('echo', 'follower'):
        world.node.create_subscription(
            TwistStamped, f'{name}/cmd_vel', lambda _, name=name: order.append(name), 10
        )
    world.publish('echo/odom', odometry(1.0))
    assert order == ['follower', 'echo']


def test_a_node_without_parameter_services_answers(world_of):
    world = world_of(Answers('bare/cmd_vel', to='bare/odom'))
    commands = world.listen(TwistStamped, 'bare/cmd_vel')
    for number in (1.0, 2.0, 3.0):
        world.publish('bare/odom', odometry(number))
    assert [command.twist.linear.x for command in commands] == [1.0, 2.0, 3.0]


def test_a_timer_of_another_process_expires_on_time(world_of):
    world = world_of(Every('ticker/cmd_vel', external_nodes.PERIOD))
    commands = world.listen(TwistStamped, 'ticker/cmd_vel')
    world.run_for(0.2)
    assert [stamp(command) for command in commands] == [
        world.now - n * SECOND // 20 for n in (4, 3, 2, 1, 0)
    ]
    # A service of the other process, which is awaited, too.
    assert world.call(Trigger, 'ticker/reset').success
    # A jump forward gives one tick, and one back none until the end of a period.
    world.jump(10.02)
    assert [stamp(command) for command in commands[5:]] == [world.now]
    world.run_for(0.03)
    assert [stamp(command) for command in commands[6:]] == [world.now]
    world.jump(-5.0)
    before = world.now
    world.run_for(0.1)
    assert [stamp(command) - before for command in commands[7:]] == [SECOND // 20, SECOND // 10]


def test_a_node_that_is_idle_has_answered_what_it_will(world_of):
    world = world_of(Idle('ticker'), Idle('echo'), Idle('follower'), Idle('mute'))
    names = ('ticker', 'echo', 'follower', 'mute')
    commands = {name: world.listen(TwistStamped, f'{name}/cmd_vel') for name in names}
    publisher = world.node.create_publisher(Odometry, 'ticker/odom', 10)
    world.node.create_timer(external_nodes.PERIOD, lambda: publisher.publish(odometry()))
    numbers = []
    for number in range(20):
        world.publish('mute/odom', odometry())
        world.publish('echo/odom', odometry(float(number)))
        numbers.append([len(commands[name]) for name in names[1:]])
        world.run_for(0.05)
    assert numbers == [[number, number, 0] for number in range(1, 21)]
    # At each time its timer expires before the messages of that time arrive.
    first, *others = [command.twist.linear.x for command in commands['ticker']]
    assert others == [first + number for number in range(20)]


def test_only_questions_under_a_condition_are_answered(world_of):
    asked = []
    world = world_of(Answers('double/cmd_vel', to='double/odom', count=2, when=lambda: len(asked) != 1))
    commands = world.listen(TwistStamped, 'double/cmd_vel')
    world.publish('double/odom', odometry())
    assert len(commands) == 2
    asked.append(1)

    def ask():
        world.publish('double/odom', odometry())
        # The surplus may come later.
        world.node.create_timer(0.01, lambda: None)
        world.run_until(lambda: len(commands) > 4, timeout=100.0)

    with pytest.raises(LockstepError, match=r'more on /double/cmd_vel .* than declared'):
        ask()


def test_faults_affect_the_nodes_of_the_world_only(world_of):
    world = world_of(Answers('echo/cmd_vel', to='echo/odom'))
    robot = Node('robot')
    received = []
    robot.create_subscription(
        TwistStamped, 'echo/cmd_vel', lambda m: received.append(m.twist.linear.x), 10
    )
    world.add(robot)
    commands = world.listen(TwistStamped, 'echo/cmd_vel')
    world.inject(Loss('echo/cmd_vel', node='robot', start=1.0, duration=1.0))
    for number in range(30):
        world.publish('echo/odom', odometry(float(number)))
        world.run_for(0.1)
    assert len(commands) == 30
    assert received == [*map(float, range(10)), *map(float, range(20, 30))]
    with pytest.raises(
        LockstepError, match=r"Loss\('echo/odom'\) cannot affect /echo: messages to other"
    ):
        world.inject(Loss('echo/odom'))


def test_a_fault_of_a_topic_that_turns_out_to_be_external_is_refused(world_of):
    world = world_of(Answers('echo/cmd_vel', to='echo/odom'))
    world.inject(Loss('echo/odom'))
    with pytest.raises(LockstepError, match=r"Loss\('echo/odom'\) cannot affect /echo"):
        world.connect()


def test_the_clock_jumps_and_stands_still_for_external_timers_too(world_of):
    world = world_of(Every('ticker/cmd_vel', external_nodes.PERIOD), Idle('ticker'))
    commands = world.listen(TwistStamped, 'ticker/cmd_vel')
    start = world.now
    world.inject(
        TimeJump(-2.0, start=0.22), ClockPause(start=0.4, duration=1.0), TimeJump(5.01, start=1.5)
    )
    world.run_for(2.0)
    ticks = [(stamp(command) - start) / SECOND for command in commands]
    before = [0.0, 0.05, 0.1, 0.15, 0.2]
    # The jump back restarts the period. One tick comes at the jump forward, which keeps the phase.
    back = [-1.73, -1.68, -1.63, -1.58, -1.53]
    forward = [3.51, *(3.52 + 0.05 * number for number in range(10))]
    assert ticks == pytest.approx([*before, *back, *forward])


def test_a_node_of_the_world_that_is_killed_and_made_again_is_discovered_again(world_of):
    world = world_of(Answers('echo/cmd_vel', to='echo/odom'))
    received = []

    def make():
        robot = Node('robot')
        robot.create_subscription(
            TwistStamped, 'echo/cmd_vel', lambda m: received.append(m.twist.linear.x), 10
        )
        publisher = robot.create_publisher(Odometry, 'echo/odom', 10)
        robot.create_timer(0.1, lambda: publisher.publish(odometry(world.elapsed)))
        return robot

    world.create(make)
    world.inject(Kill('robot', start=0.45, duration=0.5))
    world.run_for(1.5)
    # What it sends at the times at which it is made, before it is discovered, may be lost.
    received = [x for x in received if x not in (0.0, pytest.approx(0.95))]
    assert received == pytest.approx([0.1, 0.2, 0.3, 0.4, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5])


@pytest.mark.parametrize('declared', [Answers('echo/cmd_vel', to='echo/odom'), Idle('echo')])
def test_properties_observe_external_nodes(world_of, declared):
    world = world_of(declared)
    world.require(NeverFasterThan(2.5, 1.0, topic='echo/cmd_vel'))
    for speed in (1.0, 2.0):
        world.publish('echo/odom', odometry(speed))
    assert world.last('echo/cmd_vel').twist.linear.x == 2.0
    with pytest.raises(PropertyViolation, match='NeverFasterThan'):
        world.publish('echo/odom', odometry(3.0))


# --- What goes wrong


def test_no_answer_is_an_error_that_names_the_question(world_of):
    world = world_of(Answers('mute/cmd_vel', to='mute/odom', within=0.3))
    world.run_for(0.5)
    now = world.now / SECOND
    with pytest.raises(
        LockstepError,
        match=r'no message on /mute/cmd_vel within 0.3 s of wall time: answer to message 1 on '
        rf'/mute/odom, at {now:g} s; 0 received(.|\n)*/mute/odom: 1 from /lockstep',
    ):
        world.publish('mute/odom', odometry())


def test_a_node_on_wall_time_is_refused(world_of):
    world = world_of(Answers('untimed/cmd_vel', to='untimed/odom'))
    with pytest.raises(
        LockstepError,
        match=r'/untimed is not subscribed to /clock: its parameter use_sim_time must be true',
    ):
        world.run_for(1.0)


def test_topics_that_nobody_has_are_named_with_those_that_are_there(world_of):
    world = world_of(Answers('cmd_vel', to='odom'), Idle('missing'))
    with pytest.raises(LockstepError) as error:
        world.connect(timeout=1.0)
    for text in (
        'no external node publishes /cmd_vel',
        'no external node is subscribed to /odom',
        'no external node provides /missing/get_parameters',
        '/echo/cmd_vel',
    ):
        assert text in str(error.value)


@pytest.mark.parametrize('declared', [Answers('echo/cmd_vel', to='echo/odom'), Idle('echo')])
def test_qos_that_does_not_fit_is_named(world_of, declared):
    world = world_of(declared)
    world.listen(TwistStamped, 'echo/cmd_vel', latched=True)
    with pytest.raises(
        LockstepError, match=r'/lockstep to /echo/cmd_vel .* incompatible QoS: .*transient local, and'
    ):
        world.connect(timeout=1.0)


def test_another_type_is_named(world_of):
    world = world_of(Answers('echo/cmd_vel', to='echo/odom'))
    world.node.create_subscription(Twist, 'echo/cmd_vel', lambda _: None, 10)
    with pytest.raises(LockstepError, match=r'/echo/cmd_vel .*geometry_msgs/msg/Twist(Stamped)?'):
        world.connect(timeout=1.0)


def test_a_process_that_dies_while_driving_is_quoted():
    with Lockstep(external=[]) as world:
        mortal = world.start(
            sys.executable, SCRIPT, 'mortal', answers=[Answers('mortal/cmd_vel', to='mortal/odom')]
        )
        for number in range(external_nodes.LAST - 1):
            world.publish('mortal/odom', odometry(float(number)))
        publisher = world.node.create_publisher(Odometry, 'mortal/odom', 10)
        world.node.create_timer(0.1, lambda: publisher.publish(odometry()))
        with pytest.raises(LockstepError, match=r'has exited with 1\n +out of memory'):
            world.run_for(10.0)
        assert '/mortal/cmd_vel: ' in world.report()
    assert mortal.returncode == 1
    assert mortal.stderr.endswith('out of memory\n')


def test_a_process_that_is_no_node_is_not_waited_for_when_it_has_ended():
    with Lockstep(external=[Answers('cmd_vel', to='odom')]) as world:
        world.start('sh', '-c', 'echo no such file >&2; exit 3', use_sim_time=False)
        with pytest.raises(LockstepError, match=r'has exited with 3\n +no such file'):
            world.run_for(1.0)


# --- Processes


def until_says_hi(process):
    while 'hi' not in process.stdout:
        assert process.returncode is None


def test_a_process_and_its_children_are_ended_with_the_world():
    with Lockstep(external=[]) as world:
        command = 'trap "" INT; echo hi; sleep 60 & wait; sleep 60'
        stubborn = world.start('sh', '-c', command, use_sim_time=False)
        until_says_hi(stubborn)
        assert 'is running' in world.report()
        assert stubborn.stop(timeout=0.1) == -signal.SIGKILL
        command = 'trap "echo bye; exit 7" INT; echo hi; while :; do sleep 0.05; done'
        polite = world.start('sh', '-c', command, use_sim_time=False)
        until_says_hi(polite)
        forgotten = world.start('sleep', '60', use_sim_time=False)
        assert polite.stop() == 7
    assert polite.stdout == 'hi\nbye\n'
    assert forgotten.returncode == -signal.SIGINT


def test_a_process_in_a_session_of_its_own_is_ended_with_the_world(tmp_path):
    """As the daemon of ros2, and what that has started. It goes on if another world ends."""
    alive = tmp_path / 'alive'
    os.mkfifo(alive)
    reading = os.open(alive, os.O_RDONLY | os.O_NONBLOCK)
    daemon = f'setsid sh -c "exec 3> {alive}; echo hi; sleep 60; echo bye" & sleep 60'
    with Lockstep(external=[]) as world:
        launcher = world.start('sh', '-c', daemon, use_sim_time=False)
        until_says_hi(launcher)
        launcher.kill()
        external_process.end_all([external_process.ExternalProcess(['true'], {}, tmp_path, None)])
        with pytest.raises(BlockingIOError):
            os.read(reading, 1)
    # At the end of the file: nobody has it open for writing.
    assert os.read(reading, 1) == b''
    os.close(reading)


def test_a_process_that_ignores_sigint_is_killed_with_the_world(monkeypatch):
    monkeypatch.setattr(external_process.ExternalProcess.stop, '__defaults__', (0.1,))
    with Lockstep(external=[]) as world:
        stubborn = world.start('sh', '-c', 'trap "" INT; echo hi; sleep 60', use_sim_time=False)
        until_says_hi(stubborn)
    assert stubborn.returncode == -signal.SIGKILL


def test_a_process_receives_sigint_that_the_tests_ignore():
    """As they do if a shell has started them in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Lockstep(external=[]) as world:
            started = world.start('sleep', '60', use_sim_time=False)
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            assert started.stop() == -signal.SIGINT
    finally:
        signal.signal(signal.SIGINT, before)


def test_start_takes_a_program_and_only_in_an_open_world():
    with Lockstep() as world:
        with pytest.raises(LockstepError, match=r'isolated: give it external=\[\.\.\.\]'):
            world.start('true')
        with pytest.raises(LockstepError, match=r'isolated'):
            world.domain_id  # noqa: B018
        world.connect()
    with Lockstep(external=[]) as world:
        with pytest.raises(LockstepError, match=r'got none'):
            world.start()
        with pytest.raises(LockstepError, match=r'cannot be started: .*No such file'):
            world.start('no_such_program')
        with pytest.raises(ValueError, match=r"external must consist of .* got 'cmd_vel'"):
            world.start('true', answers=['cmd_vel'])
        assert world.environment == {
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_DOMAIN_ID': str(world.domain_id),
        }


def test_a_world_has_a_domain_of_its_own():
    with pytest.raises(ValueError, match=r'domain_id is for a world with external='):
        Lockstep(domain_id=3)
    with pytest.raises(ValueError, match=r'domain_id must be an integer from 0 to 232, got 233'):
        Lockstep(external=[], domain_id=233)
    domains = {external_process.free_domain() for _ in range(10)}
    assert len(domains) > 1
    assert 0 not in domains
    with Lockstep(external=[]) as world:
        # Its ports are in use, so no other world chooses it.
        assert not all(map(external_process._is_free, external_process._ports(world.domain_id)))


def test_a_domain_with_a_port_in_use_is_not_chosen(monkeypatch):
    monkeypatch.setattr(external_process, 'DOMAINS', range(90, 92))
    monkeypatch.delenv('PYTEST_XDIST_WORKER', raising=False)
    monkeypatch.delenv('PYTEST_XDIST_WORKER_COUNT', raising=False)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        # Of the fourth participant: the first may have ended before.
        taken.bind(('', 7400 + 250 * 90 + 10 + 2 * 3))
        assert {external_process.free_domain() for _ in range(4)} == {91}
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(('', external_process._ports(91)[0]))
            with pytest.raises(LockstepError, match=r'from 90 to 91 are all in use'):
                external_process.free_domain()


# --- Declarations


@pytest.mark.parametrize(
    ('create', 'message'),
    [
        (lambda: Answers('', to='odom'), "topic must be a string that is not empty, got ''"),
        (lambda: Answers('cmd_vel', to=3), 'to must be a string that is not empty, got 3'),
        (
            lambda: Answers('cmd_vel', to='odom', count=0),
            'count must be an integer of at least 1, got 0',
        ),
        (
            lambda: Answers('cmd_vel', to='odom', within=0.0),
            'within must be finite and at least 1e-09 s, got 0.0',
        ),
        (lambda: Every('cmd_vel', math.inf), 'period must be finite and at least 1e-09 s, got inf'),
        (lambda: Every('cmd_vel', 1e-10), 'period must be finite and at least 1e-09 s, got 1e-10'),
        (
            lambda: Every('cmd_vel', 0.1, created=-1.0),
            'created must be zero or positive and finite, got -1.0',
        ),
        (lambda: Idle(None), 'node must be a string that is not empty, got None'),
    ],
)
def test_declarations_are_checked(create, message):
    with pytest.raises(ValueError, match=message):
        create()


def test_questions_are_counted_from_the_start():
    published = 7
    due = AnswersDue(Answers('a', to='b', count=2), '/a', '/b')
    due.update(SECOND, lambda _: published)
    assert due.due == 0
    due.restart(lambda _: published)
    published += 2
    due.update(SECOND, lambda _: published)
    due.update(SECOND, lambda _: published)
    assert due.due == 4


def test_ticks_that_were_due_before_a_restart_are_not_awaited():
    due = TicksDue(Every('a', 0.1), '/a')
    due.restart(lambda _: 0)
    due.update(SECOND // 5, lambda _: 0)
    assert due.due == 2
    due.restart(lambda _: 0)
    assert due.due == 0


def test_messages_before_a_restart_are_not_delivered(ros):
    publisher = ros.peer.create_publisher(Twist, 'cmd_vel', 10)
    infos = ros.peer.get_publishers_info_by_topic('/cmd_vel')
    links = Links(Agenda(), Gates(Agenda()), Clocks(0))
    topic = ExternalTopic(ros.peer, '/cmd_vel', infos, links)
    for _ in range(3):
        publisher.publish(Twist())
    assert topic.count() == len(topic.deliver()) == 3
    publisher.publish(Twist())
    topic.restart()
    assert topic.count() == 0
    publisher.publish(Twist())
    assert len(topic.deliver()) == 1
    topic.close()


@pytest.mark.parametrize('seed', range(5))
def test_ticks_are_expected_when_rcl_has_them(lockstep, seed):
    rng = random.Random(seed)
    period = rng.choice([0.05, 0.1, 0.25, 1.0, 1 / 3, 0.57, rng.uniform(0.01, 2.0)])
    node = Node('timer')
    ticks = []
    node.create_timer(period, lambda: ticks.append(lockstep.now))
    due = TicksDue(Every('a', period), '/a')
    due.restart(lambda _: 0)
    lockstep.add(node)
    for _ in range(40):
        due.update(lockstep.now, lambda _: 0)
        assert due.due == len(ticks)
        if rng.random() < 0.2:
            seconds = rng.choice([-1.0, 1.0]) * rng.choice([0.3 * period, period, 7.3 * period])
            if lockstep.now / SECOND + seconds > 0.1:
                lockstep.jump(seconds)
        else:
            lockstep.step(at_most=rng.choice([0.4 * period, 2.0 * period]))
            assert due.next_time() - lockstep.now <= due._period
