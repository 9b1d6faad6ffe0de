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

"""A drive by the nodes: robot, wheel bridge, controller and client in one process."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from diffdrive_jacobian.bags.journal import Channel, Message, Record
from diffdrive_jacobian.bags.message_definitions import known_structure
from diffdrive_jacobian.bags.run import run_of
from diffdrive_jacobian.drives.outcome import (
    SETTLING,
    STANDING,
    STOP_PATIENCE,
    DriveError,
    Outcome,
    Request,
)
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.codecs import JOINT_STATE, Wheels
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.names import base_name
from diffdrive_jacobian.messages.topics import READABLE, Selection
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import GoalClient
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.recording.recorder import Recorder, Sink
from diffdrive_jacobian.ros.rate_limit import TokenBucket
from diffdrive_jacobian.ros.runner import NodeRunner, Runner, discovery_off, ros_context, running
from diffdrive_jacobian.ros.serialization import ignoring_invalid
from diffdrive_jacobian.time_units import nanoseconds

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep.runner import LockstepRunner

NAME = 'drive_to'
"""Name of the node that sends the goals."""
NO_LAWS: Mapping[str, Any] = MappingProxyType({})
DISCOVERY_PERIOD = 0.5
"""Time between two searches for new topics to record (s)."""


@contextmanager
def in_real_time(ros_arguments: Sequence[str] = (), *, isolated: bool = True) -> Iterator[Runner]:
    """Create a runner of nodes in real time, and close it at the end.

    Args:
        ros_arguments: ROS arguments of all nodes.
        isolated: Whether no other process can communicate with the nodes.

    Raises:
        UserError: The ROS arguments are invalid.
    """
    with (
        discovery_off() if isolated else nullcontext(),
        ros_context([NAME, *ros_arguments]) as context,
        running(context, isolated=isolated) as runner,
    ):
        yield runner


@contextmanager
def in_lockstep(ros_arguments: Sequence[str] = ()) -> Iterator[LockstepRunner]:
    """Create a runner of nodes in simulated time, and close it at the end.

    Raises:
        UserError: The ROS arguments, those of all nodes, are invalid.
        DriveError: A callback blocks, or simulated time cannot advance for another reason.
    """
    # Slow to import.
    from diffdrive_jacobian.lockstep._errors import LockstepError
    from diffdrive_jacobian.lockstep.runner import running_in_lockstep

    created = False
    try:
        with running_in_lockstep(ros_arguments) as runner:
            created = True
            yield runner
    except LockstepError as error:
        raise (DriveError if created else UserError)(str(error)) from error


def drive(
    request: Request,
    *,
    runner: NodeRunner | None,
    lockstep: bool,
    isolated: bool,
    ros_arguments: Sequence[str],
) -> Outcome:
    """Drive with all three nodes in this process.

    Args:
        request: What is asked for.
        runner: As for `drives.drive`.
        lockstep: As there.
        isolated: As there.
        ros_arguments: As there.

    Raises:
        UserError: As there.
        DriveError: As there.
    """
    signals, progress = request.signals, request.progress
    with ExitStack() as stack:
        if runner is None:
            runner = stack.enter_context(
                in_lockstep(ros_arguments)
                if lockstep
                else in_real_time(ros_arguments, isolated=isolated)
            )
        context = runner.context
        ours = robot, bridge, controller = add_nodes(
            runner, request.parameters, request.robot_parameters, request.laws
        )
        values = {one.get_fully_qualified_name(): one.parameters.by_name() for one in ours}
        client = runner.add(lambda: GoalClient(NAME, request.goals, context, relative=request.relative))
        client.arrival = controller.arrival
        speeds = (0.0, 0.0)

        def on_joint_states(wheels: Wheels) -> None:
            nonlocal speeds
            # Other processes may publish, and anything.
            with suppress(MessageError):
                speeds = wheels.speeds(robot.parameters.wheel_names)

        received = ignoring_invalid(JOINT_STATE, JointState, on_joint_states)
        client.create_subscription(JointState, 'joint_states', received, 10, raw=True)
        nodes = (robot, bridge, controller, client)
        if progress is not None:
            progress.nodes_created([node.get_fully_qualified_name() for node in nodes])
        kept = KeptMessages() if request.keep else None
        discover = recorder_of(runner, request.recording or kept)
        client.send_on_odometry()
        started = runner.seconds()

        def ended() -> bool:
            discover()
            if progress is not None and client.robot is not None and not client.ended:
                index = controller.waypoint
                if index is not None:
                    # A goal of another process may have more poses.
                    client.index = min(index, len(client.goals) - 1)
                seconds = runner.seconds() - started
                progress.driving(seconds, client.index, client.distance, speeds)
            return client.ended

        runner.spin(ended, timeout=request.timeout, signals=signals)
        seconds, status = runner.seconds() - started, client.status
        client.withdraw()
        reason = 'interrupted' if signals.count else 'timeout'
        if not client.ended:
            controller.stop(reason)
        settled = robot.now() + nanoseconds(SETTLING)

        def stands() -> bool:
            discover()
            if controller.waypoint is not None:
                # The goals were received only now.
                controller.stop(reason)
            state = client.robot
            return state is not None and client.stamp >= settled and state.twist == (0.0, 0.0)

        patience = STOP_PATIENCE + 1.0 / robot.parameters.publish_rate
        runner.spin(stands, timeout=patience, signals=signals, handled=signals.count)
        client.index = len(client.goals) - 1
        true_distance = math.nan
        if robot.parameters.drift() is not None:
            true_distance = float(
                controller.arrival.distance(*robot.truth.tolist(), *client.goals[-1, :2].tolist())
            )
        return Outcome(
            status=int(status),
            interrupted=signals.count > 0,
            pose=None if client.robot is None else np.array(client.robot.pose),
            moving=client.robot is not None and max(map(abs, client.robot.twist)) > STANDING,
            distance=client.distance,
            true_distance=true_distance,
            across=math.nan if client.path is None else client.path.greatest,
            late=client.late,
            tolerance=controller.arrival.xy_tolerance,
            offset=controller.arrival.offset,
            seconds=seconds,
            kept=None if kept is None else run_of('drive', kept.messages, values),
        )


def add_nodes(
    runner: NodeRunner,
    parameters: Mapping[str, Any],
    robot_parameters: Mapping[str, Any],
    laws: Mapping[str, Any] = NO_LAWS,
    namespace: str = '/',
) -> tuple[VirtualRobot, WheelBridge, GoToGoal]:
    """Add a robot that is driven by its wheels, the bridge and the controller to a runner.

    Args:
        runner: Runs the nodes.
        parameters: Parameters of go_to_goal, by name.
        robot_parameters: Likewise of virtual_robot.
        laws: As of a `Request`.
        namespace: Namespace of the nodes.
    """
    of_robot = overrides({**robot_parameters, 'command_interface': 'wheels'})
    of_controller = overrides(parameters)
    how: dict[str, Any] = {'context': runner.context, 'namespace': namespace}
    return (
        runner.add(lambda: VirtualRobot(**how, parameter_overrides=of_robot)),
        runner.add(lambda: WheelBridge(**how)),
        runner.add(lambda: GoToGoal(**how, **laws, parameter_overrides=of_controller)),
    )


def overrides(parameters: Mapping[str, Any]) -> list[Parameter]:
    """Return parameters, by name, as a node takes them."""
    return [Parameter(name, value=value) for name, value in parameters.items()]


class KeptMessages:
    """The messages of a run in memory, as a recorder adds them."""

    def __init__(self) -> None:
        """Start without messages."""
        self.messages: list[tuple[int, str, Any]] = []
        """Time of receipt (ns), topic without namespace, and value of each."""
        self._readers: dict[int, tuple[str, Callable[[bytes], Any]]] = {}

    def add(self, record: Record) -> None:
        """Take a record. What the nodes drop is not kept."""
        if isinstance(record, Channel):
            topic = READABLE.get(base_name(record.topic))
            if topic is not None and record.type_name in topic.types:
                read = topic.codec(record.type_name).reader(known_structure(record.type_name))
                self._readers[record.id] = topic.base_name, read
        elif isinstance(record, Message) and record.channel in self._readers:
            topic_name, read = self._readers[record.channel]
            with suppress(MessageError):
                self.messages.append((record.stamp, topic_name, read(record.data)))

    def set_missed(self, topic: str, messages: int) -> None:
        """Ignore that messages are missing: their stamps show it."""

    def set_left_out(self, topic: str, why: str) -> None:
        """Ignore that a topic is of another type."""


def recorder_of(
    runner: NodeRunner, recording: Sink | None, selection: Selection | None = None
) -> Callable[[], None]:
    """Record what the nodes publish, if there is a recording.

    Args:
        runner: Runs the nodes.
        recording: The recording.
        selection: What is recorded. None: what a single robot publishes.

    Returns:
        A function that finds new topics, to be called often.
    """
    if recording is None:
        return lambda: None
    recorder = runner.add(lambda: Recorder(selection or Selection(), recording, context=runner.context))
    discovery = TokenBucket(1, DISCOVERY_PERIOD)

    def discover() -> None:
        if discovery.permits(runner.seconds()):
            recorder.discover()

    discover()
    return discover
