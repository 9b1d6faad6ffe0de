"""Quiet worlds of long-lived processes for campaigns, and the messages there."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from functools import partialmethod
from io import StringIO
from pathlib import Path
from typing import Any
from unittest import mock

from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from support import processes
from support.harness import Harness
from support.processes import Child, World, open_world

LIFE = 900.0
"""How long a process may live (s)."""
PATIENCE = 120.0
"""How long a condition may take to come true (s): campaigns run beside other work, at low priority."""


@contextmanager
def quiet_world(folder: Path, life: float = LIFE) -> Iterator[World]:
    """Open a world whose processes may live so long (s). It prints nothing at its end."""
    until = partialmethod(Harness.until, patience=PATIENCE)
    with (
        mock.patch.object(processes, 'LIMIT', life),
        mock.patch.object(processes, 'PATIENCE', PATIENCE),
        mock.patch.object(Harness, 'until', until),
        mock.patch.object(Child, 'exit', partialmethod(Child.exit, patience=PATIENCE)),
        ExitStack() as stack,
    ):
        world = stack.enter_context(open_world(folder))
        try:
            yield world
        finally:
            with redirect_stdout(StringIO()):
                stack.close()


def spin(harness: Harness, seconds: float) -> None:
    """Receive messages for a time (s)."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        harness.executor.spin_once(timeout_sec=0.005)


def _twist(message: Any) -> Any:
    return message.twist.twist if isinstance(message, Odometry) else message


def moves(message: Any) -> bool:
    """Return whether an Odometry, a Twist or a JointState says that the robot moves."""
    if isinstance(message, JointState):
        return any(message.velocity)
    return bool(_twist(message).linear.x or _twist(message).angular.z)


def finite(message: Any) -> bool:
    """Return whether all numbers that a node publishes are finite."""
    if isinstance(message, JointState):
        return all(map(math.isfinite, message.velocity))
    numbers = [_twist(message).linear.x, _twist(message).angular.z]
    if isinstance(message, Odometry):
        pose = message.pose.pose
        numbers += [pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w]
        numbers += [*message.pose.covariance, *message.twist.covariance]
    return all(map(math.isfinite, numbers))
