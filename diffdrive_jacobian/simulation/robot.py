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

"""The virtual robot as an immutable value: a unicycle whose motion is a function of its commands.

State at a time: pose `[x, y, theta]` (m, m, rad) with its covariance, wheel angles `[right, left]`
(rad), and the body twist `[v, omega]` (m/s, rad/s) from that time on. Input: twist commands with their
timestamps. Times are integer nanoseconds, so that Unix time loses no precision.

The state is stored at the last event (command, timeout, placement). Every later state is computed from
it along one exact arc, or with `actuators` that take time along the `Drive` that began with that event.
So the states of one robot do not depend, to the last bit, on which of them were computed. A robot that
`at` returns begins its arc at that time, and rounds otherwise. The pose is that of the
odometry. With a `drift` in its model the robot is truly elsewhere, at `true_pose`.

Source: doc/mathematics.md, "Motion".
"""

from __future__ import annotations

from math import inf, isfinite
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics.se2 import compose
from diffdrive_jacobian.numerics.checks import (
    MAX_NANOSECONDS,
    instance,
    nanoseconds,
    number,
    pair,
    positive,
    read_only,
    triple,
)
from diffdrive_jacobian.simulation.actuators import STANDSTILL as STANDSTILL
from diffdrive_jacobian.simulation.actuators import Drive, WheelSpeeds
from diffdrive_jacobian.simulation.exact_moments import Entries, Moments, gaussian, propagated_moments
from diffdrive_jacobian.simulation.odometry_noise import twist_covariance
from diffdrive_jacobian.simulation.quadrature_moments import moments_along
from diffdrive_jacobian.simulation.robot_model import RobotModel as RobotModel
from diffdrive_jacobian.simulation.robot_model import Steady
from diffdrive_jacobian.simulation.slip import Truth
from diffdrive_jacobian.simulation.speeds import Piece, Pose, Profile, Twist, arc_end, displaced
from diffdrive_jacobian.time_units import NANOSECONDS

_CERTAIN = read_only(np.zeros((3, 3)))


class State(NamedTuple):
    """What is known of a robot at a time."""

    pose: Pose
    wheel_angles: tuple[float, float]
    """Right, left (rad)."""
    moments: Entries | None
    """Moments of the error of the pose; None: they have overflowed."""
    truth: Truth | None
    """None: the pose is the true one."""


def _field(name: str, doc: str) -> Any:
    """Return a read-only property, without the cost of a function."""
    return property(attrgetter(name), doc=doc)


class Robot:
    """A robot at a time. Every method returns a new one; none reads a clock.

    Raises:
        ValueError: A value is of another class or shape or not finite, the covariance is not symmetric
            and positive semidefinite, or a time is not an integer.
    """

    _model: RobotModel
    _stamp: int
    _state: State
    _command: Twist
    _twist: Twist
    _commanded_at: int | None
    _expiry: int | None
    _drive: Drive | None
    _steady: Steady | None
    _ahead: tuple[int, State] | None
    _knot: tuple[float, State] | None
    __slots__ = tuple(__annotations__)

    def __init__(
        self,
        *,
        model: RobotModel,
        stamp: int,
        pose: ArrayLike,
        covariance: ArrayLike = _CERTAIN,
        wheel_angles: ArrayLike = (0.0, 0.0),
        command: ArrayLike = STANDSTILL,
        twist: ArrayLike = STANDSTILL,
        commanded_at: int | None = None,
    ) -> None:
        """Check every value. The methods below do not check again what they return.

        Args:
            model: The parameters.
            stamp: Time of this state (ns).
            pose: `[x, y, theta]`, shape (3,) (m, m, rad).
            covariance: Covariance of a Gaussian error of the pose, shape (3, 3).
            wheel_angles: `(right, left)` (rad).
            command: The last commanded twist, `(v, omega)` (m/s, rad/s).
            twist: The applied twist.
            commanded_at: Time at which the command took effect (ns); None: it is zero.
        """
        instance('model', model, RobotModel)
        stamp, place = nanoseconds('stamp', stamp), triple('pose', pose)
        angles, moments = pair('wheel_angles', wheel_angles), tuple(gaussian(covariance))
        commanded, applied = pair('command', command), pair('twist', twist)
        if commanded_at is not None:
            commanded_at = nanoseconds('commanded_at', commanded_at)
            if commanded_at > stamp:
                raise ValueError(f'commanded_at must be at most the stamp, {stamp}, got {commanded_at}')
        state = State(place, angles, moments, _truth(model, place))
        self._start(model, stamp, state, commanded, applied, commanded_at)

    def _start(
        self,
        model: RobotModel,
        stamp: int,
        state: State,
        command: Twist,
        twist: Twist,
        commanded_at: int | None = None,
        drive: Drive | None = None,
        steady: Steady | None = None,
    ) -> Robot:
        """Set all values, which were checked. Returns this robot."""
        self._model, self._stamp, self._state = model, stamp, state
        self._command, self._twist, self._commanded_at = command, twist, commanded_at
        self._expiry = None
        if commanded_at is not None and model.command_timeout:
            # If the timeout was shortened, it expires now, not in the past.
            expiry = commanded_at + model.command_timeout
            self._expiry = expiry if expiry > stamp else stamp
        # None: the twist is held until the next event.
        self._drive = drive
        if drive is None and model.drift is not None:
            self._drive = Drive.at(stamp, twist)
        # What the twist implies without a drive. None: it was not needed yet.
        self._steady = steady
        # The last state that was computed from this one, because often the same one is needed next; and
        # where the last state that was computed along the drive begins (s), and the state there.
        self._ahead = self._knot = None
        return self

    def __repr__(self) -> str:
        """Return the values, without the rest of a motion that takes time, as a constructor call."""
        names = (
            'model',
            'stamp',
            'pose',
            'covariance',
            'wheel_angles',
            'command',
            'twist',
            'commanded_at',
        )
        return f'Robot({", ".join(f"{name}={getattr(self, name)!r}" for name in names)})'

    model: RobotModel = _field('_model', 'The parameters.')
    stamp: int = _field('_stamp', 'Time of this state (ns).')
    command: Twist = _field('_command', 'The last commanded twist, `(v, omega)`.')
    commanded_at: int | None = _field(
        '_commanded_at', 'Time at which the command took effect (ns); None: it is zero.'
    )
    target: Twist = _field(
        '_twist',
        'The twist to reach: the command within the velocity limits, and of a robot that follows '
        'at once as far as its motors reach it.',
    )
    expiry: int | None = _field(
        '_expiry',
        'Time at which the timeout stops the robot (ns); None: it is not moving, or has no timeout.',
    )

    @property
    def pose(self) -> NDArray[np.float64]:
        """`[x, y, theta]`, shape (3,), read-only. `pose_tuple` has the same numbers without an array."""
        return read_only(self._state.pose)

    pose_tuple: Pose = _field('_state.pose', '`(x, y, theta)`, the pose as floats (m, m, rad).')

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Second moment of the error of `pose`, shape (3, 3), read-only: `E[(q - pose) (q - pose)^T]`.

        q is the true pose, in world coordinates, the heading unwrapped. It is exact under the noise
        model (see `exact_moments`), and not the covariance about the mean, which is off the reported
        pose.

        Raises:
            ValueError: It overflows.
        """
        return read_only(np.reshape(self.covariance_tuple, (3, 3)))

    @property
    def covariance_tuple(self) -> tuple[float, ...]:
        """The nine entries of the covariance by rows, as floats.

        Raises:
            ValueError: The covariance overflows.
        """
        xx, xy, xt, yy, yt, tt, *_ = self._state.moments or self._finite_moments()
        return xx, xy, xt, xy, yy, yt, xt, yt, tt

    @property
    def moments(self) -> Moments:
        """Moments of the error of the pose, from which its later uncertainty follows.

        Raises:
            ValueError: They overflow.
        """
        return Moments(*self._finite_moments())

    def _finite_moments(self) -> Entries:
        moments = self._state.moments
        if moments is None:
            raise ValueError('twist and time must give a finite result, but it overflows')
        return moments

    wheel_angles: WheelSpeeds = _field('_state.wheel_angles', '`(right, left)`, unwrapped (rad).')

    @property
    def twist(self) -> Twist:
        """The twist `(v, omega)` of the odometry at this time."""
        drive = self._drive
        return self._twist if drive is None else drive.motion.twist(drive.motion.seconds(self._stamp))

    @property
    def settles_at(self) -> int:
        """Time from which on the twist is constant without a further event (ns)."""
        drive = self._drive
        return self._stamp if drive is None else max(self._stamp, drive.motion.settled_at)

    @property
    def true_pose_tuple(self) -> Pose:
        """`(x, y, theta)` of the true pose (m, m, rad); without drift that of the odometry."""
        truth = self._state.truth
        return self._state.pose if truth is None else truth.pose

    @property
    def true_pose(self) -> NDArray[np.float64]:
        """`[x, y, theta]` of the true pose, shape (3,)."""
        return np.array(self.true_pose_tuple)

    @property
    def true_twist(self) -> Twist:
        """The true twist `(v, omega)` from this time on, the slip included (m/s, rad/s)."""
        truth, drive = self._state.truth, self._drive
        if truth is None or drive is None:
            return self.twist
        L, k = self._model.wheel_separation, self._model.wheel_travel_variance
        return truth.twist(drive.motion, self._stamp, L, k)

    @property
    def wheel_speeds(self) -> WheelSpeeds:
        """`(omega_R, omega_L)` (rad/s), by the inverse wheel Jacobian."""
        if self._drive is None:
            return (self._steady or self._find_steady()).wheel_speeds
        return self._model.wheel_speeds(*self.twist)

    def _find_steady(self) -> Steady:
        self._steady = steady = self._model.steady(self._twist)
        return steady

    def twist_covariance(self, interval: float) -> NDArray[np.float64]:
        """Compute the covariance of the twist as measured over an interval (s), shape (2, 2).

        Raises:
            ValueError: The interval is not positive and finite, or the result overflows.
        """
        return np.array(self.twist_covariance_tuple(interval)).reshape(2, 2)

    def twist_covariance_tuple(self, interval: float) -> tuple[float, float, float, float]:
        """Return the four entries of `twist_covariance` by rows, as floats.

        Raises:
            ValueError: As `twist_covariance`.
        """
        if not (type(interval) is float and 0.0 < interval < inf):
            interval = number('interval', interval, positive)
        if self._drive is None:
            vv, vw, ww = (self._steady or self._find_steady()).densities
            vv, vw, ww = vv / interval, vw / interval, ww / interval
        else:
            L, k = self._model.wheel_separation, self._model.wheel_travel_variance
            (vv, vw), (_, ww) = twist_covariance.floats(self.twist, L, k, interval)
        if not isfinite(vv + abs(vw) + ww):
            raise ValueError('twist and interval must give a finite result, but it overflows')
        return vv, vw, vw, ww

    def at(self, stamp: int) -> Robot:
        """Advance to a time (ns), through the timeout if it expires before.

        Raises:
            ValueError: The time is earlier than this state, is not an integer, or so late that the
                motion overflows.
        """
        stamp, robot, state = self._advanced(stamp)
        return robot._with(stamp, state)

    def commanded(self, command: ArrayLike, stamp: int) -> Robot:
        """Apply a command `[v, omega]`, shape (2,) (m/s, rad/s), from a time (ns) on, within the limits.

        Raises:
            ValueError: The command has another shape or is not finite; or as `at`.
        """
        command, model = pair('command', command), self._model
        twist = command if model.limits.unlimited else model.limited(command)
        stamp, robot, state = self._advanced(stamp)
        commanded_at = None if command == STANDSTILL else stamp
        return robot._following(model, stamp, state, command, twist, commanded_at)

    def placed(
        self, pose: ArrayLike, covariance: ArrayLike, stamp: int, *, odometry_only: bool = False
    ) -> Robot:
        """Restart at a pose, with the same command and wheel angles.

        Args:
            pose: `[x, y, theta]`, shape (3,) (m, m, rad).
            covariance: Its covariance, shape (3, 3). The error is taken for Gaussian.
            stamp: The time (ns).
            odometry_only: Whether the robot stays where it truly is. Otherwise this becomes the true
                pose, too.

        Raises:
            ValueError: The pose or the covariance is invalid, as in the constructor; or as `at`.
        """
        here = self.at(stamp)
        place, moments = triple('pose', pose), tuple(gaussian(covariance))
        state = here._state._replace(pose=place, moments=moments)
        if not odometry_only:
            state = state._replace(truth=_truth(self._model, place))
        return here._with(here._stamp, state)

    def reported(self, pose: Pose, wheel_angles: WheelSpeeds, twist: Twist) -> Robot:
        """Return this robot as its sensors report it, with its covariance and its true pose.

        It is for one message: its twist is the reported one, also as `true_twist`, and is held.

        Raises:
            ValueError: An argument has another shape or is not finite.
        """
        state = self._state._replace(
            pose=triple('pose', pose), wheel_angles=pair('wheel_angles', wheel_angles)
        )
        twist = pair('twist', twist)
        return object.__new__(Robot)._start(
            self._model, self._stamp, state, self._command, twist, self._commanded_at
        )

    def pushed(self, displacement: ArrayLike, stamp: int, *, noticed: bool = False) -> Robot:
        """Displace the robot without turning its wheels, with the same command.

        Args:
            displacement: `[dx, dy, dtheta]` in the body frame, shape (3,) (m, m, rad).
            stamp: The time (ns).
            noticed: Whether the odometry follows, as if corrected by a localisation, with the covariance
                that it had. Otherwise only the true pose changes, and the model must have a `drift`.

        Raises:
            ValueError: The displacement has another shape or is not finite, the pose overflows, the
                model has no drift; or as `at`.
        """
        displacement = triple('displacement', displacement)
        here = self.at(stamp)
        if here._model.drift is None and not noticed:
            raise ValueError('model must have a drift: without one the odometry is the true pose')
        moved = triple('pose', compose(here.true_pose_tuple, displacement))
        if noticed:
            seen = compose(here.pose_tuple, displacement)
            here = here.placed(seen, here.covariance, here._stamp, odometry_only=True)
        truth = here._state.truth
        truth = None if truth is None else truth.moved(moved)
        return here._with(here._stamp, here._state._replace(truth=truth))

    def remodelled(self, model: RobotModel, stamp: int, *, wheels_commanded: bool = False) -> Robot:
        """Change the model. Its limits and timeout apply to the current command.

        With `wheels_commanded` the command was one of wheel speeds. Then these are kept, and the twist
        changes with the wheels.

        Raises:
            ValueError: The model is of another class; or as `at`.
        """
        instance('model', model, RobotModel)
        here = self.at(stamp)
        command = here._command
        if wheels_commanded:
            command = model.twist(*self._model.wheel_speeds(*command))
        limited = model.limited(command)
        truth = here._state.truth
        if truth is None or model.drift is None:
            truth = _truth(model, here._state.pose)
        else:
            truth = truth.with_drift(model.drift)
        state = here._state._replace(truth=truth)
        return here._following(model, here._stamp, state, command, limited, here._commanded_at)

    def restarted(self, stamp: int) -> Robot:
        """Stop at the same pose, at a time that may be earlier.

        Raises:
            ValueError: The time is not an integer (ns).
        """
        stamp = nanoseconds('stamp', stamp)
        truth = self._state.truth
        state = self._state._replace(truth=None if truth is None else truth.at_rest())
        return object.__new__(Robot)._start(self._model, stamp, state, STANDSTILL, STANDSTILL)

    def _with(self, stamp: int, state: State) -> Robot:
        """Return the robot in another state, with the same motion."""
        motion = self._command, self._twist, self._commanded_at, self._drive, self._steady
        return object.__new__(Robot)._start(self._model, stamp, state, *motion)

    def _following(
        self,
        model: RobotModel,
        stamp: int,
        state: State,
        command: Twist,
        target: Twist,
        commanded_at: int | None,
    ) -> Robot:
        """Return the robot in a state, from now on following a command within the limits, `target`."""
        actuators = model.actuators
        if actuators.immediate:
            twist = actuators.reached(target, model) if actuators.weak else target
            drive = self._drive
            if drive is not None and not (model.drift and drive.motion.holds(twist, stamp)):
                drive = None
            return object.__new__(Robot)._start(model, stamp, state, command, twist, commanded_at, drive)
        drive = self._drive or Drive.at(stamp, self._twist)
        drive = drive.followed(stamp, target, actuators, model)
        return object.__new__(Robot)._start(model, stamp, state, command, target, commanded_at, drive)

    def _advanced(self, stamp: int) -> tuple[int, Robot, State]:
        """Return a time (ns), the robot after its last event before it, and the state at that time.

        Raises:
            ValueError: As `at`.
        """
        if type(stamp) is not int or stamp > MAX_NANOSECONDS:
            stamp = nanoseconds('stamp', stamp)
        if stamp < self._stamp:
            raise ValueError(f'stamp cannot go back from {self._stamp} ns to {stamp} ns')
        robot, expiry = self, self._expiry
        if expiry is not None and expiry <= stamp:
            state = self._state_at(expiry)
            robot = self._following(self._model, expiry, state, STANDSTILL, STANDSTILL, None)
        return stamp, robot, robot._state_at(stamp)

    def _state_at(self, stamp: int) -> State:
        """Compute the state at a time up to the timeout."""
        if self._ahead is not None and self._ahead[0] == stamp:
            return self._ahead[1]
        if stamp == self._stamp:
            return self._state
        if self._drive is not None:
            state = self._driven(self._drive.motion, stamp)
        elif self._twist != STANDSTILL:
            dt = (stamp - self._stamp) / NANOSECONDS
            state = _after_arc(self._state, self._twist, self._steady or self._find_steady(), dt)
        else:
            state = self._state
        self._ahead = stamp, state
        return state

    def _driven(self, motion: Profile, stamp: int) -> State:
        """Compute the state at a time up to the timeout, along a motion."""
        time, end = motion.seconds(self._stamp), motion.seconds(stamp)
        state = self._state
        if self._knot is not None and self._knot[0] <= end:
            time, state = self._knot
        for piece, limit in motion.steps(time, end):
            if limit == end:
                # The state may be asked for again at a later time.
                self._knot = time, state
            state, time = self._after_step(state, piece), limit
        truth = self._state.truth
        if truth is not None:
            L, k = self._model.wheel_separation, self._model.wheel_travel_variance
            truth = truth.after(motion, self._stamp, stamp, L, k)
        return state._replace(truth=truth)

    def _after_step(self, state: State, piece: Piece) -> State:
        """Compute the state after a step of a drive; the truth is left out."""
        model, dt = self._model, piece.seconds
        if piece.constant:
            twist = piece.twist(0.0)
            return state if twist == STANDSTILL else _after_arc(state, twist, model.steady(twist), dt)
        pose, (right, left), moments, truth = state
        L, k = model.wheel_separation, model.wheel_travel_variance
        turned_R, turned_L = model.wheel_speeds(piece.v.travelled(dt), piece.omega.travelled(dt))
        if moments is not None:
            moments = moments_along(moments, pose[2], piece, dt, L, k)
        pose = displaced(pose, piece.displacement(dt))
        return State(pose, (right + turned_R, left + turned_L), moments, truth)


def _after_arc(state: State, twist: Twist, steady: Steady, dt: float) -> State:
    """Compute the state after a time (s) with a constant twist; the truth is left out."""
    pose, angles, moments, truth = state
    omega_R, omega_L = steady.wheel_speeds
    right, left = angles[0] + omega_R * dt, angles[1] + omega_L * dt
    # A finite sum has finite terms.
    if not (isfinite(right + left) or (isfinite(right) and isfinite(left))):
        raise ValueError(f'wheel_angles must be finite, got {[right, left]}')
    if moments is not None:
        moments = propagated_moments(moments, pose[2], twist, steady.densities, dt)
    return State(arc_end(pose, twist, dt), (right, left), moments, truth)


def _truth(model: RobotModel, pose: Pose) -> Truth | None:
    """Return the truth of a robot whose pose is the true one; None: its model has no drift."""
    return None if model.drift is None else Truth(model.drift, pose)
