"""A recorded run as NumPy arrays.

`print(run)` and `print(run.odometry)` give a summary; the numbers are in `run.odometry.values`, whose
columns are named in `run.odometry.columns`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.bags.bag_reader import BagError
from diffdrive_jacobian.messages.topics import TOPICS
from diffdrive_jacobian.time_units import NANOSECONDS

MAX_NUMBER = 1e6
"""Largest magnitude of the numeric parameters of our nodes (m, m/s, rad/s)."""
COLUMNS = {topic.series: topic.columns for topic in TOPICS.values() if topic.series}
"""Columns of the values of each series of a `Run`."""
_CONTROLLER = {'controller', 'use_goal_heading', 'xy_goal_tolerance'}
"""Parameters by which a go_to_goal of another name is known."""


@dataclass(frozen=True, kw_only=True, slots=True, repr=False)
class Series:
    """The messages of one topic in the order in which they were recorded; n may be 0."""

    received: NDArray[np.int64]
    """When each message was recorded, shape (n,) (ns)."""
    stamps: NDArray[np.int64]
    """The messages' own stamps, where they have one, else as `received`, shape (n,) (ns)."""
    values: NDArray[np.float64]
    """One row for each message, shape (n, k)."""
    columns: tuple[str, ...] = ()
    """Names of the k columns of `values`, as documented at the fields of `Run`."""

    def __len__(self) -> int:
        """Return n."""
        return len(self.stamps)

    def __repr__(self) -> str:
        """Return a summary of one line."""
        columns = ', '.join(self.columns) or f'{self.values.shape[1]} columns'
        text = f'{len(self)} message{"" if len(self) == 1 else "s"} of [{columns}]'
        if len(self):
            text += f', recorded over {float(np.ptp(self.received)) / NANOSECONDS:.3f} s'
        return f'Series({text})'


@dataclass(frozen=True, kw_only=True, slots=True, repr=False)
class Run:
    """A run. All series exist; those whose topic was not recorded are empty.

    Each series has the time of recording (`received`, ns), the messages' stamps (`stamps`, ns) and
    `values` with the columns that are given below.
    """

    path: Path
    odometry: Series
    """`[x, y, theta, v, omega]` of odom (m, m, rad, m/s, rad/s)."""
    ground_truth: Series
    """`[x, y, theta, v, omega]` of ground_truth, in its own frame (m, m, rad, m/s, rad/s)."""
    cmd_vel: Series
    """`[v, omega]` as commanded (m/s, rad/s); Twist or TwistStamped."""
    cmd_vel_out: Series
    """`[v, omega]` as applied, each from its stamp on (m/s, rad/s)."""
    start_pose: Series
    """`[x, y, theta]` where the odometry began, each at its stamp (m, m, rad)."""
    wheel_commands: Series
    """`[omega_R, omega_L]` of joint_command (rad/s)."""
    wheels: Series
    """`[omega_R, omega_L]` of joint_states (rad/s)."""
    goals: Series
    """`[x, y, theta]` of each goal and waypoint (m, m, rad)."""
    goal_status: Series
    """`[status]`, the numbers of action_msgs/GoalStatus, stamped as the goal."""
    odometry_covariances: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 9)))
    """Covariances in each message of odom as recorded, unchecked, shape (n, 9): the entries xx, xy, xt,
    yy, yt, tt of the pose's and vv, vw, ww of the twist's."""
    start_covariances: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 6)))
    """The entries xx, xy, xt, yy, yt, tt of the covariance in each start_pose, shape (n, 6)."""
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    """By the full name of the node, as of the beginning of the run."""
    parameter_events: tuple[tuple[int, str, dict[str, Any]], ...] = ()
    """Later changes: when each was recorded (ns), the node, the new values."""
    parameter_stamps: tuple[int, ...] = ()
    """The stamps of these changes (ns)."""
    fault_events: tuple[tuple[int, str, str], ...] = ()
    """What the faults of a lockstep world did: when it was recorded (ns), the fault, what it did."""
    skipped: dict[str, int] = field(default_factory=dict)
    """How many messages of a topic could not be used, by the topic's name in the bag."""
    notes: tuple[str, ...] = ()
    """What is wrong with the bag although it can be read, in words: messages that were skipped, and
    why, and messages that are missing."""

    def __repr__(self) -> str:
        """Return a summary of a few lines."""
        series = {one.name: getattr(self, one.name) for one in fields(self) if one.name in COLUMNS}
        lines = [f'Run({str(self.path)!r}:']
        lines += [f'  {name}: {str(one)[7:-1]}' for name, one in series.items() if len(one)]
        lines += [f'  parameters of {", ".join(self.parameters)}'] if self.parameters else []
        lines += [f'  {len(self.parameter_events)} changes of parameters'] * bool(self.parameter_events)
        lines += [f'  {len(self.fault_events)} events of faults'] * bool(self.fault_events)
        lines += [f'  {note}' for note in self.notes]
        return '\n'.join([*lines, ')'])

    def lacking(self, what: str) -> BagError:
        """Return the error that something was not found in the run, with the notes that may tell why."""
        return BagError('; '.join([f'{self.path} has no {what}', *self.notes]))

    def of_node(self, name: str) -> dict[str, Any]:
        """Return the parameters of the node of that base name; {} if there is none or several.

        A go_to_goal that was renamed is known by its parameters.
        """
        found = [values for node, values in self.parameters.items() if node.split('/')[-1] == name]
        if name == 'go_to_goal' and not found:
            found = [values for values in self.parameters.values() if values.keys() >= _CONTROLLER]
        return found[0] if len(found) == 1 else {}

    def configurations(self) -> Iterator[tuple[int, Run]]:
        """Yield the run with the parameters of each time, and since when they are valid (ns).

        Those of the beginning are valid since 0.
        """
        run, since = self, 0
        yield since, run
        for received, node, values in self.parameter_events:
            since = max(since, received)
            values = {**run.parameters.get(node, {}), **values}
            run = replace(run, parameters={**run.parameters, node: values})
            yield since, run

    def number_of_node(self, node: str, parameter: str, default: float) -> float:
        """Return a parameter of a node; `default` if it was not recorded or is not a finite number."""
        value = number(self.of_node(node).get(parameter))
        return value if math.isfinite(value) else default


def number(value: object) -> float:
    """Return a recorded parameter as a number; NaN: it is none, or beyond what the nodes accept."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= MAX_NUMBER:
        return math.nan
    return float(value)
