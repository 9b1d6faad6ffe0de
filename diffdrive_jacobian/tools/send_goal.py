"""Send a goal to a controller that runs in another process, and wait for the end."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from diffdrive_jacobian.ros import messages
from diffdrive_jacobian.ros.messages import MessageError
from diffdrive_jacobian.ros.runner import Runner, UserError, ros_context, running
from diffdrive_jacobian.ros.signals import Signals
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._progress import Drive

PROGRAM = 'send_goal'
ANSWER_PATIENCE = 5.0
"""How long the controller may take to say whether it accepts, or that it canceled (s)."""

LOOK_PERIOD = 1.0
"""How often the tool looks whether the controller is still there (s)."""

ENDS = {
    GoalStatus.STATUS_SUCCEEDED: 'arrived',
    GoalStatus.STATUS_CANCELED: 'canceled',
    GoalStatus.STATUS_ABORTED: 'aborted',
}


class Sender(Node):  # type: ignore[misc]
    """Sends one goal and follows what becomes of it."""

    def __init__(
        self, goal: NDArray[np.float64], frame: str, context: Context, readers: int = 1
    ) -> None:
        """Prepare to send a goal `[x, y, theta]`, shape (3,), to so many readers."""
        super().__init__('send_goal', context=context, start_parameter_services=False)
        self.goal = goal
        self.status = GoalStatus.STATUS_UNKNOWN
        self.pose: NDArray[np.float64] | None = None
        self.seen = time.monotonic()
        """When odometry came last, or the watch for it began (s, monotonic)."""
        self._frame = frame
        self._readers = readers
        self._message: PoseStamped | None = None
        self._publisher = self.create_publisher(PoseStamped, 'goal_pose', 10)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(GoalStatus, 'goal_status', self._on_status, latched)
        self.create_subscription(Odometry, 'odom', self._on_odometry, 10)
        # rclpy reports a name that is too long only here.
        self.resolve_service_name('cancel_goal')
        self._cancel = self.create_client(Trigger, 'cancel_goal')

    @property
    def distance(self) -> float:
        """The distance to the goal (m); infinite before the first odometry."""
        if self.pose is None:
            return math.inf
        return math.hypot(self.goal[0] - self.pose[0], self.goal[1] - self.pose[1])

    def controllers(self) -> set[bytes]:
        """Tell who publishes goal_status: others than controllers read goal_pose, too."""
        topic = self.resolve_topic_name('goal_status')
        return {bytes(info.endpoint_gid) for info in self.get_publishers_info_by_topic(topic)}

    def obstacle(self) -> str | None:
        """Say what is missing before a goal can be sent; None: nothing."""
        if self.get_clock().now().nanoseconds == 0:
            return 'use_sim_time is true, but nothing came on /clock'
        readers = [
            reader
            for reader in self.get_subscriptions_info_by_topic(self.resolve_topic_name('goal_pose'))
            # One that wants to hear what was latched is never matched with us.
            if reader.qos_profile.durability != DurabilityPolicy.TRANSIENT_LOCAL
        ]
        tellers = self.get_publishers_info_by_topic(self.resolve_topic_name('goal_status'))
        found = self._publisher.get_subscription_count()
        if readers and found < self._readers:
            topic = self.resolve_topic_name('goal_pose')
            return f'{topic} has {found} readers, not the {self._readers} that are to be waited for'
        matched = found >= len(readers)
        if not (matched and _nodes(readers) & _nodes(tellers)):
            return (
                f'nobody reads {self.resolve_topic_name("goal_pose")} and publishes '
                f'{self.resolve_topic_name("goal_status")}; is go_to_goal running, in the same '
                'namespace and the same ROS_DOMAIN_ID?'
            )
        return None

    def confirmed(self) -> bool:
        """Wait until the readers have the goal."""
        arrived: bool = self._publisher.wait_for_all_acked(Duration(seconds=ANSWER_PATIENCE))
        return arrived

    def send(self) -> None:
        """Publish the goal; its stamp tells it from older ones."""
        message = PoseStamped()
        message.header.stamp, message.header.frame_id = (
            self.get_clock().now().to_msg(),
            self._frame,
        )
        messages.set_pose(message.pose, self.goal)
        self._message = message
        self._publisher.publish(message)
        self.seen = time.monotonic()

    def cancel(self) -> None:
        """Ask the controller to let go of the goal."""
        self._cancel.call_async(Trigger.Request())

    def _on_status(self, message: GoalStatus) -> None:
        # The status of an older goal is latched and comes first.
        if self._message is not None and message.goal_info.stamp == self._message.header.stamp:
            self.status = message.status

    def _on_odometry(self, message: Odometry) -> None:
        try:
            self.pose = messages.from_pose(message.pose.pose)
            self.seen = time.monotonic()
        except MessageError as error:
            self.get_logger().warning(f'odometry dropped: {error}', throttle_duration_sec=2.0)


def _nodes(endpoints: Iterable[Any]) -> set[tuple[str, str]]:
    """Tell which nodes endpoints belong to; the name of a node may be found out later."""
    return {
        (endpoint.node_namespace, endpoint.node_name)
        for endpoint in endpoints
        if not endpoint.node_name.startswith('_')
    }


def follow(sender: Sender, runner: Runner, signals: Signals, options: argparse.Namespace) -> int:
    """Send the goal once a controller is there, and wait for the end; gives the exit code."""
    if not _spin(runner, signals, options.wait, lambda: sender.obstacle() is None):
        if signals.count:
            print('interrupted: nothing was sent')
            return _cli.INTERRUPTED
        print(f'not sent within {options.wait:g} s: {sender.obstacle()}')
        return _cli.FAILED
    controllers = sender.controllers()
    sender.send()
    x, y, _ = sender.goal
    topic = sender.resolve_topic_name('goal_pose')
    if options.no_wait:
        if not sender.confirmed():
            print(f'sent, but its readers on {topic} have not confirmed it')
            return _cli.FAILED
        print(f'sent: goal ({x:g}, {y:g}) on {topic}')
        return _cli.DONE
    if not _spin(runner, signals, ANSWER_PATIENCE, lambda: sender.status != GoalStatus.STATUS_UNKNOWN):
        if signals.count:
            return _cancel(sender, runner, signals, _cli.INTERRUPTED)
        print(
            f'no answer: the controller says nothing on '
            f'{sender.resolve_topic_name("goal_status")} within {ANSWER_PATIENCE:g} s'
        )
        return _cli.FAILED
    ended = _watch(sender, runner, signals, options.timeout, controllers)
    where = '' if sender.pose is None else f', {sender.distance:.3f} m from the goal'
    if sender.status in ENDS:
        print(f'{ENDS[sender.status]}{where}{_hint(sender.status)}')
        return _cli.DONE if sender.status == GoalStatus.STATUS_SUCCEEDED else _cli.FAILED
    if ended:
        print(f'lost: the controller is gone{where}')
        return _cli.FAILED
    if not signals.count:
        print(f'not arrived within --timeout {options.timeout:g} s{where}')
        return _cancel(sender, runner, signals, _cli.FAILED)
    return _cancel(sender, runner, signals, _cli.INTERRUPTED)


def _watch(
    sender: Sender, runner: Runner, signals: Signals, timeout: float, controllers: set[bytes]
) -> bool:
    """Show the drive until the goal ends or its controllers are gone; False: time out or a signal."""
    x, y, _ = sender.goal
    looked = time.monotonic()
    said = False
    with Drive() as progress:

        def over() -> bool:
            nonlocal looked, said
            now = time.monotonic()
            blind = now - sender.seen > ANSWER_PATIENCE
            if blind and not said:
                topic = sender.resolve_topic_name('odom')
                print(f'no odometry on {topic} for {ANSWER_PATIENCE:g} s: is the robot running?')
            said = blind
            if sender.pose is not None and not blind:
                progress.show(f'goal ({x:g}, {y:g})', sender.distance)
            if sender.status in ENDS:
                return True
            if now - looked < LOOK_PERIOD:
                return False
            looked = now
            # A controller that was started anew knows nothing of the goal.
            return not controllers & sender.controllers()

        return _spin(runner, signals, timeout, over)


def _hint(status: int) -> str:
    if status == GoalStatus.STATUS_ABORTED:
        return " (the controller's log says why)"
    if status == GoalStatus.STATUS_CANCELED:
        return ' (by somebody else, or replaced by another goal)'
    return ''


def _cancel(sender: Sender, runner: Runner, signals: Signals, code: int) -> int:
    """Take the goal back; another signal ends the wait."""
    sender.cancel()
    before = signals.count
    deadline = time.monotonic() + ANSWER_PATIENCE
    runner.spin(lambda: sender.status in ENDS or signals.count > before or time.monotonic() > deadline)
    if sender.status in ENDS:
        print(f'{ENDS[sender.status]}: the robot was stopped')
    else:
        print('the controller has not confirmed that it canceled: the robot may still drive')
    return code


def _spin(runner: Runner, signals: Signals, seconds: float, until: Callable[[], bool]) -> bool:
    """Spin until a condition holds; False after so many seconds or on a signal."""
    deadline = time.monotonic() + seconds
    held = False

    def over() -> bool:
        nonlocal held
        held = until()
        return held or signals.count > 0 or time.monotonic() > deadline

    runner.spin(over)
    return held


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; gives the exit code."""
    own, ros = _cli.split_arguments(arguments)
    options = _parser().parse_args(own)
    goal = np.array([options.x, options.y, options.heading])
    try:
        with (
            ros_context([PROGRAM, *ros]) as context,
            running(context, closed_world=False) as runner,
        ):
            sender = runner.add(lambda: Sender(goal, options.frame, context, options.readers))
            return follow(sender, runner, signals, options)
    except UserError as error:
        return _cli.complain(PROGRAM, error)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        usage=f'{PROGRAM} X Y [options] [--ros-args ...]',
        description='Send a goal to a running go_to_goal and wait for the end. Ctrl-C cancels the '
        'goal. Exit code 0: arrived; 1: not; 2: wrong arguments; 130: interrupted.',
    )
    parser.add_argument('x', metavar='X', type=_cli.coordinate, help='goal (m)')
    parser.add_argument('y', metavar='Y', type=_cli.coordinate, help='goal (m)')
    _cli.add_wait_matching(parser, 'goal_pose has')
    parser.add_argument(
        '--heading',
        type=_cli.number,
        default=0.0,
        help='heading at the goal (rad), 0 without it; counts if the controller has use_goal_heading',
    )
    parser.add_argument(
        '--frame', default='', help="frame of the goal; without it the odometry's is meant"
    )
    parser.add_argument(
        '--wait',
        type=_cli.positive,
        default=10.0,
        help='wait so long for a controller (s); %(default)s',
    )
    parser.add_argument(
        '--timeout',
        type=_cli.positive,
        default=math.inf,
        help='cancel the goal and give up after this long (s); default: never',
    )
    parser.add_argument(
        '--no-wait', action='store_true', help='only send the goal, do not wait for the end'
    )
    return parser
