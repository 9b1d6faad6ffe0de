"""Drive the virtual robot to goals: robot, controller and wheel bridge in one process.

The robot is driven by its wheels, so that the whole Jacobian chain is in use:
goal -> control law -> body twist -> J_w^-1 -> wheel speeds -> J_w -> body twist -> S(theta) -> pose.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Goals, Odometry
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState

from diffdrive_jacobian.control import Arrival
from diffdrive_jacobian.messages import conversion as messages
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.nodes import CONTROLLERS
from diffdrive_jacobian.plots.run_figure import draw
from diffdrive_jacobian.reading.reader import BagError, read_run
from diffdrive_jacobian.recording.recorder import Recorder, Selection
from diffdrive_jacobian.recording.recording import Recording, RecordingError
from diffdrive_jacobian.ros.node import THROTTLE
from diffdrive_jacobian.ros.runner import Runner, UserError, closed_world, ros_context, running
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.time_units import nanoseconds
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._progress import Drive
from diffdrive_jacobian.tools._recording import begin_recording
from diffdrive_jacobian.tools._unused_files import warn_of_unused_files

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep.runner import LockstepRunner

PROGRAM = 'drive_to'
SETTLING = 0.1
"""Odometry this much later than the last command knows of it (s)."""
DISCOVERY_PERIOD = 0.5
"""How often new topics to record are looked for (s)."""
STOP_PATIENCE = 2.0
"""How long the robot may take to come to rest at the end, and to say so (s)."""


class Observer(Node):  # type: ignore[misc]
    """Sends the goals and watches what becomes of them."""

    def __init__(
        self,
        goals: NDArray[np.float64],
        arrival: Arrival,
        wheel_names: tuple[str, str],
        context: Context,
    ) -> None:
        """Prepare to send goals `[x, y, theta]`, shape (n, 3); `wheel_names` are left, right."""
        super().__init__('drive_to', context=context)
        self.goals = goals
        self._arrival = arrival
        self._wheel_names = wheel_names
        self.index = 0
        """The goal that is driven to."""
        self.pose: NDArray[np.float64] | None = None
        self.seen = 0
        """The instant of that pose (ns)."""
        self.moving = False
        self.wheels = (0.0, 0.0)
        """Speeds of the right and left wheel (rad/s)."""
        self.status = GoalStatus.STATUS_UNKNOWN
        self._sent: Goals | None = None
        self.over = False
        """Whether the drive is over: nothing is sent any more."""
        self._publisher = self.create_publisher(Goals, 'goals', 10)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(GoalStatus, 'goal_status', self._on_status, latched)
        self.create_subscription(Odometry, 'odom', self._on_odometry, 10)
        self.create_subscription(JointState, 'joint_states', self._on_joint_states, 10)

    @property
    def distance(self) -> float:
        """The distance to the goal that is driven to, of the point that is to arrive (m); infinite
        before the first odometry.
        """
        if self.pose is None:
            return math.inf
        return float(self._arrival.distance(*self.pose, *self.goals[self.index, :2]))

    @property
    def ended(self) -> bool:
        """Whether the controller is done with the goals."""
        return self.status in (
            GoalStatus.STATUS_SUCCEEDED,
            GoalStatus.STATUS_CANCELED,
            GoalStatus.STATUS_ABORTED,
        )

    def _on_odometry(self, message: Odometry) -> None:
        # With --open anybody may publish, and anything.
        try:
            pose = messages.from_pose(message.pose.pose)
            stamp = messages.from_time(message.header.stamp)
        except MessageError as error:
            self.get_logger().warning(f'odometry dropped: {error}', throttle_duration_sec=THROTTLE)
            return
        self.pose, self.seen = pose, stamp
        twist = message.twist.twist
        self.moving = (twist.linear.x, twist.angular.z) != (0.0, 0.0)
        if self._sent is None and not self.over:
            self._send()

    def _send(self) -> None:
        self._sent = Goals()
        self._sent.header.stamp = self.get_clock().now().to_msg()
        for goal in self.goals:
            pose = PoseStamped()
            messages.set_pose(pose.pose, goal)
            self._sent.goals.append(pose)
        self._publisher.publish(self._sent)

    def _on_joint_states(self, message: JointState) -> None:
        with suppress(MessageError):
            self.wheels = messages.from_joint_state(message, self._wheel_names)

    def _on_status(self, message: GoalStatus) -> None:
        if self._sent is not None and message.goal_info.stamp == self._sent.header.stamp:
            self.status = message.status


class DriveError(Exception):
    """A drive in simulated time broke off; the message says why."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """How a drive ended."""

    status: int
    """What became of the goals, as in GoalStatus."""
    interrupted: bool
    pose: NDArray[np.float64] | None
    """Where the robot stopped; None: it never reported."""
    distance: float
    """To the last goal, of the point that was to arrive (m)."""
    offset: float
    """How far that point is ahead of the axle (m)."""
    seconds: float
    """How long it took (s); in lockstep, of simulated time."""


def drive(
    goals: NDArray[np.float64],
    runner: Runner | LockstepRunner,
    signals: Signals,
    *,
    timeout: float,
    parameters: Mapping[str, Any],
    recording: Recording | None = None,
    ros: Sequence[str] = (),
) -> Outcome:
    """Drive to goals `[x, y, theta]`, shape (n, 3), in order, with all three nodes in this process.

    Args:
        goals: The goals (m, m, rad).
        runner: What the nodes live in.
        signals: A signal ends the drive.
        timeout: How long it may take (s).
        parameters: Of go_to_goal, by name; they go before those of the ROS arguments.
        recording: What is recorded to; None: nothing is.
        ros: The ROS arguments, to warn of parameter files that concern none of the nodes.

    Raises:
        UserError: A node cannot run with the parameters given.
    """
    context = runner.context
    wheels = Parameter('command_interface', value='wheels')
    robot = runner.add(lambda: VirtualRobot(context=context, parameter_overrides=[wheels]))
    bridge = runner.add(lambda: WheelBridge(context=context))
    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    controller = runner.add(lambda: GoToGoal(context=context, parameter_overrides=overrides))
    names = robot.parameters.left_wheel_name, robot.parameters.right_wheel_name
    observer = runner.add(lambda: Observer(goals, controller.arrival, names, context))
    nodes: tuple[Node, ...] = (robot, bridge, controller, observer)
    warn_of_unused_files(PROGRAM, ros, [node.get_fully_qualified_name() for node in nodes])
    discover = _recorder(runner, recording)
    begun = runner.seconds()
    with Drive(runner.seconds) as progress:

        def over() -> bool:
            discover()
            if observer.pose is not None and not observer.ended:
                index = controller.waypoint
                if index is not None and index != observer.index:
                    observer.index = index
                    progress.next()
                x, y, _ = goals[observer.index]
                what = f'goal {observer.index + 1}/{len(goals)} ({x:g}, {y:g})'
                progress.show(what, observer.distance, observer.wheels)
            return bool(observer.ended or signals.count or runner.seconds() - begun > timeout)

        runner.spin(over)
        seconds, status = runner.seconds() - begun, observer.status
        observer.over = True
        why = 'interrupted' if signals.count else 'out of time'
        if not observer.ended:
            controller.stop(why)
        settled = robot.now() + nanoseconds(SETTLING)
        before = signals.count
        patience = runner.seconds() + STOP_PATIENCE + 1.0 / robot.parameters.publish_rate

        def settled_or_late() -> bool:
            discover()
            if controller.waypoint is not None:
                # The goals were still on their way to it.
                controller.stop(why)
            still = observer.seen >= settled and not observer.moving
            return bool(still or runner.seconds() > patience or signals.count > before)

        runner.spin(settled_or_late)
    observer.index = len(goals) - 1
    return Outcome(
        status=status,
        interrupted=signals.count > 0,
        pose=observer.pose,
        distance=observer.distance,
        offset=controller.arrival.offset,
        seconds=seconds,
    )


def _recorder(runner: Runner | LockstepRunner, recording: Recording | None) -> Callable[[], None]:
    """Record what the nodes publish. Return what must be called often, to find new topics."""
    if recording is None:
        return lambda: None
    recorder = runner.add(lambda: Recorder(Selection(), recording, context=runner.context))
    discovered = -math.inf

    def discover() -> None:
        nonlocal discovered
        if runner.seconds() - discovered >= DISCOVERY_PERIOD:
            discovered = runner.seconds()
            recorder.discover()

    discover()
    return discover


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    parser = _parser()
    options = _cli.parse(parser, own)
    if len(options.coordinates) % 2:
        parser.error(f'coordinates come in pairs X Y, got {len(options.coordinates)} of them')
    if options.lockstep and options.open:
        parser.error('--lockstep cannot be open: others have another clock')
    goals = _goals(np.reshape(options.coordinates, (-1, 2)), options.heading)
    ros = ['--ros-args', '--log-level', 'warn', '--', *_cli.with_params_file(ros, options)]
    stage = _lockstep(ros) if options.lockstep else _real_time(ros, open_to_all=options.open)
    recording = None
    try:
        if not options.no_record:
            recording = begin_recording('drive', options.output, 'mcap', lossless=options.lockstep)
    except OSError as error:
        return _cli.complain(PROGRAM, error)
    if recording is not None and not options.no_plot and _picture(recording).exists():
        recording.discard()
        return _cli.complain(PROGRAM, f'{_picture(recording)} exists already; it is not overwritten')
    try:
        with stage as runner:
            outcome = drive(
                goals,
                runner,
                signals,
                timeout=options.timeout,
                parameters=_parameters(options),
                recording=recording,
                ros=ros,
            )
    except UserError as error:
        if recording is not None:
            recording.discard()
        return _cli.complain(PROGRAM, error)
    except DriveError as error:
        # The recording shows how it came to that.
        print(f'{PROGRAM}: error: {error}', file=sys.stderr)
        code = _cli.FAILED
    except BaseException:
        if recording is not None:
            with suppress(RecordingError):
                recording.finish()
        raise
    else:
        code = _report(outcome, options.timeout, ' of simulated time' if options.lockstep else '')
    if recording is None:
        return code
    kept = _keep(recording, plot=not options.no_plot)
    # An interruption stays one.
    return code if code == _cli.INTERRUPTED else kept or code


def _goals(places: NDArray[np.float64], heading: float | None) -> NDArray[np.float64]:
    """Give every place a heading: that of the way on, and at the last one what was asked for, or 0."""
    dx, dy = np.diff(places, axis=0).T
    return np.column_stack([places, [*np.arctan2(dy, dx), heading or 0.0]])


def _parameters(options: argparse.Namespace) -> dict[str, Any]:
    """Give the controller's parameters that have an option of their own."""
    asked = {'xy_goal_tolerance': options.tolerance, 'controller': options.controller}
    if options.heading is not None:
        asked['use_goal_heading'] = True
    return {name: value for name, value in asked.items() if value is not None}


def _picture(recording: Recording) -> Path:
    return recording.bag.with_name(recording.bag.name + '.png')


def _keep(recording: Recording, *, plot: bool) -> int:
    """Make the bag and its picture, and print where they are; return the exit code."""
    code = _cli.DONE
    try:
        recording.finish()
        print(f'recorded: {recording.bag}')
    except RecordingError as error:
        print(f'{PROGRAM}: error: {error}', file=sys.stderr)
        if error.summary is None:
            return _cli.FAILED
        print(f'recorded in part: {recording.bag}')
        code = _cli.FAILED
    if not plot:
        return code
    picture = _picture(recording)
    try:
        draw([read_run(recording.bag)], picture)
        print(f'drawn: {picture}')
    except ModuleNotFoundError:
        print('not drawn: matplotlib is not installed (the extra plot brings it)')
    except (OSError, BagError) as error:
        print(f'{PROGRAM}: error: {error}', file=sys.stderr)
        return _cli.FAILED
    return code


@contextmanager
def _real_time(ros: list[str], *, open_to_all: bool) -> Iterator[Runner]:
    """Hold nodes that live by the wall clock."""
    with (
        nullcontext() if open_to_all else closed_world(),
        ros_context([PROGRAM, *ros]) as context,
        running(context, closed_world=not open_to_all) as runner,
    ):
        yield runner


@contextmanager
def _lockstep(ros: list[str]) -> Iterator[LockstepRunner]:
    """Run nodes in simulated time, as fast as they can.

    Raises:
        UserError: The ROS arguments are invalid.
        DriveError: A callback blocks, or simulated time could not pass for another reason.
    """
    # Not needed otherwise, and slow to import.
    from diffdrive_jacobian.lockstep.runner import running_in_lockstep
    from diffdrive_jacobian.testing import LockstepError

    with ExitStack() as stack:
        try:
            runner = stack.enter_context(running_in_lockstep(ros))
        except LockstepError as error:
            raise UserError(str(error)) from error
        try:
            yield runner
        except LockstepError as error:
            raise DriveError(str(error)) from error


def _report(outcome: Outcome, timeout: float, time: str) -> int:
    """Say how it ended in one line, and of which time its seconds are; gives the exit code."""
    if outcome.pose is None:
        where = 'the robot never reported where it is'
    else:
        x, y, theta = outcome.pose
        of = f' with the point {outcome.offset:g} m ahead of its axle' if outcome.offset else ''
        where = (
            f'the robot stopped at x {x:.3f} m, y {y:.3f} m, heading {theta:.3f} rad, '
            f'{outcome.distance:.3f} m from the goal{of}, after {outcome.seconds:.1f} s{time}'
        )
    if outcome.status == GoalStatus.STATUS_SUCCEEDED:
        print(f'arrived: {where}')
        return _cli.DONE
    if outcome.interrupted:
        print(f'interrupted: {where}')
        return _cli.INTERRUPTED
    reasons = {
        GoalStatus.STATUS_ABORTED: 'goal refused',
        GoalStatus.STATUS_CANCELED: 'goal canceled by somebody else',
    }
    reason = f'--timeout {timeout:g} s was too short'
    if outcome.seconds <= timeout:
        reason = reasons.get(outcome.status, 'ROS was shut down')
    print(f'not arrived ({reason}): {where}')
    return _cli.FAILED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        usage=f'{PROGRAM} X Y [X Y ...] [options] [--ros-args ...]',
        description='Drive the virtual robot to goals, in order: robot, controller and wheel bridge '
        'in one process, the whole Jacobian chain in use. Exit code 0: arrived; 1: not, '
        'or the recording is not complete; 2: wrong arguments; 130: interrupted.',
    )
    parser.add_argument('coordinates', metavar='X Y', nargs='+', type=_cli.coordinate, help='goals (m)')
    parser.add_argument(
        '--timeout',
        type=_cli.positive,
        default=300.0,
        help='give up after this long, all goals together (s); %(default)s',
    )
    parser.add_argument(
        '--tolerance', type=_cli.tolerance, help='distance that counts as arrived (m); 0.02'
    )
    parser.add_argument(
        '--heading', type=_cli.heading, help='heading at the last goal (rad) (default: any)'
    )
    parser.add_argument(
        '--controller', choices=CONTROLLERS, help='law of the controller; go_to_goal, unless a file says'
    )
    _cli.add_params_file(parser)
    parser.add_argument(
        '-o',
        '--output',
        metavar='BAG',
        type=_cli.bag_folder,
        help='where the run is recorded, as a rosbag2 bag, and drawn, as BAG.png; drive_DATE-TIME',
    )
    parser.add_argument('--no-record', action='store_true', help='neither record nor draw')
    parser.add_argument('--no-plot', action='store_true', help='record, but do not draw')
    parser.add_argument(
        '--lockstep',
        action='store_true',
        help='drive in simulated time, as fast as this machine can, and the same way each time',
    )
    parser.add_argument(
        '--open',
        action='store_true',
        help='let other processes see the nodes and reach them (RViz, ros2 topic); '
        'otherwise nobody can, and a real robot on the network cannot be moved by mistake',
    )
    return parser
