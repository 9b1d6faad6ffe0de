"""Nodes with the page, until a signal comes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from diffdrive_jacobian.control import Path
from diffdrive_jacobian.drives import in_lockstep, in_real_time
from diffdrive_jacobian.drives.driving import overrides, recorder_of
from diffdrive_jacobian.live.goal_progress import GoalEnd
from diffdrive_jacobian.live.node import LivePage
from diffdrive_jacobian.live.pacing import Pacing
from diffdrive_jacobian.live.serving import Ready, serving
from diffdrive_jacobian.live.session import Session
from diffdrive_jacobian.lockstep.runner import LockstepRunner
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.recording.recording import Recording
from diffdrive_jacobian.ros.runner import NodeRunner, ros_context, running
from diffdrive_jacobian.signals import Signals


def watch_nodes(*, ros_arguments: Sequence[str], port: int, signals: Signals, ready: Ready) -> None:
    """Show and steer robots whose nodes run in other processes.

    Args:
        ros_arguments: ROS arguments of the node.
        port: As for `serving`.
        signals: Counter of the signals that end it.
        ready: As for `serving`.

    Raises:
        UserError: The ROS arguments are invalid.
        OSError: The port is in use.
    """
    session = Session()
    with (
        serving(session, port, ready),
        ros_context(['watch_run', *ros_arguments]) as context,
        running(context, isolated=False) as runner,
    ):
        page = runner.add(lambda: LivePage(session, context, polled=True))
        try:
            runner.spin(lambda: False, signals=signals)
        finally:
            page.stop()


def drive_live(
    goals: NDArray[np.float64] | Path,
    *,
    relative: bool = False,
    lockstep: bool,
    isolated: bool,
    parameters: Mapping[str, Any],
    robot_parameters: Mapping[str, Any],
    recording: Recording | None,
    ros_arguments: Sequence[str],
    port: int,
    signals: Signals,
    ready: Ready,
    nodes_created: Callable[[Sequence[str]], None],
    goal_ended: Callable[[GoalEnd], None] | None = None,
) -> None:
    """Run robot, wheel bridge and controller in this process, with the page, until a signal comes.

    Args:
        goals: `[x, y, theta]` of goals that are sent when a page is open, shape (n, 3), n may be 0
            (m, m, rad). Or a path.
        relative: Whether they are in the body frame of the robot where it is then.
        lockstep: Whether time is simulated. The page then has pause, step and speed.
        isolated: Whether no other process can communicate with the nodes.
        parameters: Parameters of go_to_goal.
        robot_parameters: Parameters of virtual_robot.
        recording: Recording of what the nodes publish. The caller must finish it. None: none.
        ros_arguments: ROS arguments of all nodes.
        port: As for `serving`.
        signals: Counter of the signals that end it.
        ready: As for `serving`.
        nodes_created: Receives the fully qualified names of the nodes.
        goal_ended: Receives the end of each goal. None: nothing does.

    Raises:
        UserError: A node cannot run with the parameters or ROS arguments given.
        DriveError: In lockstep, a callback blocks, or simulated time cannot advance.
        OSError: The port is in use.
    """
    session = Session()
    stage = in_lockstep(ros_arguments) if lockstep else in_real_time(ros_arguments, isolated=isolated)
    with serving(session, port, ready), stage as runner:
        context = runner.context
        of_robot = overrides({**robot_parameters, 'command_interface': 'wheels'})
        of_controller = overrides(parameters)
        nodes: list[Node] = [
            runner.add(lambda: VirtualRobot(context=context, parameter_overrides=of_robot)),
            runner.add(lambda: WheelBridge(context=context)),
            runner.add(lambda: GoToGoal(context=context, parameter_overrides=of_controller)),
        ]
        nodes_created([node.get_fully_qualified_name() for node in nodes])
        pacing = Pacing() if lockstep else None
        # The executor of nodes that others can reach leaves the topics to `work`.
        page = runner.add(
            lambda: LivePage(session, context, polled=not isolated, pacing=pacing, goal_ended=goal_ended)
        )
        discover = recorder_of(runner, recording)
        waiting = [goals] if isinstance(goals, Path) or len(goals) else []

        def work() -> bool:
            discover()
            page.work()
            robot = next(iter(page.robots.values()), None)
            # Whoever opened the page wants to see the whole drive.
            if waiting and session.watched and robot is not None and robot.ready:
                robot.send(waiting.pop(), relative=relative)
            return signals.count > 0

        try:
            runner.spin(_paced(runner, pacing, work) if pacing is not None else work)
        finally:
            page.stop()


def _paced(runner: NodeRunner, pacing: Pacing, work: Callable[[], bool]) -> Callable[[], bool]:
    """Return a condition of the loop that lets simulated time pass as the page wants."""
    assert isinstance(runner, LockstepRunner)

    def meanwhile() -> bool:
        over = work()
        # What the page has sent is answered also while time stands.
        runner.settle()
        return over

    def over() -> bool:
        if work():
            return True
        return pacing.pace(runner.seconds(), meanwhile)

    return over
