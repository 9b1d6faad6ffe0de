"""How far a robot is along a path, and how far from it, as seen by somebody who does not drive it."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, nan
from typing import Any

import numpy as np

from diffdrive_jacobian.control.path import Path


@dataclass(slots=True)
class PathProgress:
    """The progress of a robot along a path."""

    path: Path
    s: float = 0.0
    """Arc length of the point nearest to the robot (m)."""
    across: float = 0.0
    """Distance from that point, positive to the left of the path (m)."""
    heading: float = 0.0
    """Heading of the robot minus that of the path there (rad)."""
    greatest: float = nan
    """Greatest absolute distance so far (m); NaN: no pose was taken."""

    def moved(self, pose: Any) -> None:
        """Take a pose of the robot, `[x, y, theta]` (m, m, rad)."""
        self.s = self.path.nearest(pose[0], pose[1], self.s)
        errors = Path.errors(pose, self.path.at(self.s, 0.0))
        self.across, self.heading = float(errors.across), float(errors.heading)
        self.greatest = float(np.fmax(self.greatest, abs(self.across)))

    @property
    def remaining(self) -> float:
        """Arc length to the end and distance from the path together, as in a right triangle (m)."""
        return hypot(self.path.length - self.s, self.across)
