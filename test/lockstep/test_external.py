"""Nodes in processes of their own that take part in a lockstep world, unchanged and undeclared."""

from __future__ import annotations

import itertools
import math
import os
import signal
import sys
from collections import Counter
from contextlib import contextmanager

import pytest
from external_nodes import Stage, command, send
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import Image
from std_msgs.msg import Float64, Header, String
from std_srvs.srv import Trigger
from support.processes import PROGRAM

from diffdrive_jacobian.bags.bag_reader import open_bag
from diffdrive_jacobian.exploration.trial import MessageDigest
from diffdrive_jacobian.faults import ClockPause, Corrupt, Delay, Hang, Kill, Loss, Slow, TimeJump
from diffdrive_jacobian.lockstep.external import node_process
from diffdrive_jacobian.lockstep.external.discovery import Discovery
from diffdrive_jacobian.lockstep.external.graph import NodeGraph
from diffdrive_jacobian.lockstep.external.launch import shared_memory_of
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.properties import NeverFasterThan
from diffdrive_jacobian.testing import Lockstep, LockstepError, PropertyViolation, check_repeats

pytestmark = pytest.mark.process

SECOND = 1_000_000_000
GO_TO_GOAL = [sys.executable, '-c', PROGRAM.format('go_to_goal')]
QUICK = ['--ros-args', '-p', 'kp:=24.0', '-p', 'kv:=12.0']


def stamp(message):
    return message.stamp.sec * SECOND + message.stamp.nanosec


def numbers(messages):
    return [float(one.frame_id) for one in messages]


@contextmanager
def answering(world, name, answer=None):
    """Offer a service. By default it answers, not at once, with the number of the request."""
    count = itertools.count(1)

    async def answer_with_numbers(_, response):
        await world.node.executor.create_task(lambda: None)
        response.message = str(next(count))
        return response

    service = world.node.create_service(Trigger, name, answer or answer_with_numbers)
    yield
    world.node.destroy_service(service)


# --- Messages and services


@pytest.fixture(scope='class')
def talking():
    names = ('echo', 'bare', 'late', 'hearing', 'waiting', 'repeater', 'best_effort')
    asking = ('caller', 'asking', 'askingfirst')
    with Lockstep() as world, answering(world, 'askingfirst/ask'):
        world.start(
            [*command(*names, *asking), '--ros-args', '-p', 'times:=3'],
            clock_period=1.0,
        )
        yield world


class TestMessages:
    """One process with many nodes."""

    @pytest.mark.parametrize('name', ['echo', 'bare'])
    def test_each_message_is_answered_before_the_next_callback(self, talking, name):
        """`bare` has no services for parameters."""
        received = talking.listen(Header, f'{name}/out')
        for number in range(4):
            send(talking, name, number)
            assert numbers(received) == list(range(number + 1))
            assert stamp(received[-1]) == talking.now
            talking.run_for(0.001)
        assert talking.find(name).get_fully_qualified_name() == f'/{name}'
        assert talking.last(f'{name}/out').frame_id == '3'

    def test_a_topic_that_is_created_later_passes(self, talking):
        send(talking, 'late', 0.0)
        received = talking.listen(Header, 'late/late')
        send(talking, 'late', 1.0, 2.0)
        assert numbers(received) == [1.0, 2.0]

    def test_a_process_that_hears_itself_does_not_hear_it_twice(self, talking):
        sums = talking.listen(Float64, 'hearing/sum')
        received = talking.listen(Header, 'hearing/out')
        send(talking, 'hearing', 1.0, 2.0)
        talking.publish('hearing/out', Header(frame_id='10'))
        send(talking, 'hearing', 4.0)
        assert [one.data for one in sums] == [1.0, 3.0, 13.0, 17.0]
        assert len(received) == 4

    def test_a_callback_that_sleeps_or_waits_is_waited_for(self, talking):
        received = talking.listen(Header, 'waiting/out')
        for number in (*range(3), *range(3)):
            before = len(received)
            send(talking, 'waiting', number)
            assert numbers(received[before:]) == [number]

    @pytest.mark.parametrize('name', ['repeater', 'best_effort'])
    def test_large_messages_and_many_at_once_arrive_complete(self, talking, name):
        received = talking.listen(String, f'{name}/out')
        texts = [str(digit) * 400_000 for digit in range(2)]
        for text in texts:
            talking.publish(f'{name}/in', String(data=text))
        assert [one.data for one in received] == [text for text in texts for _ in range(3)]

    def test_a_process_calls_services_of_the_world(self, talking):
        received = talking.listen(Header, 'caller/out')
        with answering(talking, 'caller/ask'):
            send(talking, 'caller', 0.0, 0.0, 0.0)
        assert numbers(received) == [1.0, 2.0, 3.0]
        # Before it spins, too, however late it calls.
        first = talking.listen(String, 'askingfirst/first', latched=True)
        assert [one.data for one in first] == ['1']

    def test_a_callback_waits_for_a_service_of_the_world(self, talking):
        """What else is sent to it meanwhile comes after the response, as do later times."""
        received = talking.listen(Header, 'asking/out')
        publisher = talking.node.create_publisher(Float64, 'asking/in', 10)
        with answering(talking, 'asking/ask'):
            for _ in range(2):
                publisher.publish(Float64())
                publisher.publish(Float64())
                talking.run_for(0.03)
        assert numbers(received) == [1.0, 2.0, 3.0, 4.0]

    def test_a_response_that_comes_later_in_simulated_time_is_not_waited_for(self, talking):
        """The timeout of the callback is wall time. So no simulated time passes, whatever that is."""
        slow = []

        async def answer(_, response):
            slow.append(Future())
            await slow[-1]
            return response

        received = talking.listen(Header, 'asking/out')
        publisher = talking.node.create_publisher(Float64, 'asking/in', 10)
        with answering(talking, 'asking/ask', answer):
            begin = talking.now
            for _ in range(2):
                publisher.publish(Float64())
            talking.run_for(0.1)
            assert numbers(received) == [-1.0, -1.0]
            assert [stamp(one) for one in received] == [begin, begin]
            slow[0].set_result(None)
            talking.run_for(0.1)
        assert len(received) == 2


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


def test_nodes_of_one_process_that_share_topics_receive_one_after_the_other(lockstep):
    process = lockstep.start(command('other', 'shared', 'sharing'))
    assert [node.get_name() for node in process.nodes] == ['other', 'shared', 'sharing']
    heard = lockstep.listen(String, 'heard')
    words = lockstep.listen(String, 'words')
    send(lockstep, 'sharing', *range(3))
    assert [one.data for one in words] == ['0', '1', '2']
    assert [one.data for one in heard] == [
        f'{name} {number + 1} {number}' for number in range(3) for name in ('sharing', 'other', 'shared')
    ]
    # Each sends for itself, and what they send to one another may be lost.
    report = lockstep.report()
    assert all(f'/heard: 3 from /{name}' in report for name in ('other', 'shared', 'sharing'))
    lockstep.inject(Loss('words'))
    send(lockstep, 'sharing', 5.0)
    lockstep.check_faults()
    assert [one.data for one in heard[9:]] == ['sharing 4 5']


# --- Time


@pytest.fixture(scope='class')
def ticking():
    with Lockstep() as world:
        world.publish('ticker/map', String(data='abc'), latched=True)
        world.start(command('ticker', 'growing'))
        yield world


class TestTime:
    """A process with nodes that have timers."""

    def test_a_timer_expires_on_time_also_when_the_clock_jumps(self, ticking):
        received = ticking.listen(Header, 'ticker/out')
        begin = ticking.now
        ticking.run_for(0.2)
        times = [stamp(one) - begin for one in received]
        assert times == [number * SECOND // 20 for number in (1, 2, 3, 4)]
        # A jump forward gives one tick, and one back none until the end of a period.
        ticking.jump(10.02)
        assert [stamp(one) for one in received[4:]] == [ticking.now]
        ticking.run_for(0.03)
        assert [stamp(one) for one in received[5:]] == [ticking.now]
        ticking.jump(-5.0)
        ticking.run_for(0.2)
        assert len(received) >= 9

    def test_parameters_services_and_latched_topics_pass(self, ticking):
        assert ticking.last('ticker/description').data == 'first'
        late = ticking.listen(String, 'ticker/description', latched=True)
        assert [one.data for one in late] == ['first']
        received = ticking.listen(Header, 'ticker/out')
        ticking.run_for(0.05)
        # It has received the map.
        assert numbers(received) == [1.0]
        assert ticking.call(Trigger, 'ticker/reset').success
        request = GetParameters.Request(names=['gain'])
        (value,) = ticking.call(GetParameters, 'ticker/get_parameters', request).values
        assert (value.type, value.double_value) == (ParameterType.PARAMETER_DOUBLE, 2.0)
        ticking.run_for(0.05)
        assert numbers(received[1:]) == [0.0]

    def test_a_node_that_is_created_later_takes_part(self, ticking):
        send(ticking, 'growing', 0.0)
        ticking.run_for(0.2)
        received = ticking.listen(Header, 'child/out')
        assert ticking.find('child') is not None
        ticking.run_for(0.1)
        assert len(received) == 2


def test_the_clock_jumps_and_stands_still_for_processes_too(lockstep):
    lockstep.start(command('ticker'))
    received = lockstep.listen(Header, 'ticker/out')
    lockstep.inject(
        TimeJump(-0.5, start=0.22), ClockPause(start=0.4, duration=0.5), TimeJump(5.01, start=1.0)
    )
    lockstep.run_for(1.3)
    ticks = [round((stamp(one) - SECOND) / SECOND, 3) for one in received]
    assert ticks[:4] == [0.05, 0.1, 0.15, 0.2]
    assert all(-0.28 <= tick < 0.1 for tick in ticks[4:8])
    # None while the clock stands, and one at the jump forward.
    assert all(tick < 0.1 or tick > 4.9 for tick in ticks[4:])
    assert len([tick for tick in ticks if tick > 4.9]) == pytest.approx(7, abs=1)


def test_a_topic_may_stay_in_the_process(lockstep):
    answers = lockstep.listen(Header, 'echo/out')
    process = lockstep.start(command('echo'), without=['/echo/out'])
    (node,) = process.nodes
    lockstep.publish('echo/in', Float64(data=1.0))
    lockstep.run_for(0.1)
    assert answers == []
    assert '/echo/in' in {one.topic_name for one in node.subscriptions}
    assert '/echo/out' not in {one.topic_name for one in node.publishers}


# --- Faults and properties


def test_faults_affect_both_directions_and_all_is_recorded(lockstep, recorded_run):
    lockstep.start(command('echo'), queue_depth=2, clock_period=0.07)
    received, times = [], []
    answers = lockstep.listen(Header, 'echo/out')
    robot = Node('robot')
    robot.create_subscription(Header, 'echo/out', received.append, 10)
    lockstep.add(robot)
    lockstep.on_published('echo/out', lambda *_: times.append(round(lockstep.elapsed, 3)))
    lockstep.inject(
        Loss('echo/in', start=0.2, duration=0.2),
        Corrupt('echo/in', 'data', 'negate', start=0.5, duration=0.1),
        Loss('echo/out', start=0.7, duration=0.1),
        Delay('echo/in', 0.05, start=1.0, duration=0.1),
        Hang('echo', start=1.1, duration=0.2),
        Slow('echo', 0.03, start=1.5, duration=0.2),
    )
    for number in range(18):
        send(lockstep, 'echo', number)
        lockstep.run_for(0.1)
    answered = [0, 1, 4, -5, *range(6, 18)]
    assert numbers(answers) == answered
    assert numbers(received) == [number for number in answered if number != 7]
    before = [number / 10 for number in range(10) if number not in (2, 3)]
    assert times == [*before, 1.05, 1.3, 1.3, 1.3, 1.4, 1.53, 1.63, 1.7]
    recorded_run.finish()
    with open_bag(recorded_run.bag) as bag:
        counts = Counter(connection.topic for connection, _, _ in bag.messages())
    assert (counts['/echo/in'], counts['/echo/out']) == (18, 16)


def test_a_process_is_killed_and_started_again(lockstep):
    process = lockstep.start(command('ticker'))
    received = lockstep.listen(Header, 'ticker/out')
    publisher = lockstep.node.create_publisher(Float64, 'ticker/in', 10)
    lockstep.node.create_timer(0.05, lambda: publisher.publish(Float64()))
    before = process.pid
    lockstep.inject(Kill('ticker', start=0.22, duration=0.2), Kill('ticker', start=0.6, duration=0.1))
    lockstep.run_for(0.3)
    assert process.returncode == -signal.SIGKILL
    with pytest.raises(LockstepError, match='there is no node /ticker'):
        lockstep.find('ticker')
    lockstep.run_for(0.25)
    assert process.pid != before
    assert lockstep.find('ticker') is process.nodes[0]
    # Without its memory.
    ticks = [(round((stamp(one) - SECOND) / SECOND, 3), float(one.frame_id)) for one in received]
    assert [time for time, _ in ticks[:4]] == [0.05, 0.1, 0.15, 0.2]
    assert ticks[4][0] >= 0.42
    assert ticks[4][1] == 0.0
    # Not again if the test stops it meanwhile.
    lockstep.run_for(0.08)
    process.stop()
    lockstep.run_for(0.2)
    assert 'ticker' not in [node.get_name() for node in lockstep.nodes]


# --- As in the same process, and the same each time


def drive(world, x=0.3):
    """Drive to a goal, with a controller that is there. Return the odometry."""
    received = world.listen(Odometry, 'odom')
    goal = PoseStamped()
    goal.pose.position.x, goal.pose.position.y, goal.pose.orientation.w = x, 0.2, 1.0
    world.publish('goal_pose', goal)
    world.run_for(1.2)
    return [repr(message) for message in received]


def test_a_controller_in_its_own_process_drives_as_in_the_same_one(lockstep, robot_at):
    robot = robot_at()
    controller = lockstep.start([*GO_TO_GOAL, *QUICK])
    assert [node.get_name() for node in controller.nodes] == ['go_to_goal']
    received = drive(lockstep)
    assert math.dist(robot.truth[:2], (0.3, 0.2)) < 0.05
    assert 'from /go_to_goal' in lockstep.report()
    lockstep.require(NeverFasterThan(0.1, 1.0))
    with pytest.raises(PropertyViolation, match='NeverFasterThan'):
        drive(lockstep, 0.6)
    controller.kill()
    assert controller.returncode == -signal.SIGKILL
    assert lockstep.find('virtual_robot') is robot
    with pytest.raises(LockstepError, match='no node'):
        lockstep.find('go_to_goal')
    # From here on the robot stops by its timeout.
    lockstep.run_for(1.0)
    lockstep.close()
    with Lockstep(QUICK) as isolated:
        isolated.add(VirtualRobot())
        isolated.add(GoToGoal())
        assert received == drive(isolated)


def combined(in_processes):
    """Return what three nodes make of numbers, some of them in processes of their own."""
    with Lockstep() as world:
        for name in 'abc':
            if name in in_processes:
                world.start(command(name))
            else:
                world.add(Stage(name))
        values = world.listen(Float64, 'combined')
        publisher = world.node.create_publisher(Float64, 'input', 10)
        world.node.create_timer(0.02, lambda: publisher.publish(Float64(data=0.01 * len(values))))
        world.run_for(0.5)
        return [one.data for one in values]


def test_processes_that_talk_to_one_another_do_the_same_as_nodes_of_one():
    values = combined('ac')
    assert len(values) == 25
    assert values == combined('')


def test_several_threads_and_executors_do_the_same_each_time():
    names = ('ticker', 'waiting', 'echo')

    def run(world):
        world.start(command(*names, 'threads'))
        publishers = []
        for name in names:
            publishers.append(world.node.create_publisher(Float64, f'{name}/in', 10))
            world.listen(Header, f'{name}/out')

        def tick():
            for publisher in publishers:
                publisher.publish(Float64(data=1.0 + len(names) * world.elapsed))

        world.node.create_timer(0.02, tick)
        world.run_for(0.2)
        assert 'echo/out: 10 from /echo' in world.report()

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
    check_repeats(longer_again(iter([1.0, 2.0])), without=['/value'])
    for without in ('/value', ['value']):
        with pytest.raises(ValueError, match='without must be names of topics such as'):
            check_repeats(longer, without=without)


def longer_again(lengths):
    def run(world):
        publisher = world.node.create_publisher(Float64, 'value', 10)
        world.node.create_timer(1.0, lambda: publisher.publish(Float64()))
        world.run_for(next(lengths))

    return run


def test_the_elements_of_large_arrays_are_hashed_at_once(monkeypatch):
    """One by one, those of five megabytes take half a minute."""
    chance, fields = iter([0, 0]), []
    words = MessageDigest._words
    monkeypatch.setattr(
        MessageDigest, '_words', lambda self, *field: fields.append(field) or words(self, *field)
    )

    def run(world):
        publisher = world.node.create_publisher(Image, 'image', 1)
        last = next(chance)
        publisher.publish(Image(data=bytes(5_000_000 - 1) + bytes([last])))

    check_repeats(run)
    assert 0 < len(fields) < 50
    chance = iter([0, 7])
    with pytest.raises(LockstepError, match='run 2 differs from run 1, first in message 1: /image'):
        check_repeats(run)


# --- Start and end


@pytest.mark.parametrize('end', ['stop', 'kill', 'close'])
def test_a_process_leaves_no_shared_memory_behind(end):
    with Lockstep() as world:
        process = world.start(command('echo'))
        world.run_for(0.1)
        segments = shared_memory_of(process.child.pid)
        assert segments
        assert all(map(os.path.exists, segments))
        if end != 'close':
            getattr(process, end)()
    assert not any(map(os.path.exists, segments))


def test_rules_of_the_user_stay_and_a_last_message_is_received(lockstep):
    rules = ['--ros-args', '-r', 'echo/in:=pose', '-r', '__ns:=/left', '-r', '/clock:=/sim/clock']
    process = lockstep.start([*command('echo', 'polite'), *rules])
    assert process.nodes[0].get_fully_qualified_name() == '/left/echo'
    received = lockstep.listen(Header, '/left/echo/out')
    lockstep.run_for(0.1)
    lockstep.publish('/left/pose', Float64(data=3.0))
    assert stamp(received[0]) == lockstep.now
    assert process.stop() == 0
    lockstep.settle()
    assert numbers(received) == [3.0, -9.0]
    assert process.nodes == []


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


def test_a_process_whose_endpoints_are_not_matched_is_started_again(lockstep, monkeypatch):
    """One that ends without an error leaves the world."""
    matched = Discovery.is_matched
    started = []

    def match_at_the_second_start(discovery):
        pid = discovery.domain.child.pid
        if pid not in started:
            started.append(pid)
        return len(started) > 1 and matched(discovery)

    monkeypatch.setattr(Discovery, 'is_matched', match_at_the_second_start)
    monkeypatch.setattr(node_process, 'MATCHING', 0.1)
    process = lockstep.start(command('mortal'))
    assert process.pid == started[1]
    send(lockstep, 'mortal', 0.0)
    assert process.returncode == 0
    lockstep.run_for(0.1)
    assert process.nodes == []


def test_a_daemon_of_a_process_takes_part(lockstep):
    """It is a descendant of what the world has started, and ended with the world."""
    daemon = ' '.join(['setsid', '-f', *command('echo'), '--ros-args', '-p', 'use_sim_time:=true'])
    lockstep.start(['sh', '-c', f'{daemon}; sleep infinity'], use_sim_time=False)
    received = lockstep.listen(Header, 'echo/out')
    send(lockstep, 'echo', 1.0)
    assert numbers(received) == [1.0]


def test_only_what_was_remapped_has_another_name_in_the_world():
    node = NodeGraph('node', '/', {}, {}, {}, {})
    for topic, name in (
        ('/node/lockstep/clock', '/clock'),
        ('/node/lockstep_state', '/node/lockstep_state'),
        ('/node/lockstep', '/node/lockstep'),
        ('/other/lockstep/clock', '/other/lockstep/clock'),
    ):
        assert node.name_in_world(topic) == name
