"""The goal of send_goal: it is sent once a controller is there, and followed to its end."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping

from action_msgs.msg import GoalStatus

from diffdrive_jacobian.ros.goal_sender import GoalSender, loss
from diffdrive_jacobian.ros.liveness import Liveness
from diffdrive_jacobian.ros.runner import Runner
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._progress import Drive
from diffdrive_jacobian.tools._waiting import Waiting

ANSWER_PATIENCE = 5.0
"""How long the controller may take to say whether it accepts, or that it canceled (s)."""

LOOK_PERIOD = 1.0
"""Time between two looks at the publishers of goal_status (s)."""

ENDS = {
    GoalStatus.STATUS_SUCCEEDED: 'arrived',
    GoalStatus.STATUS_CANCELED: 'canceled',
    GoalStatus.STATUS_ABORTED: 'aborted',
}


def follow(sender: GoalSender, runner: Runner, signals: Signals, options: argparse.Namespace) -> int:
    """Send the goal once a controller is there, and wait for the end; return the exit code."""
    waiting = Waiting()

    def ready() -> bool:
        obstacle = sender.obstacle()
        if obstacle is not None:
            waiting.show(obstacle)
        return obstacle is None

    if not _spin(runner, signals, options.wait, ready):
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
        if not sender.confirmed(ANSWER_PATIENCE):
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
    lost = _watch(sender, runner, signals, options.timeout, controllers)
    where = '' if sender.pose is None else f', {sender.distance:.3f} m from the goal'
    if sender.status in ENDS:
        print(f'{ENDS[sender.status]}{where}{_hint(sender.status)}')
        return _cli.DONE if sender.status == GoalStatus.STATUS_SUCCEEDED else _cli.FAILED
    if lost is not None:
        # One that only hangs reads it when it goes on: nobody watches over the goal any longer.
        sender.cancel()
        print(f'lost: {lost}{where}')
        return _cli.FAILED
    if not signals.count:
        print(f'not arrived within --timeout {options.timeout:g} s{where}')
        return _cancel(sender, runner, signals, _cli.FAILED)
    return _cancel(sender, runner, signals, _cli.INTERRUPTED)


def _watch(
    sender: GoalSender,
    runner: Runner,
    signals: Signals,
    timeout: float,
    controllers: Mapping[bytes, str],
) -> str | None:
    """Show the drive until the goal has ended, the controller is lost, a timeout (s) or a signal.

    Returns:
        Why the controller is lost; None: it is not.
    """
    x, y, _ = sender.goal
    looked = time.monotonic()
    said = False
    lost: str | None = None
    present = controllers
    liveness = Liveness(sender, sorted(set(controllers.values()) - {''}))
    with Drive() as progress:

        def over() -> bool:
            nonlocal looked, said, lost, present
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
            if now - looked >= LOOK_PERIOD:
                looked, present = now, sender.controllers()
            lost = loss(controllers, present, liveness.silence())
            return lost is not None

        _spin(runner, signals, timeout, over)
    return lost


def _hint(status: int) -> str:
    if status == GoalStatus.STATUS_ABORTED:
        return " (the controller's log says why)"
    if status == GoalStatus.STATUS_CANCELED:
        return ' (by somebody else, or replaced by another goal)'
    return ''


def _cancel(sender: GoalSender, runner: Runner, signals: Signals, code: int) -> int:
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
