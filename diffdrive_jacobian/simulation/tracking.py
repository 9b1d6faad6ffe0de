"""Arms and mobile manipulators whose tip follows a straight line, sampled as a controller samples.

Source: document D, 4.1; documents A and C on damping and redundancy; MATH.md, "Control laws".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.control.resolved_rate import StraightLine, resolved_rate
from diffdrive_jacobian.kinematics._checks import array, leading, not_negative, number, positive
from diffdrive_jacobian.kinematics.inverse_velocity import damping as damping_factor
from diffdrive_jacobian.kinematics.inverse_velocity import manipulability

Array = NDArray[np.float64]
MAX_STEPS = 1e8


class Manipulator(Protocol):
    """What is needed of a robot: `PlanarArm` and `MobileManipulator` have it."""

    def forward_kinematics(self, q: ArrayLike) -> Array:
        """Give the tip's `[x, y, heading]`, shape (..., 3)."""

    def jacobian(self, q: ArrayLike) -> Array:
        """Give the Jacobian of the tip's position, shape (..., 2, n)."""

    def integrate(self, q: ArrayLike, q_dot: ArrayLike, dt: ArrayLike) -> Array:
        """Give the configuration after a time with these velocities."""


class Tracking(NamedTuple):
    """How a line was followed, at k + 1 samples.

    Attributes:
        times: Shape (k + 1,) (s).
        q: Configurations, shape (k + 1, ..., n).
        q_dot: Velocities held from each sample to the next, shape (k, ..., inputs) (rad/s).
        error: Distance of the tip from where it should be, shape (k + 1, ...) (m).
    """

    times: Array
    q: Array
    q_dot: Array
    error: Array


def track_line(
    robot: Manipulator,
    q0: ArrayLike,
    line: StraightLine,
    *,
    rate: float = 100.0,
    gain: float = 20.0,
    threshold: float | None = None,
    maximum_damping: float = 0.1,
    secondary: Callable[[Array], ArrayLike] | None = None,
    settling: float = 0.0,
) -> Tracking:
    """Follow a straight line by resolved rate, damped where the Jacobian is nearly singular.

    The feedback adds no more than the speed of the line, so that `|q_dot| <= speed / lambda` with the
    damping lambda of the moment.

    Args:
        robot: The arm or the mobile manipulator.
        q0: Configurations at the start, shape (..., n).
        line: Where the tip is to be, a `control.StraightLine`; leading axes as those of q0.
        rate: How often velocities are computed; each is held until the next (Hz).
        gain: K of the feedback (1/s); below the rate.
        threshold: Manipulability below which damping sets in; None: never, and near a singularity the
            joints race.
        maximum_damping: lambda of a singular Jacobian.
        secondary: Gives, for configurations, joint velocities that are wished for besides.
        settling: How long to go on when the line has ended (s).

    Returns:
        Everything at each sample. An error that stays is the price of damping, or of a line that leaves
        what the robot can reach.

    Raises:
        ValueError: Rate, threshold or speed is not positive, another number negative, the gain not below
            the rate, or a shape is wrong.

    A tip that is far from the axle, on a mobile base, needs a higher rate: the wheels then swing it.
    """
    rate = number('rate', rate, positive)
    settling = number('settling', settling, not_negative)
    gain = number('gain', gain, not_negative)
    if gain >= rate:
        raise ValueError(f'gain must be at least 0 and below the rate {rate:g}, got {gain:g}')
    if not rate * (float(np.max(line.duration, initial=0.0)) + settling) < MAX_STEPS:
        raise ValueError(f'rate must make fewer than {MAX_STEPS:g} samples of the line, got {rate:g}')
    steps = math.ceil(rate * (float(np.max(line.duration, initial=0.0)) + settling) - 1e-9)
    most = number('maximum_damping', maximum_damping, not_negative)
    if threshold is not None:
        threshold = number('threshold', threshold, positive)
    q = array('q0', q0, 'n')
    if not isinstance(line, StraightLine):
        raise ValueError(f'line must be a control.StraightLine, got {line!r:.60}')
    if line.start.shape[-1] != 2:
        raise ValueError(f'line must have 2 coordinates, got {line.start.shape[-1]}')
    leading(q0=q.shape[:-1], line=line.duration.shape)
    inputs = robot.jacobian(q).shape[-1]
    track: list[Array] = []
    velocities: list[Array] = []
    errors: list[Array] = []
    for step in range(steps + 1):
        x = robot.forward_kinematics(q)[..., :2]
        wanted = line.position(step / rate)
        track.append(q)
        errors.append(np.asarray(np.linalg.norm(wanted - x, axis=-1)))
        if step == steps:
            break
        J = robot.jacobian(q)
        factor: ArrayLike = 0.0
        if threshold is not None:
            factor = damping_factor(manipulability(J), threshold, most)
        wish = None if secondary is None else secondary(q)
        # What moves the target to its next sample, also in the period in which the line ends.
        moving = (line.position((step + 1) / rate) - wanted) * rate
        velocities.append(
            resolved_rate(J, x, wanted, moving, gain, factor, wish, max_correction=line.speed)
        )
        q = robot.integrate(q, velocities[-1], 1.0 / rate)
    shape = np.broadcast_shapes(track[0].shape, track[-1].shape)
    track[0] = np.broadcast_to(track[0], shape)
    return Tracking(
        np.arange(steps + 1) / rate,
        np.array(track),
        np.array(velocities) if steps else np.empty((0, *shape[:-1], inputs)),
        np.array(errors),
    )
