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

"""A drive with the page, which nodes or values do."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Path
from diffdrive_jacobian.live.fleet import Member, members
from diffdrive_jacobian.live.robot_state import GoalEnd
from diffdrive_jacobian.live.server import Ready
from diffdrive_jacobian.live.session import Share
from diffdrive_jacobian.live.steered_robot import SteeredRobot
from diffdrive_jacobian.recording.recording import Recording
from diffdrive_jacobian.signals import Signals


@dataclass(frozen=True, kw_only=True, slots=True)
class PageDrive:
    """What drives, where to, and who is told. It drives until a signal comes."""

    goals: NDArray[np.float64] | Path
    """`[x, y, theta]` of goals that are sent when a page is open, shape (n, 3), n may be 0 (m, m, rad).
    Or a path."""
    relative: bool = False
    """Whether they are in the body frame of the robot where it is then."""
    lockstep: bool
    """Whether time is simulated. The page then has pause, step and speed."""
    isolated: bool
    """Whether no other process can communicate with the nodes."""
    parameters: Mapping[str, Any]
    """Parameters of go_to_goal."""
    robot_parameters: Mapping[str, Any]
    """Parameters of virtual_robot."""
    recording: Recording | None
    """Recording of what is published. The caller must finish it."""
    ros_arguments: Sequence[str]
    """ROS arguments of all nodes."""
    port: int
    """Port of the page, as for `watch_nodes`."""
    signals: Signals
    ready: Ready
    """Receives the server when it runs."""
    nodes_created: Callable[[Sequence[str]], None]
    """Receives the fully qualified names of the nodes."""
    goal_ended: Callable[[GoalEnd], None] | None = None
    """Receives the end of each goal or path."""
    robots: int = 1
    """How many robots there are, each with its bridge and its controller."""
    share: Share | None = None
    """Who else may look, as for `watch_nodes`."""

    @property
    def fleet(self) -> list[Member]:
        """The robots."""
        return members(self.robots)

    @property
    def sends(self) -> bool:
        """Whether goals or a path wait until a page is open."""
        return isinstance(self.goals, Path) or len(self.goals) > 0

    def send(self, robots: Mapping[str, SteeredRobot]) -> None:
        """Send goals or path to each of the robots, by its namespace."""
        for one in self.fleet:
            moved = one.moved(self.goals, relative=self.relative)
            robots[one.namespace].send(moved, relative=self.relative)
