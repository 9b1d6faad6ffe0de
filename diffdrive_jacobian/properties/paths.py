"""Following paths."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rclpy.publisher import Publisher

from diffdrive_jacobian.control import Path
from diffdrive_jacobian.control.path import PathProgress
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.codecs import PATH
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.numerics.checks import NotNegative, PositiveOrInfinite
from diffdrive_jacobian.numerics.fields import Name, Names
from diffdrive_jacobian.properties._messages import FieldReader, Pose, Twist
from diffdrive_jacobian.properties._node_time import ROUNDING
from diffdrive_jacobian.properties.base import Property, Watch
from diffdrive_jacobian.properties.goals import Motion


@dataclass(frozen=True, repr=False)
class StaysOnPath(Property):
    """The robot stays on each path that is published, and reaches its end in time.

    Each message of the odometry counts, from when a path was published until another path or a goal was
    published, or the cancel service has responded. The distance is that from the nearest point of the
    path near the last one, so that crossings of the path do not matter. A message that is no path counts
    as none. With `within`, a run that ends before the end of the path is reached violates the property:
    let it run longer. Time is world time.

    Attributes:
        tolerance: Largest distance from the path, and at last from its end (m).
        within: Time in which the end must be reached (s) (default: infinite, it need not be).
        after: Arc length from which on the distance counts (m) (default: 0.0).
        path: Topic of type nav_msgs/Path (default: 'path').
        odom: Topic of the odometry (default: 'odom').
        goals: Topics of goals, which replace a path (default: ('goal_pose', 'goals')).
        cancel: Service that cancels the path (default: 'cancel_goal').
    """

    tolerance: NotNegative
    within: PositiveOrInfinite = field(default=math.inf, kw_only=True)
    after: NotNegative = field(default=0.0, kw_only=True)
    path: Name = field(default='path', kw_only=True)
    odom: Name = field(default='odom', kw_only=True)
    goals: Names = field(default=('goal_pose', 'goals'), kw_only=True)
    cancel: Name = field(default='cancel_goal', kw_only=True)

    def watch(self, world: Lockstep) -> Watch:
        """Begin to observe a run."""
        return _PathWatch(self, world)


_read_path = FieldReader(lambda _: PATH.fields).read


class _PathWatch(Watch):
    def __init__(self, required: StaysOnPath, world: Lockstep) -> None:
        super().__init__(world)
        self._required = required
        self._progress: PathProgress | None = None
        self._since = 0.0
        self._reached = False
        world.expect(required.resolved(required.path))
        self._path = world.on_published(required.resolved(required.path), self._on_path)
        for topic in required.goals:
            world.on_published(required.resolved(topic), self._on_other)
        world.on_response(required.resolved(required.cancel), self._on_other)
        self._motion = Motion(world, required.resolved(required.odom), self._on_motion)

    def _on_path(self, publisher: Publisher, message: Any) -> None:
        self._progress, self._since, self._reached = None, self.seconds, False
        fields = _read_path(publisher.msg_type, message)
        try:
            route = None if fields is None else PATH.value(*fields)
            if route is not None:
                self._progress = PathProgress(Path(np.array(route.poses)))
        except (MessageError, ValueError):
            self.note(f'{self._path}: no path')
        else:
            self.note(f'{self._path}: a path')

    def _on_other(self, _: Any, __: Any) -> None:
        self._progress = None
        self.note('the path is replaced or canceled')

    def _on_motion(self, pose: Pose, _: Twist) -> None:
        progress, required = self._progress, self._required
        if progress is None:
            return
        if not math.isfinite(sum(pose)):
            self.found(f'{self._motion.topic}: {pose}; allowed: finite values')
            return
        progress.moved(pose)
        if progress.s >= required.after and not abs(progress.across) <= required.tolerance + ROUNDING:
            self.found(f'{self._where(progress)}; allowed: {required.tolerance:g} m from the path')
        self._reached |= progress.remaining <= required.tolerance + ROUNDING
        self._check(progress)
        self.note(self._motion.topic, ': ', pose)

    def _where(self, progress: PathProgress) -> str:
        if self._motion.pose is None:
            return f'there was no odometry on {self._motion.topic}'
        return (
            f'the robot is {abs(progress.across):.6g} m from the path and {progress.s:.6g} m along its '
            f'{progress.path.length:.6g} m: {self._motion.pose}'
        )

    def _check(self, progress: PathProgress) -> None:
        if not self._reached and self.seconds - self._since > self._required.within + ROUNDING:
            self.found(
                f'{self._required.within:g} s after the path was published {self._where(progress)}; '
                f'allowed: within {self._required.tolerance:g} m of its end'
            )

    def check(self) -> str | None:
        """Return what is violated; None: nothing."""
        if self._progress is not None:
            self._check(self._progress)
        return self._found

    def finish(self) -> str | None:
        """Return that the end of the path was not reached yet; None: it need not be, or was."""
        if self._progress is None or self._reached or math.isinf(self._required.within):
            return None
        return self.described(
            f'the run ended {self.seconds - self._since:g} s after the path was published, and '
            f'{self._where(self._progress)}; allowed: within {self._required.tolerance:g} m of its end. '
            f'Let it run for {self._required.within:g} s after the path'
        )
