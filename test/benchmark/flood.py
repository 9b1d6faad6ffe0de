"""Floods: other processes send on one input of a node as fast as they can.

Run as `python test/benchmark/flood.py`. Each node runs as its entry point starts it, and once more on
rclpy's SingleThreadedExecutor. For each input of each node are printed, during the flood:

- the rate of the odometry and the longest time between two messages, by their stamps;
- how late the timeout of commands or odometry stops the robot, the longest of several times. If that
  input itself is flooded, the stop after the end of the flood counts;
- the longest time until a request of `get_parameters` is answered;
- the growth of the resident memory.

Under a flood the middleware drops packets before they reach a node, and repeats them at the next
heartbeat. The observer sends heartbeats every 0.1 s. A client with the default of Fast DDS may wait 3 s.

A flood is serialized before it begins, and published as bytes. `--processes 2` floods from two.
"""

from __future__ import annotations

import argparse
import math
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ.setdefault('ROS_DOMAIN_ID', str(os.getpid() % 100 + 1))

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Goals, Odometry
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from diffdrive_jacobian.ros.fastdds_profiles import announce_frequently, fast_heartbeats
from diffdrive_jacobian.ros.runner import ros_context

TIMEOUT = 0.5
"""Timeout of commands and of odometry (s)."""
ON = {
    'ours': '',
    'single': (
        'import diffdrive_jacobian.ros.runner as runner, rclpy.executors as executors; '
        'runner.make_executor = lambda context, **_: '
        'executors.SingleThreadedExecutor(context=context); '
    ),
}
ENTRY = 'import sys; {0}from diffdrive_jacobian.tools.entry_points import {1}; sys.exit({1}())'
STAMPED = ('-p', 'enable_stamped_cmd_vel:=true')
WHEELS = ('-p', 'command_interface:=joint_command')


class Case(NamedTuple):
    """A node, and the input that is flooded."""

    node: str
    flooded: str
    arguments: tuple[str, ...] = ()
    own: bool = False
    """Whether the timeout applies to this input."""


CASES = (
    Case('virtual_robot', 'cmd_vel', own=True),
    Case('virtual_robot', 'cmd_vel_stamped', STAMPED, own=True),
    Case('virtual_robot', 'joint_command', WHEELS, own=True),
    Case('virtual_robot', 'initialpose'),
    Case('virtual_robot', 'clock', ('-p', 'use_sim_time:=true')),
    Case('virtual_robot', 'set_parameters'),
    Case('virtual_robot', 'reset_odometry'),
    Case('wheel_bridge', 'cmd_vel', own=True),
    Case('wheel_bridge', 'cmd_vel_stamped', STAMPED, own=True),
    Case('wheel_bridge', 'clock', ('-p', 'use_sim_time:=true')),
    Case('wheel_bridge', 'set_parameters'),
    Case('go_to_goal', 'odom', own=True),
    Case('go_to_goal', 'goal_pose'),
    Case('go_to_goal', 'goals'),
    Case('go_to_goal', 'clock', ('-p', 'use_sim_time:=true')),
    Case('go_to_goal', 'set_parameters'),
    Case('go_to_goal', 'cancel_goal'),
)


# --- The flood


def message(kind: str) -> Any:
    """Return the message of a flood. A robot that receives it moves; a goal is far away."""
    if kind == 'joint_command':
        return JointState(name=['left_wheel_joint', 'right_wheel_joint'], velocity=[1.0, 1.0])
    if kind == 'initialpose':
        placement = PoseWithCovarianceStamped()
        placement.header.frame_id = 'odom'
        placement.pose.pose.orientation.w = 1.0
        return placement
    if kind == 'odom':
        odometry = Odometry(child_frame_id='base_link')
        odometry.header.frame_id = 'odom'
        odometry.pose.pose.orientation.w = 1.0
        return odometry
    if kind in ('goal_pose', 'goals'):
        goal = PoseStamped()
        goal.header.frame_id = 'odom'
        goal.pose.position.x = 1e4
        goal.pose.orientation.w = 1.0
        return goal if kind == 'goal_pose' else Goals(header=goal.header, goals=[goal])
    twist = Twist()
    twist.linear.x = 0.2
    return TwistStamped(twist=twist) if kind == 'cmd_vel_stamped' else twist


def flood(node_name: str, kind: str, seconds: float) -> None:
    """Send as fast as it goes; print how many per second, and the time of the end (s, monotonic)."""
    with ros_context(['flood']) as context:
        node = Node('flood', context=context, start_parameter_services=False)
        send = sender(node, node_name, kind)
        end, count = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            for _ in range(100):
                send()
            count += 100
        print(count / seconds, time.monotonic(), flush=True)
        node.destroy_node()


def sender(node: Node, node_name: str, kind: str) -> Callable[[], object]:
    """Return a function that sends one message or request."""
    if kind in ('set_parameters', 'reset_odometry', 'cancel_goal'):
        service, request, name = Trigger, Trigger.Request(), kind
        if kind == 'set_parameters':
            service, name = SetParameters, f'{node_name}/{kind}'
            request = SetParameters.Request(
                parameters=[
                    Parameter(name='wheel_radius', value=ParameterValue(type=3, double_value=0.05))
                ]
            )
        client = node.create_client(service, name)
        client.wait_for_service(10.0)
        return lambda: client.remove_pending_request(client.call_async(request))
    if kind == 'clock':
        publisher, buffer = node.create_publisher(Clock, '/clock', 10), bytearray(12)
        buffer[1] = 1

        def tick() -> None:
            struct.pack_into('<iI', buffer, 4, *divmod(time.time_ns(), 1_000_000_000))
            publisher.publish(bytes(buffer))

        return tick
    sample = message(kind)
    publisher = node.create_publisher(type(sample), kind.removesuffix('_stamped'), 10)
    data = serialize_message(sample)
    return lambda: publisher.publish(data)


# --- What is measured


class Observer:
    """Measures a node from another process."""

    def __init__(self, context: Any, case: Case) -> None:
        self.case = case
        self.node = Node('observer', context=context, start_parameter_services=False)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.client = self.node.create_client(GetParameters, f'{case.node}/get_parameters')
        self.stamps: list[float] = []
        self.moving, self.since = False, 0.0
        stamped = case.arguments == STAMPED
        kinds = {
            'virtual_robot': ('joint_command' if case.arguments == WHEELS else 'cmd_vel', 'odom'),
            'wheel_bridge': ('cmd_vel', 'joint_command'),
            'go_to_goal': ('odom', 'cmd_vel'),
        }
        command, output = kinds[case.node]
        self.sample = message(f'{command}_stamped' if stamped and command == 'cmd_vel' else command)
        self.command = self.node.create_publisher(type(self.sample), command, 10)
        self.goal = self.node.create_publisher(PoseStamped, 'goal_pose', 10)
        types = {'odom': Odometry, 'joint_command': JointState, 'cmd_vel': Twist}
        self.node.create_subscription(types[output], output, self._on_output, 100)

    def _on_output(self, output: Any) -> None:
        if isinstance(output, JointState):
            moving = any(output.velocity)
        else:
            twist = output if isinstance(output, Twist) else output.twist.twist
            moving = twist.linear.x != 0.0 or twist.angular.z != 0.0
            if isinstance(output, Odometry):
                self.stamps.append(output.header.stamp.sec + output.header.stamp.nanosec * 1e-9)
        if moving != self.moving:
            self.moving, self.since = moving, time.monotonic()

    def spin(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Spin for at most a time (s); return whether the condition became true."""
        end = time.monotonic() + seconds
        while not until():
            if time.monotonic() > end:
                return False
            self.executor.spin_once(timeout_sec=0.01)
        return True

    def response(self) -> float:
        """Time until a request is answered (s)."""
        begin = time.monotonic()
        future = self.client.call_async(GetParameters.Request(names=['use_sim_time']))
        return time.monotonic() - begin if self.spin(5.0, future.done) else math.inf

    def stop(self, sent: float) -> float:
        """How much later than the timeout after a time of sending (s) the motion ends (s)."""
        if not self.spin(TIMEOUT + 5.0, lambda: not self.moving):
            return math.inf
        return self.since - sent - TIMEOUT

    def watchdog(self) -> float:
        """Let the node move, and return how late it stops when nothing more comes (s)."""
        if self.case.node == 'go_to_goal':
            self.goal.publish(message('goal_pose'))
        self.command.publish(self.sample)
        sent = time.monotonic()
        while not self.spin(0.02, lambda: self.moving):
            if self.case.node == 'go_to_goal':
                self.command.publish(self.sample)
                sent = time.monotonic()
            elif time.monotonic() > sent + 5.0:
                return math.inf
        return self.stop(sent)


def resident(process: subprocess.Popen) -> float:
    """Resident memory of a process (MB)."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    return int(status.split('VmRSS:')[1].split()[0]) / 1024.0


def measure(case: Case, executor: str, seconds: float, processes: int) -> str:
    """Flood a node; return what was measured."""
    timeout = 'odom_timeout' if case.node == 'go_to_goal' else 'cmd_vel_timeout'
    arguments = ['--ros-args', '-p', f'{timeout}:={TIMEOUT}', *case.arguments]
    program = ENTRY.format(ON[executor], case.node)
    node = subprocess.Popen([sys.executable, '-c', program, *arguments], stderr=subprocess.DEVNULL)
    floods: list[subprocess.Popen] = []
    try:
        with fast_heartbeats(), ros_context(['observer']) as context:
            observer = Observer(context, case)
            observer.spin(20.0, observer.client.service_is_ready)
            observer.spin(2.0)
            observer.response()
            observer.goal.publish(message('goal_pose'))
            before = resident(node)
            command = [sys.executable, __file__, '--flood', case.node, case.flooded, str(seconds)]
            floods += [
                subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(processes)
            ]
            # The flood begins.
            observer.spin(2.0)
            observer.stamps.clear()
            responses, stops, grown = [], [], 0.0
            end = time.monotonic() + seconds - 2.0
            while time.monotonic() < end:
                responses.append(observer.response())
                if not (case.own or case.flooded == 'cancel_goal'):
                    stops.append(observer.watchdog())
                grown = max(grown, resident(node) - before)
                observer.spin(0.1)
            stamps = list(observer.stamps)
            results = [flood.communicate(timeout=60)[0].split() for flood in floods]
            if case.own and observer.spin(2.0, lambda: observer.moving):
                stops.append(observer.stop(max(float(ended) for _, ended in results)))
            grown = max(grown, resident(node) - before)
            observer.executor.shutdown()
            observer.node.destroy_node()
    finally:
        for process in (*floods, node):
            process.kill()
            process.wait()
    gaps = [b - a for a, b in pairwise(stamps)]
    odometry = f'{len(gaps) / sum(gaps):5.2f} Hz, gap {max(gaps) * 1e3:4.0f} ms, ' if gaps else ''
    stop = f'stop {max(stops) * 1e3:4.0f} ms late, ' if stops else ''
    return (
        f'{sum(float(rate) for rate, _ in results):7.0f}/s: {odometry}{stop}'
        f'service {max(responses) * 1e3:4.0f} ms, {grown:+5.1f} MB'
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--flood', nargs=3, help=argparse.SUPPRESS)
    parser.add_argument('--seconds', type=float, default=60.0, help='of each flood')
    parser.add_argument('--processes', type=int, default=1, help='that flood')
    parser.add_argument('cases', nargs='*', help='beginnings of NODE/INPUT; none: all')
    options = parser.parse_args()
    announce_frequently()
    if options.flood:
        name, kind, seconds = options.flood
        flood(name, kind, float(seconds))
        return
    for case in CASES:
        name = f'{case.node}/{case.flooded}'
        if options.cases and not name.startswith(tuple(options.cases)):
            continue
        for executor in ON:
            result = measure(case, executor, options.seconds, options.processes)
            print(f'{name:30s} {executor:6s} {result}', flush=True)


if __name__ == '__main__':
    main()
