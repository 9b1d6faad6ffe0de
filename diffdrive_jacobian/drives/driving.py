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

"""A drive, by the nodes where rclpy is installed, and without them elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.control import Controller, Path, PathController
from diffdrive_jacobian.control.controller import ControlLaw
from diffdrive_jacobian.control.controllers import names_of_gains
from diffdrive_jacobian.control.path_source import is_shape, planned_path
from diffdrive_jacobian.drives.outcome import DriveProgress, Outcome, Request, waypoints_through
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.conversion import MAX_POSITION, MAX_WAYPOINTS
from diffdrive_jacobian.numerics.checks import number, positive_or_infinite, short
from diffdrive_jacobian.parameters.arguments import unknown
from diffdrive_jacobian.parameters.declaration import NodeParameters
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.signals import Signals, counting_interrupts

if TYPE_CHECKING:
    from diffdrive_jacobian.recording.recording import Recording
    from diffdrive_jacobian.ros.runner import NodeRunner

QUIET = ('--ros-args', '--log-level', 'warn', '--')
OF_EVERY_NODE = {'use_sim_time', 'start_type_description_service'}
QOS = 'qos_overrides.'
"""Beginning of the parameters by which a node of ROS has another quality of service."""


def drive(
    goals: ArrayLike | Path | str | FilePath,
    *,
    relative: bool | None = None,
    controller: str | Controller | None = None,
    path_controller: str | PathController | None = None,
    runner: NodeRunner | None = None,
    lockstep: bool = False,
    isolated: bool = True,
    timeout: float = 300.0,
    parameters: Mapping[str, Any] | None = None,
    robot_parameters: Mapping[str, Any] | None = None,
    recording: Recording | str | FilePath | None = None,
    keep: bool = True,
    ros_arguments: Sequence[str] = (),
    signals: Signals | None = None,
    progress: DriveProgress | None = None,
) -> Outcome:
    """Drive the virtual robot to goals in order, or along a path, with all three nodes in this process.

    Where rclpy is not installed, the robot, the bridge and the controller are driven without nodes: with
    `lockstep` in simulated time, otherwise in real time.

    Args:
        goals: `[x, y]` of each goal, shape (n, 2), or `[x, y, theta]`, shape (n, 3) (m, m, rad). theta
            matters for controllers that use the heading, and with the parameter `use_goal_heading`. Or a
            path, with times a trajectory, or its text as `control.path_source.planned_path` takes it:
            'circle:1.0' or the name of a file.
        relative: Whether the goals are in the body frame of the robot where it starts. Otherwise they
            are in the frame of the odometry. None: shapes such as 'circle:1.0' are.
        controller: The parameter `controller` of go_to_goal, or a law of your own. None: as `parameters`
            say.
        path_controller: Likewise.
        runner: Runs the nodes, and may run others: `in_real_time` or `in_lockstep`. The nodes stay in
            it. None: one is created as `lockstep`, `isolated` and `ros_arguments` say, and closed at
            the end.
        lockstep: Whether to drive in simulated time, as fast as possible and with the same result each
            time. rclpy must not be initialised then.
        isolated: Whether no other process can communicate with the nodes. Always so in lockstep.
        timeout: Longest duration, of all goals together (s).
        parameters: Parameters of go_to_goal, by name. They take precedence over `ros_arguments`.
        robot_parameters: Likewise of virtual_robot. What wheel_bridge has to know, too, such as the
            dimensions of the wheels, is given to all by `ros_arguments`.
        recording: The bag to write, or a recording of what the nodes publish, which the caller must
            finish. None: none.
        keep: Whether the outcome has the run. It has none with a runner, and none of a recording that
            the caller finishes.
        ros_arguments: ROS arguments of all nodes, such as `['--ros-args', '-p', 'kp:=4.0']`. Without
            rclpy, parameters and files of parameters.
        signals: Counter of the signals that end the drive. None: Ctrl-C ends it, and raises
            KeyboardInterrupt when the robot stands and the bag is written.
        progress: Receives the progress. None: nothing does.

    Raises:
        UserError: A node cannot run with the parameters or ROS arguments given, the bag cannot be
            written there, or an argument needs rclpy, which is not installed.
        DriveError: In lockstep, a callback blocks, or simulated time cannot advance.
        RecordingError: The bag is not complete.
        PathError: `goals` is a text that is no path.
        ValueError: `goals` has another shape, `timeout` is not positive, `lockstep` is not isolated, or
            one of the arguments for a new runner is given together with `runner`.
    """
    number('timeout', timeout, positive_or_infinite)
    if lockstep and not isolated:
        raise ValueError('a drive in lockstep is always isolated: other processes have another clock')
    if runner is not None and (lockstep or not isolated or ros_arguments):
        raise ValueError('lockstep, isolated and ros_arguments are those of the runner, if one is given')
    if relative is None:
        relative = isinstance(goals, str) and is_shape(goals)
    if isinstance(ros_arguments, str) or (ros_arguments and ros_arguments[0] != '--ros-args'):
        raise UserError(
            f"ros_arguments must be a list that begins with '--ros-args', got {ros_arguments!r}"
        )
    laws = {'controller': controller, 'path_controller': path_controller}
    own = {name: law for name, law in laws.items() if isinstance(law, ControlLaw)}
    chosen = {name: getattr(law, 'name', law) for name, law in laws.items() if law is not None}
    of_controller = {**checked_parameters('parameters', parameters, own.values()), **chosen}
    of_robot = checked_parameters('robot_parameters', robot_parameters)
    to = as_goals(goals)
    if path_controller is not None and not (isinstance(to, Path) or of_controller.get('pass_waypoints')):
        raise ValueError('path_controller has no effect on goals without pass_waypoints')
    with ExitStack() as stack:
        if signals is None:
            signals = stack.enter_context(counting_interrupts())
        bag = None
        if isinstance(recording, (str, FilePath)):
            # Slow to import.
            from diffdrive_jacobian.recording.recording import open_recording, saved_on_error

            recording = bag = open_recording('drive', str(recording), lossless=lockstep)
            stack.enter_context(saved_on_error(bag))
        request = Request(
            goals=to,
            relative=relative,
            timeout=timeout,
            laws=own,
            parameters=of_controller,
            robot_parameters=of_robot,
            recording=recording,
            keep=keep and recording is None and runner is None,
            signals=signals,
            progress=progress,
        )
        if runner is not None or has_ros():
            from diffdrive_jacobian.drives import nodes

            outcome = nodes.drive(
                request,
                runner=runner,
                lockstep=lockstep,
                isolated=isolated,
                # A notebook shows what is logged.
                ros_arguments=[*QUIET, *ros_arguments] if runner is None else (),
            )
        else:
            from diffdrive_jacobian.drives import values

            if not isolated:
                raise UserError('other processes need rclpy, which is not installed')
            outcome = values.drive(request, lockstep=lockstep, ros_arguments=ros_arguments)
        if bag is not None:
            bag.finish()
    if bag is None or not keep:
        return outcome
    from diffdrive_jacobian.bags.run import read_run

    return replace(outcome, kept=read_run(bag.bag))


def has_ros() -> bool:
    """Return whether the nodes can run: rclpy is installed."""
    try:
        return find_spec('rclpy') is not None
    except ModuleNotFoundError:
        return False


def checked_parameters(
    argument: str, given: Mapping[str, Any] | None, laws: Iterable[ControlLaw] = ()
) -> dict[str, Any]:
    """Return the parameters of one node for a drive, with numbers of Python.

    Args:
        argument: 'parameters' or 'robot_parameters'.
        given: Values by name; None: none.
        laws: Laws whose gains are parameters of go_to_goal, too.

    Raises:
        ValueError: It is no mapping from names.
        UserError: The node has no parameter of a name.
    """
    values, gains = {} if given is None else given, {gain for law in laws for gain in law.gain_names}
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        raise ValueError(f'{argument} must map names of parameters to values, got {short(given, repr)}')
    nodes: dict[str, tuple[str, NodeParameters]] = {
        'parameters': ('go_to_goal', GoToGoalParameters()),
        'robot_parameters': ('virtual_robot', VirtualRobotParameters()),
    }
    node, own = nodes.pop(argument)
    ((place, (other, others)),) = nodes.items()
    known = own.declared().keys() | (OF_EVERY_NODE if has_ros() else set())
    for name in (one for one in values if one not in known and not one.startswith(QOS)):
        if name in others.declared():
            raise UserError(f'{name!r} is a parameter of {other}: give it in {place}')
        # Controllers that are installed have parameters once they are chosen.
        if node == 'virtual_robot' or name not in names_of_gains() | gains:
            raise UserError(f'{node} has no {next(unknown([name], known | gains))}')
    return {name: one.item() if isinstance(one, np.generic) else one for name, one in values.items()}


def as_goals(goals: ArrayLike | Path | str | FilePath) -> NDArray[np.float64] | Path:
    """Return the goals of a drive as poses, shape (n, 3), or as a path.

    Raises:
        ValueError: They are none.
    """
    if isinstance(goals, (str, FilePath)):
        return planned_path(str(goals))
    if isinstance(goals, Path):
        return goals
    try:
        poses = np.asarray(goals, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(
            'goals must be rows [x, y] or [x, y, theta], a path, or its text such as circle:1.0, got '
            f'{short(goals, repr)}'
        ) from error
    if poses.ndim != 2 or poses.shape[1] not in (2, 3) or not len(poses):
        meant = f': is it [{short(goals, repr)}]?' if poses.shape in ((2,), (3,)) else ''
        raise ValueError(f'goals must have shape (n, 2) or (n, 3) with n > 0, got {poses.shape}{meant}')
    if len(poses) > MAX_WAYPOINTS:
        raise ValueError(f'goals must be at most {MAX_WAYPOINTS}, got {len(poses)}')
    if not np.all(np.abs(poses) <= MAX_POSITION):
        raise ValueError(f'goals must be finite and within {MAX_POSITION:g} m, got {short(goals, repr)}')
    return waypoints_through(poses) if poses.shape[1] == 2 else poses
