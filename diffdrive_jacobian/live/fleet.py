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

"""Several robots side by side: their namespaces, where they start, and what they are sent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control import Path

SPACING = 0.5
"""Distance between two robots along y (m)."""
NAME = 'robot_'
"""Beginning of their names."""
PATTERN = f'^/{NAME}[0-9]+/'
"""Regular expression that finds their topics."""


@dataclass(frozen=True, slots=True)
class Member:
    """One robot of several."""

    namespace: str
    """`/`, or `/robot_1` and so on if there are several."""
    aside: float = 0.0
    """How far to the left of the first one it starts (m)."""

    def placed(self, robot_parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Return the parameters of virtual_robot for this robot: where it starts, and its frames."""
        if self.namespace == '/':
            return {**robot_parameters}
        frames = {name: f'{self.namespace[1:]}/{frame}' for name, frame in FRAMES.items()}
        return {**frames, **robot_parameters, 'y': robot_parameters.get('y', 0.0) + self.aside}

    def moved(self, goals: NDArray[np.float64] | Path, *, relative: bool) -> NDArray[np.float64] | Path:
        """Return what it is sent: goals, shape (n, 3), or a path, as far aside as it is."""
        if relative or not self.aside:
            return goals
        by = np.array([0.0, self.aside, 0.0])
        return Path(goals.poses + by, goals.times) if isinstance(goals, Path) else goals + by


FRAMES = {'odom_frame_id': 'odom', 'base_frame_id': 'base_link'}
"""Parameters of the frames of a robot, and what they are without a namespace."""


def members(count: int) -> list[Member]:
    """Return so many robots. One alone has no namespace."""
    if count == 1:
        return [Member('/')]
    return [Member(f'/{NAME}{index + 1}', SPACING * index) for index in range(count)]
