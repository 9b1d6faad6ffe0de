"""Nodes in processes of their own that take part in a lockstep world, unchanged and undeclared."""

from __future__ import annotations

import itertools
import math
import os
import signal
import socket
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import external_nodes
import pytest
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger
from support.processes import PROGRAM

from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.exploration.trial import MessageDigest
from diffdrive_jacobian.faults import ClockPause, Corrupt, Delay, Hang, Kill, Loss, Slow, TimeJump
from diffdrive_jacobian.lockstep.external import datagrams, node_process
from diffdrive_jacobian.lockstep.external import process as external_process
from diffdrive_jacobian.lockstep.external import quiet as quietness
from diffdrive_jacobian.lockstep.external.process import ExternalProcess
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.properties import NeverFasterThan
from diffdrive_jacobian.testing import Lockstep, LockstepError, PropertyViolation, check_repeats

SECOND = 1_000_000_000
GO_TO_GOAL = [sys.executable, '-c', PROGRAM.format('go_to_goal')]
QUICK = ['--ros-args', '-p', 'kp:=24.0', '-p', 'kv:=12.0']


WORLD = """
import sys, time
from diffdrive_jacobian.testing import Lockstep
with Lockstep() as world:
    process = world.start(sys.argv[1:])
    print(*process._quiet.processes(), flush=True)
    time.sleep(60.0)
"""


def command(*names):
    """Return the command that starts a process with some nodes of `external_nodes`."""
    return [sys.executable, external_nodes.__file__, *names]


def odometry(x=0.0):
    message = Odometry()
    message.pose.pose.position.x = x
    message.pose.pose.orientation.w = 1.0
    return message


def stamp(message):
    return message.header.stamp.sec * SECOND + message.header.stamp.nanosec


def speeds(commands):
    return [one.twist.linear.x for one in commands]


# --- What is right


def drive(world):
    """Drive to a goal for two seconds, with a controller that is there. Return the odometry."""
    received = world.listen(Odometry, 'odom')
    goal = PoseStamped()
    goal.pose.position.x, goal.pose.position.y, goal.pose.orientation.w = 0.6, 0.4, 1.0
    world.publish('goal_pose', goal)
    world.run_for(2.0)
    return [repr(message) for message in received]


def test_a_controller_in_its_own_process_drives_as_in_the_same_one(lockstep, robot_at):
    robot = robot_at()
    controller = lockstep.start([*GO_TO_GOAL, *QUICK])
    assert [node.get_name() for node in controller.nodes] == ['go_to_goal']
    received = drive(lockstep)
    assert math.dist(robot.truth[:2], (0.6, 0.4)) < 0.05
    assert '/cmd_vel: 15 from /go_to_goal' in lockstep.report()
    # From here on the robot stops by its timeout.
    controller.kill()
    assert controller.returncode == -signal.SIGKILL
    lockstep.run_for(1.0)
    lockstep.close()
    with Lockstep(QUICK) as isolated:
        isolated.add(VirtualRobot())
        isolated.add(GoToGoal())
        assert received == drive(isolated)


def test_each_message_is_answered_before_the_next_callback(lockstep):
    echo = lockstep.start(command('echo'))
    commands = lockstep.listen(TwistStamped, 'echo/cmd_vel')
    for number in range(50):
        lockstep.publish('echo/odom', odometry(float(number)))
        assert speeds(commands) == list(range(number + 1))
        assert stamp(commands[-1]) == lockstep.now
        lockstep.run_for(0.01)
    assert lockstep.find('echo') is echo.nodes[0]
    assert lockstep.last('echo/cmd_vel').twist.linear.x == 49.0


def test_several_nodes_in_a_process_and_one_without_parameter_services(lockstep):
    process = lockstep.start(command('bare', 'double'))
    assert sorted(node.get_name() for node in process.nodes) == ['bare', 'double']
    bare = lockstep.listen(TwistStamped, 'bare/cmd_vel')
    double = lockstep.listen(TwistStamped, 'double/cmd_vel')
    for number in (1.0, 2.0):
        lockstep.publish('bare/odom', odometry(number))
        lockstep.publish('double/odom', odometry(10.0 * number))
    assert speeds(bare) == [1.0, 2.0]
    assert speeds(double) == [10.0, 10.0, 20.0, 20.0]


def test_a_timer_expires_on_time_also_when_the_clock_jumps(lockstep):
    lockstep.start(command('ticker'))
    commands = lockstep.listen(TwistStamped, 'ticker/cmd_vel')
    lockstep.run_for(0.2)
    begin = lockstep.now - SECOND // 5
    assert [stamp(one) - begin for one in commands] == [n * SECOND // 20 for n in (1, 2, 3, 4)]
    # A jump forward gives one tick, and one back none until the end of a period.
    lockstep.jump(10.02)
    assert [stamp(one) for one in commands[4:]] == [lockstep.now]
    lockstep.run_for(0.03)
    assert [stamp(one) for one in commands[5:]] == [lockstep.now]
    lockstep.jump(-5.0)
    lockstep.run_for(0.2)
    assert len(commands) >= 9


def test_parameters_services_and_latched_topics_pass(lockstep):
    lockstep.publish('ticker/map', String(data='abc'), latched=True)
    lockstep.start(command('ticker'))
    assert lockstep.last('ticker/description').data == 'first'
    late = lockstep.listen(String, 'ticker/description', latched=True)
    assert [one.data for one in late] == ['first']
    commands = lockstep.listen(TwistStamped, 'ticker/cmd_vel')
    lockstep.run_for(0.1)
    assert speeds(commands) == [3.0, 3.0]
    assert lockstep.call(Trigger, 'ticker/reset').success
    response = lockstep.call(
        GetParameters, 'ticker/get_parameters', GetParameters.Request(names=['gain'])
    )
    assert response.values[0].type == ParameterType.PARAMETER_DOUBLE
    assert response.values[0].double_value == 2.0
    lockstep.run_for(0.05)
    assert speeds(commands[2:]) == [0.0]


def test_a_topic_that_is_created_later_passes(lockstep):
    lockstep.start(command('late'))
    for number in range(3):
        lockstep.publish('late/odom', odometry(float(number)))
        if not number:
            commands = lockstep.listen(TwistStamped, 'late/late')
    assert speeds(commands) == [1.0, 2.0]


def test_a_process_calls_services_of_the_world(lockstep):
    numbers = iter(range(1, 10))
    server = Node('server')

    async def answer(_, response):
        await lockstep.node.executor.create_task(lambda: None)
        response.message = str(next(numbers))
        return response

    server.create_service(Trigger, 'caller/ask', answer)
    lockstep.start(command('caller'))
    lockstep.add(server)
    commands = lockstep.listen(TwistStamped, 'caller/cmd_vel')
    for _ in range(3):
        lockstep.publish('caller/odom', odometry())
    assert speeds(commands) == [1.0, 2.0, 3.0]


def test_an_action_of_a_process(lockstep):
    actions = pytest.importorskip('test_msgs.action', reason='test_msgs is not installed')
    lockstep.start(command('counting'))
    client = ActionClient(lockstep.node, actions.Fibonacci, 'counting/count')
    feedback = []
    goal = client.send_goal_async(
        actions.Fibonacci.Goal(order=5), lambda one: feedback.append(list(one.feedback.sequence))
    )
    lockstep.run_until(goal.done, timeout=5.0)
    result = goal.result().get_result_async()
    lockstep.run_until(result.done, timeout=5.0)
    assert list(result.result().result.sequence) == [0, 1, 1, 2, 3]
    assert feedback == [[0, 1, 1], [0, 1, 1, 2], [0, 1, 1, 2, 3]]
    client.destroy()


def test_a_process_that_hears_itself_does_not_hear_it_twice(lockstep):
    lockstep.start(command('hearing'))
    sums = lockstep.listen(Float64, 'hearing/sum')
    commands = lockstep.listen(TwistStamped, 'hearing/cmd_vel')
    lockstep.publish('hearing/odom', odometry(1.0))
    lockstep.publish('hearing/odom', odometry(2.0))
    foreign = TwistStamped()
    foreign.twist.linear.x = 10.0
    lockstep.publish('hearing/cmd_vel', foreign)
    lockstep.publish('hearing/odom', odometry(4.0))
    assert [one.data for one in sums] == [1.0, 3.0, 13.0, 17.0]
    assert len(commands) == 4


def combined(seed):
    with Lockstep() as world, MessageDigest(world) as digest:
        for name in 'abc':
            world.start(command(name))
        values = world.listen(Float64, 'combined')
        publisher = world.node.create_publisher(Odometry, 'odom', 10)
        world.node.create_timer(0.02, lambda: publisher.publish(odometry(0.01 * len(values))))
        world.run_for(0.5)
        assert len(values) == 25
        return digest.value()


def test_processes_that_talk_to_one_another_do_the_same_each_time():
    assert combined(0) == combined(1)


def test_nodes_of_one_process_that_share_topics_receive_one_after_the_other(lockstep):
    process = lockstep.start(command('other', 'shared', 'sharing'))
    assert [node.get_name() for node in process.nodes] == ['other', 'shared', 'sharing']
    heard = lockstep.listen(String, 'heard')
    words = lockstep.listen(String, 'words')
    for number in range(5):
        lockstep.publish('sharing/odom', odometry(float(number)))
    assert [one.data for one in words] == ['0', '1', '2', '3', '4']
    assert [one.data for one in heard] == [
        f'{name} {number + 1} {number}' for number in range(5) for name in ('sharing', 'other', 'shared')
    ]
    # Each sends for itself, and what they send to one another may be lost.
    report = lockstep.report()
    assert all(f'/heard: 5 from /{name}' in report for name in ('other', 'shared', 'sharing'))
    lockstep.inject(Loss('words'))
    lockstep.publish('sharing/odom', odometry(5.0))
    lockstep.check_faults()
    assert [one.data for one in heard[15:]] == ['sharing 6 5']


def test_a_node_that_is_created_later_takes_part(lockstep):
    lockstep.start(command('growing'))
    lockstep.publish('growing/odom', odometry())
    lockstep.run_for(0.2)
    assert lockstep.find('child') is not None
    commands = lockstep.listen(TwistStamped, 'child/cmd_vel')
    lockstep.run_for(0.1)
    assert len(commands) == 2


def answer_with_numbers(world, name):
    """Offer a service that answers with the number of the request."""
    numbers = itertools.count(1)

    async def answer(_, response):
        await world.node.executor.create_task(lambda: None)
        response.message = str(next(numbers))
        return response

    return world.node.create_service(Trigger, name, answer)


def test_a_callback_waits_for_a_service_of_the_world(lockstep):
    """What else is sent to it meanwhile comes after the response, as do later times."""
    answer_with_numbers(lockstep, 'asking/ask')
    lockstep.start(command('asking'))
    commands = lockstep.listen(TwistStamped, 'asking/cmd_vel')
    publisher = lockstep.node.create_publisher(Odometry, 'asking/odom', 10)
    for _ in range(3):
        publisher.publish(odometry())
        publisher.publish(odometry())
        lockstep.run_for(0.03)
    assert speeds(commands) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


def test_a_response_that_comes_later_in_simulated_time_is_not_waited_for(lockstep):
    """The timeout of the callback is wall time. So no simulated time passes, whatever that is."""
    slow = []

    async def answer(_, response):
        slow.append(Future())
        await slow[-1]
        return response

    lockstep.node.create_service(Trigger, 'asking/ask', answer)
    lockstep.start(command('asking'))
    commands = lockstep.listen(TwistStamped, 'asking/cmd_vel')
    publisher = lockstep.node.create_publisher(Odometry, 'asking/odom', 10)
    begin = lockstep.now
    for _ in range(2):
        publisher.publish(odometry())
    lockstep.run_for(0.1)
    assert speeds(commands) == [-1.0, -1.0]
    assert [stamp(one) for one in commands] == [begin, begin]
    slow[0].set_result(None)
    lockstep.run_for(0.1)
    assert len(commands) == 2


def test_a_callback_whose_wait_ends_before_the_response_is_an_error(lockstep):
    def answer(_, response):
        time.sleep(1.0)
        return response

    lockstep.node.create_service(Trigger, 'asking/ask', answer)
    lockstep.start(command('asking'))
    with pytest.raises(LockstepError, match=r'/asking.* waited for the response of a service until its'):
        lockstep.publish('asking/odom', odometry())


def test_a_service_is_called_while_a_process_starts(lockstep):
    answer_with_numbers(lockstep, 'asking_first/ask')
    lockstep.start(command('asking_first'))
    assert [one.data for one in lockstep.listen(String, 'asking_first/first', latched=True)] == ['1']


def test_rules_and_parameters_of_the_user_stay(lockstep):
    rules = ['--ros-args', '-r', 'echo/odom:=pose', '-r', '__ns:=/left', '-r', '/clock:=/sim/clock']
    process = lockstep.start([*command('echo'), *rules])
    assert process.nodes[0].get_fully_qualified_name() == '/left/echo'
    commands = lockstep.listen(TwistStamped, '/left/echo/cmd_vel')
    lockstep.run_for(0.1)
    lockstep.publish('/left/pose', odometry(3.0))
    assert speeds(commands) == [3.0]
    assert stamp(commands[0]) == lockstep.now


def test_a_last_command_of_a_process_that_is_stopped_is_received(lockstep):
    polite = lockstep.start(command('echo', 'polite'))
    commands = lockstep.listen(TwistStamped, 'echo/cmd_vel')
    lockstep.publish('echo/odom', odometry(1.0))
    assert polite.stop() == 0
    lockstep.settle()
    assert speeds(commands) == [1.0, -9.0]
    assert polite.nodes == []


# --- Faults and properties


INTERRUPTED = """
import time

import rclpy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
node = rclpy.create_node('interrupted')
publisher = node.create_publisher(String, 'last', 10)
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    publisher.publish(String(data='last'))
    # If it ended at once, its end might be discovered before the message is received.
    time.sleep(0.5)
"""


def test_a_program_that_waits_is_woken_up_to_be_interrupted(lockstep):
    process = lockstep.start([sys.executable, '-c', INTERRUPTED])
    last = lockstep.listen(String, 'last')
    assert process.stop() == 0
    lockstep.settle()
    assert [one.data for one in last] == ['last']


def test_a_node_is_gone_when_its_process_was_ended(lockstep, robot_at):
    robot = robot_at()
    lockstep.start(command('echo')).kill()
    assert lockstep.find('virtual_robot') is robot
    with pytest.raises(LockstepError, match='no node'):
        lockstep.find('echo')


def test_faults_of_topics_affect_both_directions(lockstep):
    lockstep.start(command('echo'))
    commands = lockstep.listen(TwistStamped, 'echo/cmd_vel')
    robot = Node('robot')
    received = []
    robot.create_subscription(
        TwistStamped, 'echo/cmd_vel', lambda m: received.append(m.twist.linear.x), 10
    )
    lockstep.add(robot)
    lockstep.inject(
        Loss('echo/odom', start=1.0, duration=0.3),
        Corrupt('echo/odom', 'pose.pose.position.x', 'negate', start=1.5, duration=0.2),
        Loss('echo/cmd_vel', start=2.0, duration=0.2),
        Delay('echo/odom', 0.1, start=2.5),
    )
    for number in range(30):
        lockstep.publish('echo/odom', odometry(float(number)))
        lockstep.run_for(0.1)
    expected = [*range(10), 13, 14, -15, -16, *range(17, 30)]
    assert speeds(commands) == expected
    assert received == [x for x in expected if x not in (20, 21)]
    assert stamp(commands[-1]) - SECOND == round(3.0 * SECOND)


def test_a_process_that_hangs_or_is_slow(lockstep):
    lockstep.start(command('echo'), queue_depth=2)
    commands = lockstep.listen(TwistStamped, 'echo/cmd_vel')
    times = []
    lockstep.on_published('echo/cmd_vel', lambda *_: times.append(round(lockstep.elapsed, 3)))
    lockstep.inject(Hang('echo', start=0.1, duration=0.2), Slow('echo', 0.03, start=0.5, duration=0.2))
    for number in range(8):
        lockstep.publish('echo/odom', odometry(float(number)))
        lockstep.run_for(0.1)
    assert speeds(commands) == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    assert times == [0.0, 0.3, 0.3, 0.3, 0.4, 0.53, 0.63, 0.7]


def test_a_process_is_killed_and_started_again(lockstep):
    process = lockstep.start(command('ticker'))
    commands = lockstep.listen(TwistStamped, 'ticker/cmd_vel')
    publisher = lockstep.node.create_publisher(Odometry, 'ticker/odom', 10)
    lockstep.node.create_timer(0.05, lambda: publisher.publish(odometry()))
    before = process.pid
    lockstep.inject(Kill('ticker', start=0.42, duration=0.3))
    lockstep.run_for(0.5)
    assert process.returncode == -signal.SIGKILL
    with pytest.raises(LockstepError, match='there is no node /ticker'):
        lockstep.find('ticker')
    lockstep.run_for(0.5)
    assert process.pid != before
    assert lockstep.find('ticker') is process.nodes[0]
    # Without its memory.
    ticks = [(round((stamp(one) - SECOND) / SECOND, 3), one.twist.linear.x) for one in commands]
    assert [time for time, _ in ticks if time < 0.72] == pytest.approx([0.05 * n for n in range(1, 9)])
    assert ticks[8][1] == 0.0
    assert len(ticks) > 12


def test_a_process_that_is_stopped_while_a_fault_has_killed_it_is_not_started_again(lockstep):
    echo = lockstep.start(command('echo'))
    lockstep.inject(Kill('echo', start=0.1, duration=0.2))
    lockstep.run_for(0.2)
    echo.stop()
    lockstep.run_for(0.3)
    assert 'echo' not in [node.get_name() for node in lockstep.nodes]
    assert echo.returncode is not None


def test_the_clock_jumps_and_stands_still_for_processes_too(lockstep):
    lockstep.start(command('ticker'))
    commands = lockstep.listen(TwistStamped, 'ticker/cmd_vel')
    lockstep.inject(
        TimeJump(-0.5, start=0.22), ClockPause(start=0.4, duration=1.0), TimeJump(5.01, start=1.5)
    )
    lockstep.run_for(2.0)
    ticks = [round((stamp(one) - SECOND) / SECOND, 3) for one in commands]
    assert ticks[:4] == [0.05, 0.1, 0.15, 0.2]
    assert all(-0.28 <= tick < 0.1 for tick in ticks[4:8])
    # None while the clock stands, and one at the jump forward.
    assert all(tick < 0.1 or tick > 4.9 for tick in ticks[4:])
    assert len([tick for tick in ticks if tick > 4.9]) == pytest.approx(11, abs=1)


def test_properties_observe_processes(lockstep):
    lockstep.start(command('echo'))
    lockstep.require(NeverFasterThan(2.5, 1.0, topic='echo/cmd_vel'))
    for speed in (1.0, 2.0):
        lockstep.publish('echo/odom', odometry(speed))
    with pytest.raises(PropertyViolation, match='NeverFasterThan'):
        lockstep.publish('echo/odom', odometry(3.0))


def test_what_processes_publish_is_recorded(lockstep, recorded_run):
    lockstep.start(command('echo', 'ticker'))
    for number in range(3):
        lockstep.publish('echo/odom', odometry(float(number)))
        lockstep.run_for(0.1)
    recorded_run.finish()
    with open_bag(recorded_run.bag) as bag:
        counts = Counter(connection.topic for connection, _, _ in bag.messages())
    assert counts['/echo/cmd_vel'] == counts['/echo/odom'] == 3
    assert counts['/ticker/cmd_vel'] >= 6
    # Latched, before the process took part.
    assert counts['/ticker/description'] == 1


# --- Attacks: right, or a named error


@pytest.mark.parametrize('name', ['sleeping', 'starting', 'blocking'])
def test_a_callback_that_sleeps_or_waits_is_waited_for(lockstep, name):
    lockstep.start(command(name))
    commands = lockstep.listen(TwistStamped, f'{name}/cmd_vel')
    for number in range(10):
        lockstep.publish(f'{name}/odom', odometry(float(number)))
        assert speeds(commands) == list(range(number + 1))


@pytest.mark.parametrize('name', ['repeater', 'best_effort'])
def test_large_messages_and_many_at_once_arrive_complete(lockstep, name):
    lockstep.start([*command(name), '--ros-args', '-p', 'times:=3'])
    received = lockstep.listen(String, f'{name}/out')
    texts = [str(digit) * 700_000 for digit in range(3)]
    for text in texts:
        lockstep.publish(f'{name}/in', String(data=text))
    assert [one.data for one in received] == [text for text in texts for _ in range(3)]


def lose(world, name):
    for _ in range(3):
        world.publish(f'{name}/in', String(data='x' * 700_000))
    world.finish()


@pytest.mark.parametrize('name', ['repeater', 'best_effort'])
def test_messages_that_do_not_fit_into_the_queue_of_a_socket_are_an_error(monkeypatch, name):
    monkeypatch.setattr(datagrams, 'QUEUE', 50_000)
    monkeypatch.setattr(datagrams, 'SO_RCVBUFFORCE', socket.SO_RCVBUF)
    with Lockstep() as world:
        world.start(command(name))
        with pytest.raises(LockstepError, match=rf'messages to or from /{name} were lost .*rmem_max='):
            lose(world, name)


def test_more_messages_at_once_than_are_received_are_an_error():
    with Lockstep() as world:
        world.start([*command('repeater'), '--ros-args', '-p', 'times:=1000'])
        with pytest.raises(LockstepError, match=r'more than 999 messages .* on /repeater/out at once'):
            world.publish('repeater/in', String(data='x'))


def change(world):
    world.publish('changing/in', String(data='x'))
    world.run_for(10.0)


def test_a_topic_that_changes_its_quality_of_service_is_an_error():
    with Lockstep() as world:
        world.start(command('changing'))
        with pytest.raises(LockstepError, match=r'/changing/out with several qualities.*BEST_EFFORT'):
            change(world)


@pytest.mark.parametrize('name', ['wall_timer', 'threaded'])
def test_what_a_process_sends_by_itself_is_an_error(lockstep, name):
    lockstep.start(command(name))
    lockstep.node.create_timer(0.01, lambda: None)

    def run():
        for number in range(1000):
            lockstep.publish(f'{name}/odom', odometry(float(number)))
            lockstep.run_for(0.01)
            threading.Event().wait(0.005)

    with pytest.raises(
        LockstepError,
        match=rf'/{name} published /{name}/cmd_vel at .* while nothing was delivered to it.*wall time',
    ):
        run()


def test_a_process_that_is_never_quiet_is_named_with_its_thread(lockstep):
    lockstep.start(command('busy'), patience=0.5)
    with pytest.raises(
        LockstepError,
        match=r"/busy not quiet within 0.5 s: thread \d+ \('\w+'\) of .* is running",
    ):
        lockstep.publish('busy/odom', odometry())


def test_a_process_that_is_stopped_is_named(lockstep):
    process = lockstep.start(command('echo'), patience=0.5)
    process.signal(signal.SIGSTOP)
    with pytest.raises(LockstepError, match=r'/echo not quiet within 0.5 s: thread .* is stopped'):
        lockstep.publish('echo/odom', odometry())


def test_a_thread_that_polls_on_wall_time_is_named():
    with (
        Lockstep() as world,
        pytest.raises(LockstepError, match=r'not quiet within 1 s: thread .* (sleeps|is running)'),
    ):
        world.start(command('napping'), patience=1.0)


@pytest.mark.parametrize('how', ['several_threads', 'several_executors'])
def test_several_threads_and_executors_do_the_same_each_time(how):
    def run():
        with Lockstep() as world, MessageDigest(world) as digest:
            world.start(command('ticker', 'echo', how))
            publisher = world.node.create_publisher(Odometry, 'echo/odom', 10)
            again = world.node.create_publisher(Odometry, 'ticker/odom', 10)
            world.listen(TwistStamped, 'echo/cmd_vel')
            world.listen(TwistStamped, 'ticker/cmd_vel')

            def send():
                publisher.publish(odometry(world.elapsed))
                again.publish(odometry())

            world.node.create_timer(0.02, send)
            world.run_for(0.5)
            return digest.value()

    assert run() == run()


# --- What goes wrong


def refused(arguments, match, **options):
    with Lockstep() as world, pytest.raises(LockstepError, match=match) as raised:
        world.start(arguments, **options)
    return str(raised.value)


def test_two_subscriptions_to_one_topic_are_refused():
    refused(command('twice'), '/twice has 2 subscriptions to /twice/odom: which of them')


def test_topics_that_cannot_be_separated_are_refused():
    refused(
        [*command('shared', 'other'), '--ros-args', '-r', 'words:=sentences'],
        'several nodes of .* share /sentences, which',
    )


def test_a_topic_that_is_shared_later_is_refused(lockstep):
    lockstep.start(command('spied'))

    def drive():
        for _ in range(5):
            lockstep.publish('spied/odom', odometry())
            lockstep.run_for(1.0)

    with pytest.raises(LockstepError, match=r'several nodes of .* share /spied/odom, which cannot be'):
        drive()


def test_a_node_that_stops_to_follow_simulated_time_is_named(lockstep):
    lockstep.start(command('echo'))
    timed = Parameter('use_sim_time', value=False).to_parameter_msg()

    def change():
        lockstep.call(SetParameters, 'echo/set_parameters', SetParameters.Request(parameters=[timed]))
        lockstep.run_for(5.0)

    with pytest.raises(LockstepError, match='/echo has stopped to follow simulated time'):
        change()


def test_a_process_whose_endpoints_are_not_matched_is_started_again(lockstep, monkeypatch):
    matched = node_process.NodeProcess._is_matched
    started = []

    def match_at_the_second_start(process):
        if process.pid not in started:
            started.append(process.pid)
        return len(started) > 1 and matched(process)

    monkeypatch.setattr(node_process.NodeProcess, '_is_matched', match_at_the_second_start)
    monkeypatch.setattr(node_process, 'MATCHING', 0.1)
    assert lockstep.start(command('echo')).pid == started[1]


def test_several_nodes_in_cpp_are_warned_of(lockstep, monkeypatch, recwarn):
    lockstep.start(command('echo', 'mute'))
    # As if it were in C++: a library that the process has.
    monkeypatch.setattr(quietness, 'RCLCPP', '_rclpy_pybind11')
    lockstep.start(command('double'))
    assert not recwarn.list
    with pytest.warns(UserWarning, match='rclcpp calls timers of one of several nodes') as warned:
        lockstep.start(command('ticker', 'bare'))
    assert warned[0].filename == __file__


def test_nodes_of_equal_names_are_refused():
    refused(command('shared', 'shared'), 'several nodes of .* have the name /shared')


def test_random_addresses_are_refused(monkeypatch):
    monkeypatch.setattr(external_process, 'ADDR_NO_RANDOMIZE', 1)
    refused(command('echo'), 'seccomp=unconfined')


def test_a_node_on_wall_time_is_refused():
    refused(
        command('untimed'),
        r'/untimed of .* is not subscribed to /clock: its parameter use_sim_time must be true',
    )


def test_a_process_that_is_no_node_is_not_waited_for_when_it_has_ended():
    refused(
        ['sh', '-c', 'echo no such file >&2; exit 3'],
        r'(?s)has exited with 3\n.*stderr:\n +no such file',
    )


def test_a_process_that_starts_too_slowly():
    refused(
        ['sh', '-c', 'echo still here >&2; sleep 20'],
        r'no node of sh .* was discovered within 0.5 s \(timeout=\): it has created none',
        timeout=0.5,
    )


def test_a_process_in_another_domain():
    refused(
        command('echo', 'elsewhere'),
        r'it is in ROS domain \d+ instead of \d+: it must not set ROS_DOMAIN_ID',
        timeout=5.0,
    )


def refused_at_last(arguments, match):
    """A node may be discovered only after some seconds."""

    def run(world):
        world.start(arguments)
        for _ in range(2000):
            world.run_for(0.1)

    with Lockstep() as world, pytest.raises(LockstepError, match=match):
        run(world)


def test_several_processes_with_nodes_are_refused():
    timed = '--ros-args -p use_sim_time:=true'
    echo, mute = (' '.join(command(name)) for name in ('echo', 'mute'))
    refused_at_last(
        ['sh', '-c', f'{echo} {timed} & {mute} {timed}; wait'],
        r'has started several processes with nodes: \d+, \d+',
    )


def test_a_daemon_of_a_process_takes_part(lockstep):
    """It is a descendant of what the world has started, and ended with the world."""
    daemon = ' '.join(['setsid', '-f', *command('echo'), '--ros-args', '-p', 'use_sim_time:=true'])
    lockstep.start(['sh', '-c', f'{daemon}; sleep infinity'], use_sim_time=False)
    commands = lockstep.listen(TwistStamped, 'echo/cmd_vel')
    lockstep.publish('echo/odom', odometry(1.0))
    assert speeds(commands) == [1.0]


def test_a_process_that_the_world_has_not_started_is_refused(monkeypatch):
    domain = external_process.free_domain()
    monkeypatch.setattr(node_process, 'free_domain', lambda: domain)
    foreign = ExternalProcess(command('mute'), {'ROS_DOMAIN_ID': str(domain)})
    try:
        refused_at_last(command('echo'), r'node /mute is in domain \d+, but in no process that')
    finally:
        foreign.close()


def test_a_type_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.delattr('nav_msgs.msg.Odometry')
    refused(
        command('echo'),
        r'the type nav_msgs/msg/Odometry of /echo/odom of /echo cannot be imported in Python',
    )


@pytest.mark.parametrize(
    ('name', 'how'),
    [('mortal', r'has exited with 1\n.*out of memory'), ('killed', r'was ended by SIGSEGV')],
)
def test_a_process_that_ends_while_driving_is_quoted(name, how):
    with Lockstep() as world:
        process = world.start(command(name))
        publisher = world.node.create_publisher(Odometry, f'{name}/odom', 10)
        world.node.create_timer(0.1, lambda: publisher.publish(odometry()))
        with pytest.raises(LockstepError, match=rf'(?s)/{name}: .*{how}'):
            world.run_for(10.0)
        assert f'/{name}/cmd_vel: ' in world.report()
    assert process.returncode != 0


def test_the_signal_of_a_child_is_named():
    """As of `ros2 run`, which is the parent of the node, and exits with 245 for a SIGSEGV."""
    program = (
        'import subprocess, sys; sys.exit(subprocess.call(sys.argv[1:]) & 255)',
        *command('killed'),
    )
    with Lockstep() as world:
        world.start([sys.executable, '-c', *program])
        publisher = world.node.create_publisher(Odometry, 'killed/odom', 10)
        world.node.create_timer(0.1, lambda: publisher.publish(odometry()))
        with pytest.raises(LockstepError, match='with 245: what it started was ended by SIGSEGV'):
            world.run_for(10.0)


def test_a_process_that_ends_without_an_error_leaves_the_world(lockstep):
    process = lockstep.start(command('done'))
    commands = lockstep.listen(TwistStamped, 'done/cmd_vel')
    for number in range(external_nodes.LAST):
        lockstep.publish('done/odom', odometry(float(number)))
    assert speeds(commands)[:2] == [0.0, 1.0]
    assert process.returncode == 0
    lockstep.run_for(0.1)
    assert process.nodes == []


def test_start_takes_a_program_and_its_arguments(lockstep):
    for wrong in ('ros2 run package node', [], (), ['ros2', 3], ['a\0b'], 3, b'ab', None):
        with pytest.raises(LockstepError, match='start takes a program and its arguments'):
            lockstep.start(wrong)
    with pytest.raises(LockstepError, match=r'cannot be started: .*No such file'):
        lockstep.start(['no_such_program'])
    with pytest.raises(ValueError, match='clock_period must be'):
        lockstep.start(['true'], clock_period=0.0)
    for name, wrong in [
        *(('env', env) for env in (3, {'A': 1}, {'A=B': 'x'}, {'': 'x'}, {'A': '\0'}, {1: 'x'})),
        *(('queue_depth', depth) for depth in (0, -3, 2.5, True, '10', 1000)),
        *(('cwd', cwd) for cwd in (3, 'a\0b')),
    ]:
        with pytest.raises(LockstepError, match=rf'{name} must be .*, got '):
            lockstep.start(['true'], **{name: wrong})
    for cwd in ('/no/such/folder', __file__):
        with pytest.raises(LockstepError, match=r'cannot be started: .*(No such|Not a)'):
            lockstep.start(['true'], cwd=cwd)


def test_what_a_process_has_printed_is_quoted_in_part():
    long = "import sys; print('\\033[2J', 'x' * 10**6, file=sys.stderr); sys.exit(3)"
    with Lockstep() as world, pytest.raises(LockstepError, match='has exited with 3') as raised:
        world.start([sys.executable, '-c', long])
    assert len(str(raised.value)) < 3000
    assert '\033' not in str(raised.value)


def test_a_program_that_goes_into_the_background_is_told_not_to():
    with Lockstep() as world, pytest.raises(LockstepError, match='start it in the foreground'):
        world.start(['sh', '-c', 'sleep 60 &'])


def test_another_system_is_refused(lockstep, monkeypatch):
    monkeypatch.setattr(quietness.platform, 'machine', lambda: 'riscv64')
    with pytest.raises(LockstepError, match='need Linux on x86_64 or aarch64'):
        lockstep.start(command('echo'))


# --- Processes


@pytest.fixture
def started():
    """Return a function that starts a shell command, which is ended with the test."""
    processes = []

    def start(text):
        processes.append(ExternalProcess(['sh', '-c', text]))
        return processes[-1]

    yield start
    external_process.end_all(processes)


def until_says_hi(process):
    while 'hi' not in process.printed(0):
        assert process.returncode is None


def test_a_process_and_its_children_are_ended(started):
    stubborn = started('trap "" INT; echo hi; sleep 60 & wait; sleep 60')
    until_says_hi(stubborn)
    assert 'is running' in stubborn.describe()
    assert stubborn.stop(timeout=0.1) == -signal.SIGKILL
    polite = started('trap "echo bye; exit 7" INT; echo hi; while :; do sleep 0.05; done')
    until_says_hi(polite)
    assert polite.stop() == 7
    assert polite.printed(0) == 'hi\nbye\n'


def test_a_process_in_a_session_of_its_own_is_ended_with_the_world(started):
    """As the daemon of ros2, and what that has started."""
    launcher = started('setsid sh -c "echo hi; sleep 60" & sleep 60')
    until_says_hi(launcher)
    left = set(quietness.Quiet(launcher.root, ()).processes())
    assert len(left) >= 4
    launcher.kill()
    assert not any(Path(f'/proc/{pid}').exists() for pid in left)


def test_nothing_is_left_of_a_world_that_is_killed(tmp_path):
    """As by a time limit of the tests."""
    (tmp_path / 'world.py').write_text(WORLD)
    world = ExternalProcess([sys.executable, str(tmp_path / 'world.py'), *command('echo')])
    while not (printed := world.printed(0)).endswith('\n'):
        world.check_running()
    left = set(map(int, printed.split()))
    assert len(left) >= 2
    os.kill(world.pid, signal.SIGKILL)
    while any(Path(f'/proc/{pid}').exists() for pid in left):
        time.sleep(0.01)
    world.close()


def test_a_process_receives_sigint_that_the_tests_ignore(started):
    """As they do if a shell has started them in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = started('exec sleep 60')
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert process.stop() == -signal.SIGINT
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_domain_with_a_port_in_use_is_not_chosen(monkeypatch):
    domains = sorted({external_process.free_domain() for _ in range(10)})
    assert len(domains) > 1
    # Those that others use.
    assert min(domains) > 101
    monkeypatch.delenv('PYTEST_XDIST_WORKER', raising=False)
    monkeypatch.delenv('PYTEST_XDIST_WORKER_COUNT', raising=False)
    first, second = domains[:2]
    monkeypatch.setattr(external_process, 'DOMAINS', [first, second])
    taken = {external_process._ports(first)[4]}
    # Of the fourth participant: the first may have ended before.
    monkeypatch.setattr(external_process, '_is_free', lambda port: port not in taken)
    assert {external_process.free_domain() for _ in range(4)} == {second}
    taken.add(external_process._ports(second)[0])
    with pytest.raises(LockstepError, match=f'from {first} to {second} are all in use'):
        external_process.free_domain()


def test_a_port_in_use_is_noticed():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(('', 0))
        assert not external_process._is_free(taken.getsockname()[1])


# --- Repeated runs


def test_runs_are_compared():
    def run(world):
        world.start(command('ticker'))
        world.run_for(0.1)

    check_repeats(run)


def test_runs_that_differ_are_an_error():
    values = iter([1.0, 2.0])

    def run(world):
        publisher = world.node.create_publisher(Float64, 'value', 10)
        publisher.publish(Float64(data=0.0))
        world.run_for(0.5)
        publisher.publish(Float64(data=next(values)))

    with pytest.raises(
        LockstepError,
        match=r'run 2 differs from run 1, first in message 2: /value at 1.5 s: Float64\(data=2\) .*'
        r'instead of /value at 1.5 s: Float64\(data=1\)',
    ):
        check_repeats(run)
    lengths = iter([1.0, 2.0])

    def longer(world):
        publisher = world.node.create_publisher(Float64, 'value', 10)
        world.node.create_timer(1.0, lambda: publisher.publish(Float64()))
        world.run_for(next(lengths))

    with pytest.raises(LockstepError, match=r'/value at 3 s: .* instead of none'):
        check_repeats(longer)
