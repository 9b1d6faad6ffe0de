"""The virtual robot as an immutable value: a unicycle whose motion is a function of its commands.

State at a time: pose `[x, y, theta]` (m, m, rad) with its covariance, wheel angles `[right, left]`
(rad), and the body twist `[v, omega]` (m/s, rad/s) from that time on. Input: twist commands with their
timestamps. Times are integer nanoseconds, so that Unix time loses no precision.

The state is stored at the last event (command, timeout, placement). Every later state is computed from
it along one exact arc, so the motion does not depend, to the last bit, on when states are computed.

A state is computed in floats, its covariance when it is first read, and arrays whenever they are read. A
node that needs no arrays reads `pose_tuple` and `covariance_tuple`.

The pose is that of the odometry, computed from the turns of the wheels. The robot is truly there, unless
its model has a `drift`. `true_pose` is where it truly is.

With `actuators` that lag, the twist also changes between the events, at the end of each step of the lag
(`next_change`).

Source: doc/mathematics.md, "Motion".
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.kinematics.se2 import compose
from diffdrive_jacobian.numerics.checks import (
    MAX_NANOSECONDS,
    nanoseconds,
    number,
    numbers,
    positive,
    read_only,
)
from diffdrive_jacobian.numerics.fields import instance
from diffdrive_jacobian.simulation._uncertainty import Uncertainty
from diffdrive_jacobian.simulation.actuators import Settling, Speeds
from diffdrive_jacobian.simulation.arc import arc_end
from diffdrive_jacobian.simulation.exact_moments import Moments, gaussian
from diffdrive_jacobian.simulation.odometry_noise import twist_covariance
from diffdrive_jacobian.simulation.robot_model import RobotModel as RobotModel
from diffdrive_jacobian.simulation.robot_model import pair
from diffdrive_jacobian.simulation.slip import Truth
from diffdrive_jacobian.time_units import NANOSECONDS

STANDSTILL = (0.0, 0.0)
_CERTAIN = read_only(np.zeros((3, 3)))
_State: TypeAlias = tuple[tuple[float, float, float], tuple[float, float], Uncertainty, Truth | None]
"""Pose, wheel angles, uncertainty and truth at a time."""


class Robot:
    """A robot at a time. Every method returns a new one; none reads a clock.

    Raises:
        ValueError: A value is of another class or shape or not finite, the covariance is not symmetric
            and positive semidefinite, or a time is not an integer.
    """

    __slots__ = (
        *(
            '_model',
            '_stamp',
            '_pose',
            '_wheel_angles',
            '_command',
            '_twist',
            '_commanded_at',
            '_expiry',
        ),
        *('_uncertainty', '_truth', '_settling', '_ahead'),
    )
    _model: RobotModel
    _stamp: int
    _pose: tuple[float, float, float]
    _wheel_angles: Speeds
    _command: tuple[float, float]
    _twist: tuple[float, float]
    _commanded_at: int | None
    _expiry: int | None
    _uncertainty: Uncertainty
    # None: the pose is the true one.
    _truth: Truth | None
    # None: the wheels have reached their commanded speeds.
    _settling: Settling | None
    # The last state that was computed from this one, because often the same one is needed next.
    _ahead: tuple[int, _State] | None

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
        """Check every value. The methods below construct their results without these checks.

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
        self._model, self._stamp = model, nanoseconds('stamp', stamp)
        self._pose = _triple('pose', pose)
        self._uncertainty = Uncertainty(tuple(gaussian(covariance)))
        self._truth = _truth(model, self._pose)
        self._wheel_angles = pair('wheel_angles', wheel_angles)
        self._command, self._twist = pair('command', command), pair('twist', twist)
        if commanded_at is not None:
            commanded_at = nanoseconds('commanded_at', commanded_at)
        self._commanded_at = commanded_at
        self._expiry = _expiry(model, self._stamp, commanded_at)
        self._settling = self._ahead = None

    def __repr__(self) -> str:
        """Return a constructor call with the values."""
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

    @property
    def model(self) -> RobotModel:
        """The parameters."""
        return self._model

    @property
    def stamp(self) -> int:
        """Time of this state (ns)."""
        return self._stamp

    @property
    def pose(self) -> NDArray[np.float64]:
        """`[x, y, theta]`, shape (3,), read-only. `pose_tuple` has the same numbers without an array."""
        return read_only(self._pose)

    @property
    def pose_tuple(self) -> tuple[float, float, float]:
        """`(x, y, theta)`, the pose as floats (m, m, rad)."""
        return self._pose

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
    def wheel_angles(self) -> Speeds:
        """`(right, left)`, unwrapped (rad)."""
        return self._wheel_angles

    @property
    def command(self) -> tuple[float, float]:
        """The last commanded twist, `(v, omega)`."""
        return self._command

    @property
    def twist(self) -> tuple[float, float]:
        """The applied twist: the command after saturation, as the motors follow it."""
        return self._twist

    @property
    def commanded_at(self) -> int | None:
        """Time at which the command took effect (ns); None: it is zero."""
        return self._commanded_at

    @property
    def expiry(self) -> int | None:
        """Time at which the timeout stops the robot (ns); None: it is not moving, or has no timeout."""
        return self._expiry

    @property
    def covariance_tuple(self) -> tuple[float, ...]:
        """The nine entries of the covariance by rows, as floats.

        Raises:
            ValueError: The covariance overflows.
        """
        xx, xy, xt, yy, yt, tt, *_ = self._uncertainty.moments()
        return xx, xy, xt, xy, yy, yt, xt, yt, tt

    @property
    def true_pose_tuple(self) -> tuple[float, float, float]:
        """`(x, y, theta)` of the true pose (m, m, rad); without drift that of the odometry."""
        return self.pose_tuple if self._truth is None else self._truth.pose

    @property
    def true_pose(self) -> NDArray[np.float64]:
        """`[x, y, theta]` of the true pose, shape (3,)."""
        return np.array(self.true_pose_tuple)

    @property
    def true_twist(self) -> tuple[float, float]:
        """The true twist `(v, omega)` from this time on, the slip included (m/s, rad/s)."""
        truth, model = self._truth, self.model
        if truth is None:
            return self.twist
        return truth.twist(self.stamp, self.twist, model.wheel_separation, model.wheel_travel_variance)

    @property
    def moments(self) -> Moments:
        """Moments of the error of the pose, from which its later uncertainty follows.

        Raises:
            ValueError: They overflow.
        """
        return Moments(*self._uncertainty.moments())

    @property
    def next_change(self) -> int | None:
        """Next time at which the twist changes without a command, by the timeout or the lag (ns); None:
        it does not.
        """
        settling, expiry = self._settling, self.expiry
        if settling is None:
            return expiry
        return settling.end if expiry is None else min(settling.end, expiry)

    @property
    def changed_at(self) -> int:
        """Time of the last command, timeout, placement or change of the model (ns)."""
        return self.stamp if self._settling is None else self._settling.since

    @property
    def wheel_speeds(self) -> tuple[float, float]:
        """`(omega_R, omega_L)` (rad/s), by the inverse wheel Jacobian."""
        return self.model.wheel_speeds(*self.twist)

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
        L, k = self.model.wheel_separation, self.model.wheel_travel_variance
        interval = number('interval', interval, positive)
        (vv, vw), (wv, ww) = twist_covariance.formula(self.twist, L, k, interval)
        if not isfinite(vv + abs(vw) + ww):
            raise ValueError('twist and interval must give a finite result, but it overflows')
        return vv, vw, wv, ww

    def at(self, stamp: int) -> Robot:
        """Advance to a time, through the timeout if it expires before.

        Args:
            stamp: The time (ns).

        Raises:
            ValueError: The time is earlier than this state, is not an integer, or so late that the
                motion overflows.
        """
        if self.model.actuators is not None:
            return self._changed_until(stamp)
        stamp, state, expired = self._advanced(stamp)
        if expired:
            return _robot(self.model, stamp, state, STANDSTILL, STANDSTILL)
        return _robot(self.model, stamp, state, self.command, self.twist, self.commanded_at)

    def commanded(self, command: ArrayLike, stamp: int) -> Robot:
        """Apply a command from a time on, within the limits.

        Args:
            command: `[v, omega]`, shape (2,) (m/s, rad/s).
            stamp: The time (ns).

        Raises:
            ValueError: The command has another shape or is not finite; or as `at`.
        """
        v, omega = pair('command', command)
        model = self.model
        twist = model.limited((v, omega))
        if model.actuators is not None:
            here = self._changed_until(stamp)
            commanded_at = None if v == omega == 0.0 else here.stamp
            return here._driven(model, here._present, (v, omega), twist, commanded_at)
        stamp, state, _ = self._advanced(stamp)
        return _robot(model, stamp, state, (v, omega), twist, None if v == omega == 0.0 else stamp)

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
        placed = Robot(model=self.model, stamp=here.stamp, pose=pose, covariance=covariance)
        truth = here._truth if odometry_only else placed._truth
        state = placed.pose_tuple, here.wheel_angles, placed._uncertainty, truth
        return here._with(state)

    def reported(
        self, pose: tuple[float, float, float], wheel_angles: Speeds, twist: tuple[float, float]
    ) -> Robot:
        """Return this robot as its sensors report it, with the same covariance and the same truth.

        Args:
            pose: `(x, y, theta)` of the odometry, finite (m, m, rad).
            wheel_angles: `(right, left)`, finite (rad).
            twist: `(v, omega)`, finite (m/s, rad/s).

        Raises:
            ValueError: An argument has another shape or is not finite.
        """
        reported, angles = _triple('pose', pose), pair('wheel_angles', wheel_angles)
        twist = pair('twist', twist)
        state = reported, angles, self._uncertainty, self._truth
        return _robot(self.model, self.stamp, state, self.command, twist, self.commanded_at)

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
        displacement = _triple('displacement', displacement)
        here = self.at(stamp)
        if here.model.drift is None and not noticed:
            raise ValueError('model must have a drift: without one the odometry is the true pose')
        x, y, theta = compose(here.true_pose_tuple, displacement).tolist()
        if noticed:
            moved = compose(here.pose_tuple, displacement)
            here = here.placed(moved, here.covariance, here.stamp, odometry_only=True)
        pose, angles, uncertainty, truth = here._present
        if truth is not None:
            truth = truth.moved((x, y, theta))
        return here._with((pose, angles, uncertainty, truth))

    def remodelled(self, model: RobotModel, stamp: int, *, wheels_commanded: bool = False) -> Robot:
        """Change the model. Its limits and timeout apply to the current command.

        With `wheels_commanded` the command was one of wheel speeds. Then these are kept, and the twist
        changes with the wheels.

        Raises:
            ValueError: The model is of another class; or as `at`.
        """
        instance('model', model, RobotModel)
        here = self.at(stamp)
        command = here.command
        if wheels_commanded:
            command = model.twist(*self.model.wheel_speeds(*command))
        limited = model.limited(command)
        pose, angles, uncertainty, truth = here._present
        if truth is None or model.drift is None:
            truth = _truth(model, pose)
        else:
            truth = truth.with_drift(model.drift)
        state = pose, angles, uncertainty, truth
        if model.actuators is not None:
            return here._driven(model, state, command, limited, here.commanded_at)
        return _robot(model, here.stamp, state, command, limited, here.commanded_at)

    def restarted(self, stamp: int) -> Robot:
        """Stop at the same pose, at a time that may be earlier.

        Raises:
            ValueError: The time is not an integer (ns).
        """
        stamp = nanoseconds('stamp', stamp)
        pose, angles, uncertainty, truth = self._present
        state = pose, angles, uncertainty, None if truth is None else truth.at_rest()
        return _robot(self.model, stamp, state, STANDSTILL, STANDSTILL)

    @property
    def _present(self) -> _State:
        return self.pose_tuple, self.wheel_angles, self._uncertainty, self._truth

    def _with(self, state: _State) -> Robot:
        """Return a robot that was put into another state, with the same motion."""
        settling = self._settling
        if settling is not None:
            settling = settling._replace(since=self.stamp)
        command, twist = self.command, self.twist
        return _robot(self.model, self.stamp, state, command, twist, self.commanded_at, settling)

    def _changed_until(self, stamp: int) -> Robot:
        """Advance as `at` does, with actuators, through the steps of their lag and the timeout."""
        stamp, robot = nanoseconds('stamp', stamp), self
        while (change := robot.next_change) is not None and change <= stamp:
            robot = robot._changed(change)
        if stamp < robot.stamp:
            raise ValueError(f'stamp cannot go back from {self.stamp} ns to {stamp} ns')
        command, twist, commanded_at = robot.command, robot.twist, robot.commanded_at
        state = robot._state(stamp)
        return _robot(robot.model, stamp, state, command, twist, commanded_at, robot._settling)

    def _changed(self, stamp: int) -> Robot:
        """Return the robot at the time of its next change."""
        model, command, commanded_at = self.model, self.command, self.commanded_at
        state = self._state(stamp)
        here = _robot(model, stamp, state, command, self.twist, commanded_at, self._settling)
        if self.expiry == stamp:
            return here._driven(model, state, STANDSTILL, STANDSTILL, None)
        twist = model.limited(command)
        return here._driven(model, state, command, twist, commanded_at, self.changed_at)

    def _driven(
        self,
        model: RobotModel,
        state: _State,
        command: tuple[float, float],
        twist: tuple[float, float],
        commanded_at: int | None,
        since: int | None = None,
    ) -> Robot:
        """Return the robot in a state, from now on following a command with the actuators of a model.

        Args:
            model: The model, with actuators.
            state: The state.
            command: The command.
            twist: The twist that it demands, within the limits of the model.
            commanded_at: Time at which the command took effect (ns).
            since: Time from which on the command is followed (ns); None: from now on.
        """
        actuators = model.actuators
        assert actuators is not None
        stamp = self.stamp
        demanded = model.wheel_speeds(*twist)
        speeds, reached = self._motor_speeds, actuators.limited(demanded)
        settling = None
        if actuators.settled(speeds, reached):
            if reached != demanded:
                twist = model.twist(*reached)
        else:
            settling = Settling(stamp if since is None else since, stamp, speeds, reached)
            twist = model.twist(*actuators.mean(settling))
        return _robot(model, stamp, state, command, twist, commanded_at, settling)

    @property
    def _motor_speeds(self) -> Speeds:
        """The wheel speeds at this time (rad/s). Those of the twist are means over a step of the lag."""
        actuators = self.model.actuators
        if self._settling is None or actuators is None:
            return self.wheel_speeds
        return actuators.after(self._settling, self.stamp)

    def _advanced(self, stamp: int) -> tuple[int, _State, bool]:
        """Return a time (ns), the state at that time, and whether the timeout stopped the robot before.

        Raises:
            ValueError: As `at`.
        """
        if type(stamp) is not int or stamp > MAX_NANOSECONDS:
            stamp = nanoseconds('stamp', stamp)
        if stamp < self.stamp:
            raise ValueError(f'stamp cannot go back from {self.stamp} ns to {stamp} ns')
        expiry = self.expiry
        if expiry is None or expiry > stamp:
            return stamp, self._state(stamp), False
        stopped = _robot(self.model, expiry, self._state(expiry), STANDSTILL, STANDSTILL)
        return stamp, stopped._state(stamp), True

    def _state(self, stamp: int) -> _State:
        """Compute the state at a time up to the timeout."""
        ahead = self._ahead
        if ahead is not None and ahead[0] == stamp:
            return ahead[1]
        dt = (stamp - self.stamp) / NANOSECONDS
        twist = v, omega = self.twist
        truth, model = self._truth, self.model
        if dt == 0.0 or (truth is None and twist == STANDSTILL):
            return self._present
        L, k = model.wheel_separation, model.wheel_travel_variance
        if truth is not None:
            truth = truth.after(self.stamp, stamp, twist, L, k)
        if twist == STANDSTILL:
            return self.pose_tuple, self.wheel_angles, self._uncertainty, truth
        (x, y, theta), (right, left) = self.pose_tuple, self.wheel_angles
        omega_R, omega_L = self.wheel_speeds
        right, left = angles = right + omega_R * dt, left + omega_L * dt
        # A finite sum has finite terms.
        if not (isfinite(right + left) or (isfinite(right) and isfinite(left))):
            raise ValueError(f'wheel_angles must be finite, got {list(angles)}')
        uncertainty = self._uncertainty.after((theta, twist, dt, L, k))
        state = arc_end(x, y, theta, v, omega, dt), angles, uncertainty, truth
        self._ahead = stamp, state
        return state


def _robot(
    model: RobotModel,
    stamp: int,
    state: _State,
    command: tuple[float, float],
    twist: tuple[float, float],
    commanded_at: int | None = None,
    settling: Settling | None = None,
) -> Robot:
    """Return a robot with checked values, without checking them again for every message."""
    robot = object.__new__(Robot)
    robot._model, robot._stamp = model, stamp
    robot._pose, robot._wheel_angles, robot._uncertainty, robot._truth = state
    robot._command, robot._twist, robot._commanded_at = command, twist, commanded_at
    robot._expiry = _expiry(model, stamp, commanded_at)
    robot._settling, robot._ahead = settling, None
    return robot


def _expiry(model: RobotModel, stamp: int, commanded_at: int | None) -> int | None:
    """Return the time at which the timeout stops a robot (ns), see `Robot.expiry`."""
    timeout = model.command_timeout
    if commanded_at is None or not timeout:
        return None
    # If the timeout was shortened, it expires now, not in the past.
    expiry = commanded_at + timeout
    return expiry if expiry > stamp else stamp


def _triple(name: str, value: ArrayLike) -> tuple[float, float, float]:
    """Return three finite numbers as a tuple of floats.

    Raises:
        ValueError: It is something else.
    """
    x, y, theta = numbers(name, value, 3)
    return x, y, theta


def _truth(model: RobotModel, pose: Sequence[float]) -> Truth | None:
    """Return the truth of a robot whose pose is the true one; None: its model has no drift."""
    x, y, theta = pose
    return None if model.drift is None else Truth(model.drift, (x, y, theta))
