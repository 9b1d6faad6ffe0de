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

"""What goes wrong with processes in a lockstep world is named. The processes end, whatever happens."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time

import pytest
from external_calls import command, send
from rcl_interfaces.srv import SetParameters
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger

from diffdrive_jacobian.lockstep.external import domain as domain_module
from diffdrive_jacobian.lockstep.external import idle, linux
from diffdrive_jacobian.lockstep.external.launch import shared_memory_of
from diffdrive_jacobian.lockstep.external.process import ExternalProcess
from diffdrive_jacobian.testing import Lockstep, LockstepError

pytestmark = pytest.mark.process


def fails(match):
    return pytest.raises(LockstepError, match=match)


# --- While it runs


@pytest.fixture(scope='class')
def world():
    nodes = command('echo', 'repeater', 'asking', 'creating')
    with Lockstep() as world:
        world.start([*nodes, '--ros-args', '-p', 'times:=1000'], clock_period=1.0)
        yield world


class TestWhileItRuns:
    """One process. Each test leaves it as it was, but for the last one."""

    @pytest.mark.parametrize(
        ('number', 'words'),
        [
            (1.0, '/creating has 2 subscriptions to /creating/in: which of them'),
            (2.0, r'type std_msgs/msg/String of /creating/text of /creating cannot be imported'),
        ],
    )
    def test_what_cannot_take_part_for_a_while_is_named(self, world, monkeypatch, number, words):
        with monkeypatch.context() as patched:
            patched.delattr('std_msgs.msg.String')
            with fails(words):
                send(world, 'creating', number)
                world.run_for(10.0)
        send(world, 'creating', 0.0)
        world.run_for(1.0)

    def test_a_node_that_stops_to_follow_simulated_time_is_named(self, world):
        def follow(value):
            message = Parameter('use_sim_time', value=value).to_parameter_msg()
            request = SetParameters.Request(parameters=[message])
            world.call(SetParameters, 'echo/set_parameters', request)
            world.run_for(5.0)

        with fails('/echo has stopped to follow simulated time'):
            follow(False)
        follow(True)

    def test_more_messages_at_once_than_are_received_are_an_error(self, world):
        with fails(r'more than 999 messages .* on /repeater/out at once'):
            world.publish('repeater/in', String(data='x'))

    def test_a_callback_whose_wait_ends_before_the_response_is_an_error(self, world):
        def answer(_, response):
            time.sleep(0.7)
            return response

        world.node.create_service(Trigger, 'asking/ask', answer)
        with fails(r'/asking.* waited for the response of a service until its'):
            send(world, 'asking', 0.0)


def test_a_process_that_is_never_quiet_or_stopped_is_named_with_its_thread(lockstep):
    process = lockstep.start(command('busy', 'echo'), patience=0.5)
    with fails(r"(?s)/busy, /echo not quiet within 0.5 s: thread \d+ \('\w+'\) of .* is running"):
        send(lockstep, 'busy', 0.0)
    process.signal(signal.SIGSTOP)
    with fails('(?s)/echo not quiet within 0.5 s: thread .* is stopped'):
        send(lockstep, 'echo', 0.0)


@pytest.mark.parametrize(
    ('number', 'words'),
    [
        (3.0, '/creating/out with several qualities.*BEST_EFFORT'),
        (4.0, 'several nodes of .* have the name /creating'),
    ],
)
def test_what_can_never_take_part_is_named(lockstep, number, words):
    lockstep.start(command('creating'))
    with fails(words):
        send(lockstep, 'creating', number)
        lockstep.run_for(10.0)


def test_what_a_process_sends_by_itself_is_an_error(lockstep):
    lockstep.start(command('threaded'), clock_period=1.0)
    with fails(r'/threaded published /threaded/out at .* while nothing was delivered to it.*wall time'):
        send(lockstep, 'threaded', 0.0)
        for _ in range(1000):
            lockstep.run_for(1.0)
            time.sleep(0.02)


@pytest.mark.parametrize('name', ['best_effort', 'repeater'])
def test_messages_that_do_not_fit_into_the_queue_of_a_socket_are_an_error(monkeypatch, name):
    monkeypatch.setattr(linux, 'QUEUE', 50_000)
    monkeypatch.setattr(linux, 'SO_RCVBUFFORCE', socket.SO_RCVBUF)
    with Lockstep() as world:
        world.start(command(name))
        with fails(rf'messages to or from /{name} were lost .*rmem_max='):
            # A thread that happens to read fast enough loses nothing of one message.
            for _ in range(100):
                world.publish(f'{name}/in', String(data='x' * 700_000))
            world.finish()
        # What was lost is sent again meanwhile, and may be lost again.
        world.close()


RECREATES = """
import rclpy
from std_msgs.msg import Float64
rclpy.init()
for _ in range(3):
    node = rclpy.create_node('anew')
    node.create_subscription(Float64, 'in', lambda _: None, 10)
    for _ in range(20):
        rclpy.spin_once(node)
    node.destroy_node()
"""


def test_a_process_that_creates_its_node_anew_is_named(lockstep):
    lockstep.start([sys.executable, '-c', RECREATES])
    with fails(r'(?s)/anew was destroyed, or created anew, while .* runs: what is sent meanwhile'):
        lockstep.run_for(2.0)


DEADLINE = """
import rclpy
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64
rclpy.init()
node = rclpy.create_node('strict')
profile = QoSProfile(depth=1, deadline=Duration(seconds=0.5))
node.create_subscription(Float64, 'in', lambda message: print(message), profile)
rclpy.spin(node)
"""


def test_a_deadline_in_a_process_is_warned_of(lockstep):
    with pytest.warns(UserWarning, match='subscription of /in of node /strict has a deadline of 0.5 s'):
        process = lockstep.start([sys.executable, '-u', '-c', DEADLINE])
    # As in ROS, only a publisher that promises as much reaches it.
    with fails('/strict with .* deadline 0.5 s, and published with reliable, volatile, which does not'):
        lockstep.publish('in', Float64(data=1.0))
    profile = QoSProfile(depth=1, deadline=Duration(seconds=0.5))
    publisher = lockstep.node.create_publisher(Float64, 'in', profile)
    publisher.publish(Float64(data=2.0))
    with pytest.warns(UserWarning, match='publisher of /in of node /lockstep has a deadline of 0.5 s'):
        lockstep.settle()
    assert 'data=2.0' in process.stdout


EVENT_LOOP = """
import asyncio, rclpy
from std_msgs.msg import Float64
rclpy.init()
node = rclpy.create_node('looping')
node.create_subscription(Float64, 'in', lambda _: None, 10)

async def main():
    while rclpy.ok():
        rclpy.spin_once(node, timeout_sec=0)
        await asyncio.sleep(0.05)

asyncio.run(main())
"""


def test_an_event_loop_is_warned_of(lockstep):
    with pytest.warns(UserWarning, match='a thread waits for files with a timeout, as an event loop'):
        lockstep.start([sys.executable, '-c', EVENT_LOOP])


def test_several_nodes_in_cpp_are_warned_of(lockstep, monkeypatch):
    # As if it were in C++: a library that the process has.
    monkeypatch.setattr(idle, 'RCLCPP', '_rclpy_pybind11')
    with pytest.warns(UserWarning, match='executor|rclcpp') as warned:
        lockstep.start(command('ticker', 'bare'))
    assert {one.filename for one in warned} == {__file__}
    text = '\n'.join(str(one.message) for one in warned)
    assert 'rclcpp calls timers of one of several nodes' in text
    # It spins once at a time.
    assert 'its executor waits with a timeout, as with a timer of create_wall_timer' in text


# --- Its end


def test_a_process_that_ends_while_driving_is_quoted(lockstep):
    process = lockstep.start(command('mortal'))
    publisher = lockstep.node.create_publisher(Float64, 'mortal/in', 10)
    lockstep.node.create_timer(0.1, lambda: publisher.publish(Float64(data=1.0)))
    with fails(r'(?s)/mortal: .*has exited with 1\n.*out of memory'):
        lockstep.run_for(10.0)
    assert '/mortal/out: ' in lockstep.report()
    assert process.returncode == 1


@pytest.mark.parametrize(('number', 'waits'), [(signal.SIGTERM, 0.0), (signal.SIGKILL, 0.3)])
def test_a_process_that_a_signal_of_the_test_ends_leaves_the_world(lockstep, number, waits):
    """At once or when its end is noticed, also if nothing is delivered to it meanwhile."""
    process = lockstep.start(command('echo'))
    process.signal(number)
    time.sleep(waits)
    lockstep.run_for(0.5)
    assert process.nodes == []
    assert process.returncode is not None


def test_a_process_leaves_no_shared_memory_behind():
    """Stopped by the test, killed by somebody else, or ended with the world."""
    with Lockstep() as world:
        stopped, killed, closed = (world.start(command(name)) for name in ('echo', 'bare', 'ticker'))
        segments = {one: shared_memory_of(one.child.pid) for one in (stopped, killed, closed)}
        assert all(any(map(os.path.exists, there)) for there in segments.values())
        stopped.stop()
        assert not any(map(os.path.exists, segments[stopped]))
        os.kill(killed.pid, signal.SIGKILL)
        with fails('/bare'):
            world.run_for(1.0)
    assert not any(os.path.exists(one) for there in segments.values() for one in there)


# --- At the start


@pytest.mark.parametrize(
    ('arguments', 'options', 'words'),
    [
        (
            [*command('shared', 'other'), '--ros-args', '-r', 'words:=sentences'],
            {},
            'several nodes of .* share /sentences, which',
        ),
        (command('untimed'), {}, '/untimed of .* not subscribed to /clock: its parameter use_sim_time'),
        (
            command('echo', 'elsewhere'),
            {'timeout': 2.0},
            r'it is in ROS domain \d+ instead of \d+: it must not set ROS_DOMAIN_ID',
        ),
        (command('echo'), {'without': ['/silent', '/echo/out']}, r'has no topic /silent \(without=\)'),
        (
            ['sh', '-c', 'echo no such file >&2; exit 3'],
            {},
            r'(?s)has exited with 3\n.*stderr:\n +no such file',
        ),
        (
            ['sh', '-c', 'echo still here >&2; sleep 20'],
            {'timeout': 0.2},
            r'no node of sh .* was discovered within 0.2 s \(timeout=\): it has created none',
        ),
        (['sh', '-c', 'sleep 60 &'], {}, 'start it in the foreground'),
    ],
)
def test_a_process_that_cannot_take_part_is_refused(lockstep, arguments, options, words):
    with fails(words):
        lockstep.start(arguments, **options)


def test_systems_on_which_processes_cannot_take_part_are_refused(lockstep, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(linux, 'ADDR_NO_RANDOMIZE', 1)
        with fails('seccomp=unconfined'):
            lockstep.start(command('echo'))
    monkeypatch.setattr(linux.platform, 'machine', lambda: 'riscv64')
    with fails('need Linux on x86_64 or aarch64'):
        lockstep.start(['true'])


def test_several_processes_with_nodes_are_refused(lockstep):
    with fails(r'has started several processes with nodes: \d+, \d+'):
        lockstep.start(command('forked', 'echo', 'bare'))
        # The second may be discovered only after some seconds.
        for _ in range(2000):
            lockstep.run_for(0.1)


def test_a_process_that_the_world_has_not_started_is_refused(lockstep, monkeypatch):
    domain = domain_module.free_domain()
    monkeypatch.setattr(domain_module, 'free_domain', lambda: domain)
    foreign = ExternalProcess(command('echo'), {'ROS_DOMAIN_ID': str(domain)})
    try:
        with fails(r'node /echo is in domain \d+, but in no process that'):
            lockstep.start(['sh', '-c', 'sleep 60'])
    finally:
        foreign.kill()
        foreign.close()


def test_invalid_arguments_of_start_are_refused(lockstep):
    for wrong in ('ros2 run package node', [], ['ros2', 3], ['a\0b'], 3, b'ab', None):
        with fails('start takes a program and its arguments'):
            lockstep.start(wrong)
    with fails(r'cannot be started: .*No such file'):
        lockstep.start(['no_such_program'])
    with pytest.raises(ValueError, match='clock_period must be'):
        lockstep.start(['true'], clock_period=0.0)
    for name, wrong in [
        *(('env', env) for env in (3, {'A': 1}, {'A=B': 'x'}, {'': 'x'}, {'A': '\0'}, {1: 'x'})),
        *(('queue_depth', depth) for depth in (0, 2.5, True, '10', 1000)),
        *(('cwd', cwd) for cwd in (3, 'a\0b')),
        *(('use_sim_time', value) for value in ('simulated', 1, None)),
        *(('wall_time', wall_time) for wall_time in ('sim', None, True)),
        *(('without', without) for without in ('/out', ['out'], [3])),
    ]:
        with fails(rf'{name} must be .*, got '):
            lockstep.start(['true'], **{name: wrong})
    with fails('env must not differ from .*: messages would be lost, got .*ASYNCHRONOUS'):
        lockstep.start(['true'], env={'RMW_FASTRTPS_PUBLICATION_MODE': 'ASYNCHRONOUS'})
    for cwd in ('/no/such/folder', __file__):
        with fails('cwd must be a folder that exists, got'):
            lockstep.start(['true'], cwd=cwd)
