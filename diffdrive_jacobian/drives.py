"""Drives of the virtual robot to goals: robot, controller and wheel bridge in one process.

    from diffdrive_jacobian.drives import drive

    outcome = drive([[1.0, 1.0]], lockstep=True)
    print(outcome.arrived, outcome.pose, outcome.seconds)

The robot is driven by its wheels, so that the whole Jacobian chain is in use:
goal -> control law -> body twist -> J_w^-1 -> wheel speeds -> J_w -> body twist -> S(theta) -> pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from action_msgs.msg import GoalStatus
from numpy.typing import ArrayLike, NDArray
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from diffdrive_jacobian.control import Path
from diffdrive_jacobian.errors import NotDoneError, UserError
from diffdrive_jacobian.messages.codecs import JOINT_STATE, Wheels
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.messages.topics import Selection
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.goal_client import GoalClient
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.numerics.checks import number, positive_or_infinite
from diffdrive_jacobian.recording.recorder import Recorder
from diffdrive_jacobian.recording.recording import Recording
from diffdrive_jacobian.ros.rate_limit import TokenBucket
from diffdrive_jacobian.ros.runner import NodeRunner, Runner, discovery_off, ros_context, running
from diffdrive_jacobian.ros.serialization import ignoring_invalid
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.time_units import nanoseconds

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep.runner import LockstepRunner

__all__ = [
    'DriveError',
    'DriveProgress',
    'Outcome',
    'drive',
    'in_lockstep',
    'in_real_time',
    'waypoints_through',
]

NAME = 'drive_to'
"""Name of the node that sends the goals."""
SETTLING = 0.1
"""Odometry this much later than the last command shows its effect (s)."""
DISCOVERY_PERIOD = 0.5
"""Time between two searches for new topics to record (s)."""
STANDING = 1e-3
"""Speed and yaw rate up to which a robot is said to have stopped (m/s, rad/s)."""
STOP_PATIENCE = 2.0
"""Longest time in which the robot may come to rest at the end, and report that (s)."""


class DriveError(NotDoneError):
    """A drive in simulated time was aborted. The message says why."""


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


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """The end of a drive."""

    status: int
    """Status of the goals, as in action_msgs/GoalStatus."""
    interrupted: bool
    """Whether a signal ended the drive."""
    pose: NDArray[np.float64] | None
    """`[x, y, theta]` where the robot stopped, shape (3,) (m, m, rad). None: there was no odometry."""
    moving: bool
    """Whether it still moved then noticeably, `STOP_PATIENCE` after the end."""
    distance: float
    """Distance from the driven point to the last goal by the odometry, of a path what remained (m)."""
    true_distance: float
    """The same by the ground truth (m). NaN: the robot has no drift."""
    across: float
    """Greatest distance of the robot from the path by the odometry (m). NaN: it was not driven along
    one."""
    late: float
    """How much later than by the trajectory the robot arrived (s). NaN: it did not, or there were no
    times."""
    tolerance: float
    """Distance that counted as arrived (m). A robot that takes time to stop may have left it again."""
    offset: float
    """x of the driven point in the body frame (m). 0: the axle centre."""
    seconds: float
    """Duration (s), in lockstep of simulated time."""

    @property
    def arrived(self) -> bool:
        """Whether the robot arrived at the last goal."""
        return bool(self.status == GoalStatus.STATUS_SUCCEEDED)


class DriveProgress(Protocol):
    """Receives the progress of a drive."""

    def nodes_created(self, names: Sequence[str]) -> None:
        """Receive the fully qualified names of the nodes, once."""

    def driving(self, seconds: float, index: int, distance: float, wheels: tuple[float, float]) -> None:
        """Receive the state of the drive, many times a second.

        Args:
            seconds: Time since the start (s), in lockstep simulated time.
            index: Index of the current goal.
            distance: Distance from the driven point to that goal (m).
            wheels: Speeds of the right and the left wheel (rad/s).
        """


def waypoints_through(places: ArrayLike, heading: float = 0.0) -> NDArray[np.float64]:
    """Return waypoints with a heading at each place.

    Args:
        places: `[x, y]` of each place, shape (n, 2) (m).
        heading: Heading at the last place (rad).

    Returns:
        `[x, y, theta]`, shape (n, 3) (m, m, rad). theta is the direction to the next place.

    Raises:
        ValueError: `places` has another shape, or is empty.
    """
    places = np.asarray(places, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != 2 or not len(places):
        raise ValueError(f'places must have shape (n, 2) with n > 0, got {places.shape}')
    dx, dy = np.diff(places, axis=0).T
    return np.column_stack([places, [*np.arctan2(dy, dx), heading]])


def drive(
    goals: ArrayLike | Path,
    *,
    relative: bool = False,
    runner: NodeRunner | None = None,
    lockstep: bool = False,
    isolated: bool = True,
    timeout: float = 300.0,
    parameters: Mapping[str, Any] | None = None,
    robot_parameters: Mapping[str, Any] | None = None,
    recording: Recording | None = None,
    ros_arguments: Sequence[str] = (),
    signals: Signals | None = None,
    progress: DriveProgress | None = None,
) -> Outcome:
    """Drive the virtual robot to goals in order, or along a path, with all three nodes in this process.

    Args:
        goals: `[x, y]` of each goal, shape (n, 2), or `[x, y, theta]`, shape (n, 3) (m, m, rad). theta
            matters for controllers that use the heading, and with the parameter `use_goal_heading`. Or a
            path, with times a trajectory.
        relative: Whether the goals are in the body frame of the robot where it starts. Otherwise they
            are in the frame of the odometry.
        runner: Runs the nodes, and may run others: `in_real_time` or `in_lockstep`. The nodes stay in
            it. None: one is created as `lockstep`, `isolated` and `ros_arguments` say, and closed at
            the end.
        lockstep: Whether to drive in simulated time, as fast as possible and with the same result each
            time. rclpy must not be initialised then.
        isolated: Whether no other process can communicate with the nodes. Always so in lockstep.
        timeout: Longest duration, of all goals together (s).
        parameters: Parameters of go_to_goal, by name. They take precedence over `ros_arguments`.
        robot_parameters: Likewise of virtual_robot.
        recording: Recording of what the nodes publish. The caller must finish it. None: none.
        ros_arguments: ROS arguments of all nodes, such as `['--ros-args', '-p', 'kp:=4.0']`.
        signals: Counter of the signals that end the drive. None: no signal does.
        progress: Receives the progress. None: nothing does.

    Raises:
        UserError: A node cannot run with the parameters or ROS arguments given.
        DriveError: In lockstep, a callback blocks, or simulated time cannot advance.
        ValueError: `goals` has another shape, `timeout` is not positive, `lockstep` is not isolated, or
            one of the arguments for a new runner is given together with `runner`.
    """
    number('timeout', timeout, positive_or_infinite)
    if lockstep and not isolated:
        raise ValueError('a drive in lockstep is always isolated: other processes have another clock')
    if runner is not None and (lockstep or not isolated or ros_arguments):
        raise ValueError('lockstep, isolated and ros_arguments are those of the runner, if one is given')
    if not isinstance(goals, Path):
        goals = np.asarray(goals, dtype=np.float64)
        if goals.ndim != 2 or goals.shape[1] not in (2, 3) or not len(goals):
            raise ValueError(f'goals must have shape (n, 2) or (n, 3) with n > 0, got {goals.shape}')
        if goals.shape[1] == 2:
            goals = waypoints_through(goals)
    sent, signals = goals, signals or Signals()
    with ExitStack() as stack:
        if runner is None:
            runner = stack.enter_context(
                in_lockstep(ros_arguments)
                if lockstep
                else in_real_time(ros_arguments, isolated=isolated)
            )
        context = runner.context
        robot, bridge, controller = add_nodes(runner, parameters or {}, robot_parameters or {})
        client = runner.add(lambda: GoalClient(NAME, sent, context, relative=relative))
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
        discover = recorder_of(runner, recording)
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

        runner.spin(ended, timeout=timeout, signals=signals)
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
            status=status,
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
        )


def add_nodes(
    runner: NodeRunner, parameters: Mapping[str, Any], robot_parameters: Mapping[str, Any]
) -> tuple[VirtualRobot, WheelBridge, GoToGoal]:
    """Add a robot that is driven by its wheels, the bridge and the controller to a runner.

    Args:
        runner: Runs the nodes.
        parameters: Parameters of go_to_goal, by name.
        robot_parameters: Likewise of virtual_robot.
    """
    of_robot = overrides({**robot_parameters, 'command_interface': 'wheels'})
    of_controller, how = overrides(parameters), {'context': runner.context}
    return (
        runner.add(lambda: VirtualRobot(**how, parameter_overrides=of_robot)),
        runner.add(lambda: WheelBridge(**how)),
        runner.add(lambda: GoToGoal(**how, parameter_overrides=of_controller)),
    )


def overrides(parameters: Mapping[str, Any]) -> list[Parameter]:
    """Return parameters, by name, as a node takes them."""
    return [Parameter(name, value=value) for name, value in parameters.items()]


def recorder_of(runner: NodeRunner, recording: Recording | None) -> Callable[[], None]:
    """Record what the nodes publish, if there is a recording.

    Returns:
        A function that finds new topics, to be called often.
    """
    if recording is None:
        return lambda: None
    recorder = runner.add(lambda: Recorder(Selection(), recording, context=runner.context))
    discovery = TokenBucket(1, DISCOVERY_PERIOD)

    def discover() -> None:
        if discovery.permits(runner.seconds()):
            recorder.discover()

    discover()
    return discover
