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

"""Conversion between ROS messages and the quantities of the mathematics.

Poses are `[x, y, theta]` (m, m, rad), twists `(v, omega)` (m/s, rad/s), times integer nanoseconds.
Wheels are ordered left, right in messages, as is usual in ROS, and right, left in the mathematics:
`from_joints` and the values of `messages.codecs` convert between these orders.

The `set_` functions fill an existing message. The `from_` functions take the fields of a message and
check them. They raise MessageError, which reports the value and the range allowed. Which fields these
are is said in `messages.codecs`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import NANOSECONDS, seconds

if TYPE_CHECKING:
    import numpy as np
    from builtin_interfaces.msg import Time
    from geometry_msgs.msg import Pose
    from numpy.typing import ArrayLike, NDArray


class MessageError(DiffdriveError, ValueError):
    """A message with invalid content."""


MAX_SPEED = 1e3
"""Largest plausible speed (m/s) and yaw rate (rad/s)."""
MAX_POSITION = 1e6
"""Largest plausible coordinate of a position (m)."""
MAX_WHEEL_SPEED = 1e6
"""Largest plausible wheel speed (rad/s). It corresponds to `MAX_SPEED` at the smallest wheel radius that
the nodes accept, 1e-3 m."""


SMALLEST = sys.float_info.min
"""Smallest positive normal number. No speed or position is that small but zero."""
MAX_WAYPOINTS = 2_000
"""Largest number of poses in a `goals` message, which take 40 ms to read."""
MAX_PATH_POSES = 10_000
"""Largest number of poses in a `path` message, which take 0.15 s to read. At the 5 cm of common planners
this is a path of 500 m."""


def integer_warning(what: str, *values: float) -> str:
    """Return a warning if a value is below `SMALLEST`: an integer that was assigned to a float field."""
    for value in values:
        if value and -SMALLEST < value < SMALLEST:
            return (
                f'{what} has the value {value:.3g}: was an int assigned to a float field? Assign 1.0 '
                'instead of 1 (with ROS_PYTHON_CHECK_FIELDS=1 rclpy reports it to the sender)'
            )
    return ''


def quoted(texts: Iterable[str], most: int = 4) -> str:
    """Return texts of unknown origin as a list of limited length, for an error message."""
    texts = list(texts)
    shown = [f"'{printable(text)}'" for text in texts[:most]]
    if len(texts) > most:
        shown.append(f'... ({len(texts)} in all)')
    return f'[{", ".join(shown)}]'


def set_time(stamp: Time, nanoseconds: int) -> None:
    """Write a time (ns) into a stamp."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, NANOSECONDS)


def from_time(sec: int, nanosec: int) -> int:
    """Return the time of a stamp (ns).

    Raises:
        MessageError: `sec` is negative, or `nanosec` is a second or more.
    """
    if sec < 0 or nanosec >= NANOSECONDS:
        raise MessageError(
            'its stamp must have sec of at least 0 and nanosec below 1000000000, '
            f'got sec {sec}, nanosec {nanosec}'
        )
    return sec * NANOSECONDS + nanosec


def command_time(stamp: int, now: int, last: int, timeout: int) -> int:
    """Return when a velocity command takes effect (ns): at its stamp, without one at its receipt.

    Args:
        stamp: Stamp of the command (ns); 0: none.
        now: Current time (ns).
        last: Time at which the last command took effect (ns).
        timeout: Largest age of a command (ns); 0: no limit.

    Raises:
        MessageError: The stamp is in the future, older than the last command or older than the timeout.
    """
    if stamp == 0:
        return now
    if stamp > now:
        raise MessageError(f'its stamp is {seconds(stamp - now):.6f} s in the future')
    if timeout and now - stamp > timeout:
        raise MessageError(
            f'its stamp is {seconds(now - stamp):.6f} s old, more than the timeout of '
            f'{seconds(timeout):g} s'
        )
    if stamp < last:
        raise MessageError(
            f'its stamp is {seconds(last - stamp):.6f} s older than the last command, stop, reset of '
            'the pose or change of parameters'
        )
    return stamp


def from_twist(
    x: float, y: float, z: float, roll: float, pitch: float, yaw: float
) -> tuple[float, float]:
    """Return `(v, omega)` (m/s, rad/s) from the linear and the angular components; others are ignored.

    Raises:
        MessageError: A component is NaN or infinite, or v or omega is out of range.
    """
    # A sum that is finite has finite terms.
    if not math.isfinite(x + y + z + roll + pitch + yaw):
        linear, angular = (x, y, z), (roll, pitch, yaw)
        if not all(map(math.isfinite, linear + angular)):
            raise MessageError(f'twist must be finite, got linear {linear}, angular {angular}')
    if abs(x) <= MAX_SPEED and abs(yaw) <= MAX_SPEED:
        return x, yaw
    return plausible_twist(x, yaw)


def plausible_twist(v: float, omega: float) -> tuple[float, float]:
    """Return a twist unchanged if it is plausible.

    Raises:
        MessageError: v or omega is not finite or exceeds `MAX_SPEED`.
    """
    if not (abs(v) <= MAX_SPEED and abs(omega) <= MAX_SPEED):
        raise MessageError(
            f'twist must be within {MAX_SPEED:g} m/s and {MAX_SPEED:g} rad/s, '
            f'got v {v:g}, omega {omega:g}'
        )
    return v, omega


def from_pose(
    x: float, y: float, qx: float, qy: float, qz: float, qw: float
) -> tuple[float, float, float]:
    """Return `(x, y, theta)` (m, m, rad) from x, y and the quaternion x, y, z, w.

    Raises:
        MessageError: The position is not finite or out of range, or the quaternion is not of unit
            length.
    """
    if not (abs(x) <= MAX_POSITION and abs(y) <= MAX_POSITION):
        raise MessageError(
            f'position must be finite and within {MAX_POSITION:g} m, got x {x:g}, y {y:g}'
        )
    norm = math.hypot(qx, qy, qz, qw)
    if not 0.9 <= norm <= 1.1:
        raise MessageError(
            'orientation must be a quaternion of length 1 (0.9 to 1.1), '
            f'got x {qx:g}, y {qy:g}, z {qz:g}, w {qw:g}'
        )
    sine, cosine = 2.0 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2
    return x, y, math.atan2(sine, cosine)


def set_pose(message: Pose, pose: NDArray[np.float64]) -> None:
    """Write `[x, y, theta]` into a pose."""
    x, y, theta = pose.tolist()
    message.position.x, message.position.y = x, y
    message.orientation.z, message.orientation.w = math.sin(theta / 2.0), math.cos(theta / 2.0)


def from_joints(
    joints: Sequence[str], velocities: Sequence[float], names: tuple[str, str]
) -> tuple[float, float]:
    """Return `(omega_R, omega_L)` (rad/s).

    Args:
        joints: Names of the joints of a message.
        velocities: Their velocities (rad/s).
        names: Names of the left and the right wheel joint.

    Raises:
        MessageError: A joint is missing, has no velocity, or its velocity is not finite or out of range.
    """
    if len(velocities) != len(joints):
        raise MessageError(
            f'it must have a velocity for each joint, got {len(joints)} joints and '
            f'{len(velocities)} velocities'
        )
    speeds = dict(zip(joints, velocities, strict=True))
    if any(joints.count(name) != 1 for name in names):
        raise MessageError(f'it must name each of {quoted(names)} once, got {quoted(joints)}')
    left, right = (speeds[name] for name in names)
    if not (math.isfinite(left) and math.isfinite(right)):
        raise MessageError(f'wheel speeds must be finite, got left {left}, right {right}')
    if max(abs(left), abs(right)) > MAX_WHEEL_SPEED:
        raise MessageError(
            f'wheel speeds must be within {MAX_WHEEL_SPEED:g} rad/s, got left {left:g}, right {right:g}'
        )
    return right, left


def from_covariance(covariance: ArrayLike) -> NDArray[np.float64]:
    """Return a covariance of x, y and yaw, shape (3, 3), from its nine entries, row by row.

    Raises:
        MessageError: It is not finite, symmetric and positive semidefinite.
    """
    import numpy as np

    matrix = np.reshape(covariance, (3, 3))
    scale = np.abs(matrix).max()
    valid = scale <= MAX_POSITION**2 and np.abs(matrix - matrix.T).max() <= 1e-9 * scale
    if valid:
        symmetric = (matrix + matrix.T) / 2.0
        values, vectors = np.linalg.eigh(symmetric)
        valid = values[0] >= -1e-9 * scale
    if not valid:
        raise MessageError(
            f'covariance of x, y, yaw must be finite, at most {MAX_POSITION**2:g}, symmetric and '
            'positive semidefinite, '
            f'got {matrix.tolist()}'
        )
    if values[0] < 0.0:
        # Rounding of the sender: as the motion grows, so would a negative variance.
        symmetric = vectors * np.maximum(values, 0.0) @ vectors.T
    return np.asarray((symmetric + symmetric.T) / 2.0)
