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

"""Robots and recordings for the calibration that share no code with the package or its tests.

Only `CalibrationDrive` and `Geometry` are taken from the package, as the interface. A drive is a list of
commands of the body velocity, which ramps limit to finite accelerations. Wheels and body are integrated
on a grid of 1 ms by the midpoint rule. The recording follows from that: encoders with finite steps at
the sample rate of the wheels, and poses of a sensor at some place on the robot, with white noise.

`CASES` are the robots of the table in doc/calibration.md. A drive, a recording and all that is random
about it follow from the name of the case and the seed.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_jacobian.calibration import CalibrationDrive, Geometry

RADIUS, SEPARATION = 0.033, 0.16
"""Nominal dimensions (m)."""
SPREAD = 0.03
"""Multipliers are drawn from 1 plus and minus this."""
FINE = 1e-3
"""Step of the integration (s)."""
ACCELERATION, ANGULAR_ACCELERATION = 0.5, 3.0
"""Of the ramps between commands (m/s^2, rad/s^2)."""
FOOT = 0.3048

Commands = list[tuple[float, float, float]]
"""Duration (s), forward velocity (m/s), yaw rate (rad/s)."""


def square(side: float = 2.0, laps: int = 1, speed: float = 0.2, turn: float = 1.0) -> Commands:
    """Return UMBmark: squares in both directions, with stops and turns in place at the corners."""
    commands: Commands = [(1.0, 0.0, 0.0)]
    for sign in (-1.0, 1.0):
        corner = [(side / speed, speed, 0.0), (0.6, 0.0, 0.0), (np.pi / 2 / turn, 0.0, sign * turn)]
        commands += [*corner, (0.6, 0.0, 0.0)] * 4 * laps
    return commands


def rounded_square(
    side: float = 2.0, laps: int = 1, speed: float = 0.2, corner: float = 0.5
) -> Commands:
    """Return squares in both directions whose corners are quarters of a circle."""
    commands: Commands = [(1.0, 0.0, 0.0)]
    for sign in (-1.0, 1.0):
        line = ((side - 2 * corner) / speed, speed, 0.0)
        arc = (np.pi / 2 * corner / speed, speed, sign * speed / corner)
        commands += [line, arc] * 4 * laps + [(1.0, 0.0, 0.0)]
    return commands


def mixed(
    laps: int = 1, speed: float = 0.2, turn: float = 1.0, radius: float = 0.25, places: int = 1
) -> Commands:
    """Return squares of 1 m in both directions with turns in place at some corners, arcs at the others.

    One turn in place for three arcs is the recipe of doc/calibration.md: slip in either of them shows.
    """
    commands: Commands = [(1.0, 0.0, 0.0)]
    for sign in (-1.0, 1.0):
        line, stop = (1.0 / speed, speed, 0.0), (0.6, 0.0, 0.0)
        place = [line, stop, (np.pi / 2 / turn, 0.0, sign * turn), stop]
        arc = [line, (np.pi / 2 * radius / speed, speed, sign * speed / radius)]
        commands += (place * places + arc * (4 - places)) * laps
    return commands


def random_arcs(random: np.random.Generator, seconds: float = 100.0) -> Commands:
    """Return arcs of random curvature to both sides."""
    commands: Commands = [(1.0, 0.0, 0.0)]
    while sum(one[0] for one in commands) < seconds:
        commands.append((random.uniform(2, 6), random.uniform(0.1, 0.22), random.uniform(-0.8, 0.8)))
    return [*commands, (1.0, 0.0, 0.0)]


@dataclass(frozen=True, kw_only=True)
class Robot:
    """What a robot does and how it is recorded."""

    drive: Callable[[np.random.Generator], Commands] = lambda _: square()
    slip: float = 1e-5
    """Variance of the distance travelled by a wheel, per distance (m)."""
    encoder: int | None = 4096
    """Steps per turn; None: continuous."""
    wheel_rate: float = 50.0
    pose_rate: float = 10.0
    position_noise: float = 0.005
    heading_noise: float = 0.01
    time_offset: float = 0.0
    """What must be added to the times of the poses (s); a random 0.05 s comes in addition."""
    clock_drift: float = 0.0
    """Relative rate by which the clock of the reference is fast."""
    unit: float = 1.0
    """Unit of the positions of the reference (m)."""
    skids: tuple[bool, ...] = (False,)
    """For each bag whether its right wheel travels 5 % less than it turns for 30 s."""
    slip_share: float = 0.0
    """Share of their travel that some wheels lose in some motion."""
    slip_wheels: str = 'both'
    """'both', 'right', or 'outer', the faster one."""
    slip_motion: str = 'turns'
    """'turns', 'in place', 'arcs', or 'left', to which the robot turns."""
    change: tuple[float, float] = (0.0, 0.0)
    """Relative changes of the left and the right radius in the middle of the drive."""
    outliers: float = 0.0
    """Share of poses of the reference that are 0.1 m off in a random direction."""
    swapped: bool = False
    """Whether the wheels are exchanged and count backwards."""


STANDARD = Robot(drive=lambda _: square(laps=5), pose_rate=2.0, encoder=None)
"""The robot whose errors are compared with the Cramer-Rao bound."""
MIXED = Robot(drive=lambda _: mixed(laps=2))
"""A robot that turns in place and drives arcs, so that slip in one of them shows."""
FEW_ARCS = Robot(drive=lambda _: mixed(laps=2, radius=0.5, places=2))
"""A robot whose arcs are too wide, and too few, to show slip in place."""
SHORT = Robot(drive=lambda _: square(side=1.0), encoder=None)


def good(random: np.random.Generator) -> Robot:
    """Return one of many varieties that the calibration must accept."""
    side, laps = random.uniform(1.0, 2.5), int(random.integers(1, 4))
    drives = [
        lambda _: square(side, laps),
        lambda _: rounded_square(side, laps, corner=side / 4),
        lambda random: random_arcs(random, 60.0 * laps),
        lambda _: mixed(laps),
    ]
    return Robot(
        drive=drives[random.integers(4)],
        slip=10.0 ** random.uniform(-6.0, -4.5),
        encoder=[500, 1000, 2048, 4096, None][random.integers(5)],
        wheel_rate=[20.0, 30.0, 50.0, 100.0][random.integers(4)],
        pose_rate=[2.0, 5.0, 10.0, 30.0][random.integers(4)],
        position_noise=10.0 ** random.uniform(-3.0, -2.0),
        heading_noise=10.0 ** random.uniform(-2.5, -1.7),
    )


def coarse(random: np.random.Generator) -> Robot:
    """Return one of many varieties with an encoder of few steps or wheels that are recorded rarely."""
    return replace(
        good(random),
        encoder=int(2.0 ** random.uniform(4.0, 8.0)),
        wheel_rate=[5.0, 10.0, 20.0, 50.0][random.integers(4)],
    )


def skidding(random: np.random.Generator) -> Robot:
    """Return one of many varieties that skid."""
    return replace(good(random), skids=(True,))


def slipping(share: float, wheels: str, motion: str) -> Robot:
    """Return a robot of which some wheels lose a share of their travel in some motion."""
    return replace(MIXED, slip_share=share, slip_wheels=wheels, slip_motion=motion)


def clock(offset: float) -> Callable[[np.random.Generator], Robot]:
    """Return a draw of robots with an offset of the clocks, on drives of about 100 s or 200 s."""

    def robot(random: np.random.Generator) -> Robot:
        laps = int(random.integers(1, 3))
        return Robot(drive=lambda _: square(laps=laps), time_offset=offset)

    return robot


CASES: dict[str, Robot | Callable[[np.random.Generator], Robot]] = {
    'good': good,
    'recipe': MIXED,
    'UMBmark': STANDARD,
    **{f'encoder of {n} steps': Robot(encoder=n) for n in (16, 20, 32, 64, 128, 500, 2000)},
    'coarse encoders, varied': coarse,
    'skid, varied': skidding,
    'skid': Robot(skids=(True,)),
    'skid, fivefold square': Robot(drive=STANDARD.drive, pose_rate=2.0, skids=(True,)),
    'two bags, skid in one': Robot(skids=(False, True)),
    'slip in tight turns': Robot(drive=lambda _: rounded_square(corner=0.1), slip_share=0.02),
    'slip in wide turns': Robot(drive=lambda _: rounded_square(corner=0.5), slip_share=0.02),
    'turns in place only, slip in them': Robot(slip_share=0.02),
    'right wheel slips 3 % in place': slipping(0.03, 'right', 'in place'),
    'right wheel slips 5 % in place': slipping(0.05, 'right', 'in place'),
    'right wheel slips 3 % in place, few arcs': replace(
        FEW_ARCS, slip_share=0.03, slip_wheels='right', slip_motion='in place'
    ),
    'right wheel slips 3 % in left turns': slipping(0.03, 'right', 'left'),
    'outer wheel slips 1 % in arcs': slipping(0.01, 'outer', 'arcs'),
    'outer wheel slips 1 % in arcs, no turns in place': Robot(
        drive=lambda _: rounded_square(), slip_share=0.01, slip_wheels='outer', slip_motion='arcs'
    ),
    'radii change by 0.5 %': replace(MIXED, change=(0.005, 0.005)),
    'a radius changes by 1 %': replace(MIXED, change=(0.0, 0.01)),
    'a radius changes by 1 %, fivefold square': replace(STANDARD, change=(0.0, 0.01)),
    **{f'clock {offset:+d} s': clock(offset) for offset in (-60, -40, -31, -20, 0, 20, 40, 60)},
    'clock fast by 0.1 %': Robot(clock_drift=1e-3),
    'clock slow by 0.2 %': replace(MIXED, clock_drift=-2e-3),
    'outliers of 10 cm, 5 %': replace(MIXED, outliers=0.05),
    'no noise': replace(MIXED, position_noise=0.0, heading_noise=0.0),
    'no noise, no slip': replace(MIXED, position_noise=0.0, heading_noise=0.0, slip=0.0),
    'feet': Robot(unit=FOOT),
    'wheels swapped and negated': Robot(swapped=True),
    'short drive': replace(SHORT, pose_rate=5.0),
    'short drive, coarse reference': replace(
        SHORT, pose_rate=5.0, position_noise=0.1, heading_noise=0.1
    ),
    'short drive, coarse reference, much slip': replace(
        SHORT, pose_rate=5.0, position_noise=0.1, heading_noise=0.1, slip=1e-4
    ),
    **{f'wheels at {n} Hz': Robot(wheel_rate=n) for n in (4, 5, 8, 10, 20)},
}
"""Robots by the name of the case; functions draw one."""


def simulate(case: str, seed: int) -> tuple[list[CalibrationDrive], Geometry, np.ndarray]:
    """Return recordings of a random robot, its nominal dimensions and its true multipliers.

    The multipliers are those of the left radius, the right radius and the separation, shape (2, 3): at
    the begin and at the end.
    """
    recordings, drives, multipliers = _simulated(case, seed)
    later = multipliers * [*np.add(1.0, drives[0].robot.change), 1.0]
    nominal = Geometry(wheel_radius=RADIUS, wheel_separation=SEPARATION)
    return recordings, nominal, np.stack([multipliers, later])


def _simulated(case: str, seed: int) -> tuple[list[CalibrationDrive], list[Drive], np.ndarray]:
    """Return recordings, the true drives and the true multipliers."""
    random = np.random.default_rng([seed, zlib.crc32(case.encode())])
    robot = CASES[case]
    if callable(robot):
        robot = robot(random)
    multipliers = random.uniform(1 - SPREAD, 1 + SPREAD, 3)
    sensor = random.uniform([-0.1, -0.1, -0.5], [0.1, 0.1, 0.5])
    recordings, drives = [], []
    for number, skid in enumerate(robot.skids):
        drives.append(Drive(robot, multipliers, skid, random))
        recordings.append(_recording(f'bag {number + 1}', robot, drives[-1], sensor, random))
    return recordings, drives, multipliers


class Drive:
    """The true motion over time.

    Attributes:
        robot: Its noise, and how it is recorded.
        separation: True separation of the wheels (m).
        time: Shape (n,) (s).
        angles: Of the right and the left wheel, shape (n, 2) (rad).
        measured: Travel of both wheels by their angles in each step, shape (n - 1, 2) (m).
        travel: The same over the ground.
        poses: `[x, y, theta]` of the body, shape (n, 3); theta is not wrapped.
    """

    def __init__(
        self, robot: Robot, multipliers: np.ndarray, skid: bool, random: np.random.Generator
    ) -> None:
        """Integrate the wheels and the body."""
        commands = robot.drive(random)
        ends = np.cumsum([one[0] for one in commands])
        self.time = np.arange(0.0, ends[-1] + 1.0, FINE)
        middle = self.time[:-1] + FINE / 2
        targets = [(0.0, 0.0), *[one[1:] for one in commands], (0.0, 0.0)]
        v = _ramped(middle, [0.0, *ends], [one[0] for one in targets], ACCELERATION)
        omega = _ramped(middle, [0.0, *ends], [one[1] for one in targets], ANGULAR_ACCELERATION)
        # The controller takes the robot for nominal.
        rims = np.column_stack([v + omega * SEPARATION / 2, v - omega * SEPARATION / 2])
        turned = rims / RADIUS * FINE
        self.angles = np.concatenate([np.zeros((1, 2)), np.cumsum(turned, axis=0)])
        left, right, separation = multipliers
        self.robot, self.separation = robot, SEPARATION * separation
        self.measured = turned * RADIUS * [right, left]
        travel = self.measured.copy()
        if skid:
            begin = random.uniform(5.0, ends[-1] - 35.0)
            travel[(middle >= begin) & (middle < begin + 30.0), 0] *= 0.95
        travel[middle > middle[-1] / 2.0] *= np.add(1.0, robot.change)[::-1]
        turns, drives = np.abs(omega) > 0.02, np.abs(v) > 0.02
        motions = {'turns': turns, 'in place': turns & ~drives, 'arcs': turns & drives}
        motions['left'] = omega > 0.02
        wheels = {
            'both': np.array([[True, True]]),
            'right': np.array([[True, False]]),
            'outer': np.column_stack([omega > 0.0, omega < 0.0]),
        }
        slips = wheels[robot.slip_wheels] & motions[robot.slip_motion][:, None]
        travel[slips] *= 1.0 - robot.slip_share
        travel += np.sqrt(robot.slip * np.abs(travel)) * random.standard_normal(travel.shape)
        self.travel = travel
        forward = travel.mean(axis=1)
        turn = (travel[:, 0] - travel[:, 1]) / self.separation
        start = random.uniform(-1.0, 1.0, 3) * [1.0, 1.0, np.pi]
        theta = start[2] + np.concatenate([[0.0], np.cumsum(turn)])
        halfway = theta[:-1] + turn / 2
        steps = forward[:, None] * np.column_stack([np.cos(halfway), np.sin(halfway)])
        places = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        self.poses = np.column_stack([places, theta])

    def at(self, time: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return values at other times, shape (m, ...)."""
        return np.column_stack([np.interp(time, self.time, column) for column in values.T])


def _ramped(at: np.ndarray, begins: list[float], targets: list[float], rate: float) -> np.ndarray:
    """Return a velocity that follows targets, each valid from its begin, with a limited rate."""
    knots, values = [-1.0], [targets[0]]
    for begin, before, target in zip(begins, targets, targets[1:], strict=False):
        # A ramp of the least length: the times must increase.
        knots += [begin, begin + max(abs(target - before) / rate, 1e-6)]
        values += [before, target]
    return np.interp(at, knots, values)


def _recording(
    name: str, robot: Robot, drive: Drive, sensor: np.ndarray, random: np.random.Generator
) -> CalibrationDrive:
    last = drive.time[-1]
    wheel_time = np.arange(random.uniform(0.0, 1.0 / robot.wheel_rate), last, 1.0 / robot.wheel_rate)
    angles = drive.at(wheel_time, drive.angles)
    if robot.encoder is not None:
        step = 2 * np.pi / robot.encoder
        angles = np.floor(angles / step + random.uniform(0.0, 1.0, 2)) * step
    if robot.swapped:
        angles = -angles[:, ::-1]
    true_time = np.arange(random.uniform(0.0, 1.0 / robot.pose_rate), last, 1.0 / robot.pose_rate)
    x, y, theta = drive.at(true_time, drive.poses).T
    ahead, aside, yaw = sensor
    poses = np.column_stack(
        [
            x + np.cos(theta) * ahead - np.sin(theta) * aside,
            y + np.sin(theta) * ahead + np.cos(theta) * aside,
            theta + yaw,
        ]
    )
    scale = [robot.position_noise, robot.position_noise, robot.heading_noise]
    poses += scale * random.standard_normal(poses.shape)
    off = random.uniform(size=len(poses)) < robot.outliers
    direction = random.uniform(-np.pi, np.pi, len(poses))[off]
    poses[off, :2] += 0.1 * np.column_stack([np.cos(direction), np.sin(direction)])
    poses[:, :2] /= robot.unit
    poses[:, 2] = np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))
    offset = robot.time_offset + random.uniform(-0.05, 0.05)
    return CalibrationDrive(
        name=name,
        wheel_time=wheel_time,
        wheel_angles=angles,
        pose_time=true_time * (1.0 + robot.clock_drift) - offset,
        poses=poses,
    )


def cramer_rao_bound(case: str, seed: int) -> np.ndarray:
    """Return the least variances of the logarithms of the multipliers of a robot with one bag.

    They are those of a Kalman filter that is linearized at the true motion with the sensor at the
    centre, knows the noise, and estimates the pose of the body, the multipliers, the pose of the
    sensor and the time offset.
    """
    (recording,), (drive,), _ = _simulated(case, seed)
    robot, L, time, poses = drive.robot, drive.separation, drive.time, drive.poses
    at = np.searchsorted(time, np.linspace(time[0], time[-1], len(recording.pose_time) + 1)[:-1])
    # Effects of the travel of the right and of the left wheel, and of the turn, in world axes.
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    turn = (drive.measured[:, 0] - drive.measured[:, 1]) / L
    covariance = np.diag([10.0] * 3 + [1.0] * 7) ** 2
    noise = np.diag([robot.position_noise] * 2 + [robot.heading_noise]) ** 2
    for first, last in zip([at[0], *at[:-1]], at, strict=True):
        here = slice(first, last)
        dx, dy = (poses[last, :2] - poses[here, :2]).T
        one = np.ones_like(dx)
        right = np.stack([c[here] / 2 - dy / L, s[here] / 2 + dx / L, one / L])
        left = np.stack([c[here] / 2 + dy / L, s[here] / 2 - dx / L, -one / L])
        step = np.eye(10)
        step[:2, 2] = poses[first, 1] - poses[last, 1], poses[last, 0] - poses[first, 0]
        step[:3, 3] = left @ drive.measured[here, 1]
        step[:3, 4] = right @ drive.measured[here, 0]
        step[:3, 5] = np.stack([dy, -dx, -one]) @ turn[here]
        covariance = step @ covariance @ step.T
        distance = robot.slip * np.abs(drive.travel[here])
        covariance[:3, :3] += (right * distance[:, 0]) @ right.T + (left * distance[:, 1]) @ left.T
        speed = drive.measured[last].mean() / FINE
        observed = np.zeros((3, 10))
        observed[:, :3] = observed[:, 6:9] = np.eye(3)
        observed[:2, 6:8] = [[c[last], -s[last]], [s[last], c[last]]]
        observed[:, 9] = speed * c[last], speed * s[last], turn[last] / FINE
        gain = np.linalg.solve(observed @ covariance @ observed.T + noise, observed @ covariance).T
        covariance = covariance - gain @ observed @ covariance
        covariance = (covariance + covariance.T) / 2
    return np.diag(covariance)[3:6]
