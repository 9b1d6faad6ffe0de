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

"""Simulated drives for the calibration: angles of the wheels, and a reference with noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from support.ros_messages import pose_message, stamp

from diffdrive_jacobian.calibration.model import CalibrationDrive, Noise
from diffdrive_jacobian.calibration.motion import Geometry, composed

NOMINAL = Geometry(wheel_radius=0.033, wheel_separation=0.16)
TRUE = (0.98, 1.015, 1.03)
"""Multipliers of the left radius, the right radius and the separation."""
NOISE = Noise(wheel=1e-5, position=0.005, heading=0.01)
STEP = 0.02
"""Period of the encoders (s)."""


def square(side=1.0, clockwise=False, speed=0.2, turn=1.0):
    """Return the commands of a square as (duration, v, omega)."""
    sign = -1.0 if clockwise else 1.0
    return [(side / speed, speed, 0.0), (np.pi / 2.0 / turn, 0.0, sign * turn)] * 4


def umbmark(side=1.0, runs=1, **how):
    """Return the commands of UMBmark: a square in both directions, several times each."""
    commands = []
    for clockwise in (True, False):
        commands += [(1.0, 0.0, 0.0), *square(side, clockwise, **how)] * runs
    return [*commands, (1.0, 0.0, 0.0)]


@dataclass(frozen=True, kw_only=True)
class Drive:
    """The wheels of a robot over time, and what follows from them."""

    time: np.ndarray
    angles: np.ndarray
    """Right, left (rad)."""

    @classmethod
    def of(cls, commands):
        """Return the drive of a controller that takes the robot for nominal."""
        steps = []
        for duration, v, omega in commands:
            count = max(1, round(duration / STEP))
            rims = np.array([v, v]) + np.array([omega, -omega]) * NOMINAL.separation / 2.0
            steps += [rims * duration / count / NOMINAL.wheel_radius] * count
        angles = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        return cls(time=STEP * np.arange(len(angles)), angles=angles)


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """A robot with wheels that slip, and a sensor that observes it."""

    drive: Drive
    multipliers: tuple = TRUE
    noise: Noise = NOISE
    sensor: tuple = (0.0, 0.0, 0.0)
    start: tuple = (0.4, -0.3, 0.5)
    rate: int = 10
    """Samples of the wheels for each pose of the reference."""
    delay: float = 0.0
    """Subtracted from the times of the poses (s)."""

    def truth(self, random):
        """Return the pose of the body at each sample of the wheels, shape (n, 3)."""
        geometry = replace(NOMINAL, multipliers=self.multipliers)
        rims = np.diff(self.drive.angles, axis=0) * np.array(geometry.radii)
        rims += np.sqrt(self.noise.wheel * np.abs(rims)) * random.standard_normal(rims.shape)
        right, left = rims.T
        a = (right - left) / geometry.separation
        theta = self.start[2] + np.concatenate([[0.0], np.cumsum(a)])
        chord = (right + left) / 2.0 * np.sinc(a / 2.0 / np.pi)
        middle = theta[:-1] + a / 2.0
        x = self.start[0] + np.concatenate([[0.0], np.cumsum(chord * np.cos(middle))])
        y = self.start[1] + np.concatenate([[0.0], np.cumsum(chord * np.sin(middle))])
        return np.column_stack([x, y, theta])

    def observed(self, poses, random):
        """Return what the reference observes of true poses of the body."""
        poses = composed(poses, np.array(self.sensor))
        scale = [self.noise.position, self.noise.position, self.noise.heading]
        return poses + scale * random.standard_normal(poses.shape)

    def recording(self, random, name='bag'):
        """Return a simulated recording."""
        here = slice(3, -3, self.rate)
        poses = self.observed(self.truth(random)[here], random)
        poses[:, 2] = (poses[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        return CalibrationDrive(
            name=name,
            wheel_time=self.drive.time,
            wheel_angles=self.drive.angles,
            pose_time=self.drive.time[here] - self.delay,
            poses=poses,
        )


SHORT = Drive.of(umbmark(speed=0.5, turn=2.0))
"""25 seconds."""
ROBOT = Simulation(drive=SHORT, rate=25)
JOINTS = ['left_wheel_joint', 'right_wheel_joint']


def deviations(result):
    """Return the standard deviations of the multipliers."""
    return np.sqrt(np.diag(result.covariance))


def assert_true(result, multipliers=TRUE, most=4.5):
    """Check that the multipliers are the true ones, within some standard deviations that are small."""
    assert (deviations(result) < 0.01).all()
    assert (np.abs(result.multipliers - multipliers) < most * deviations(result)).all()


def other_notes(result):
    """Return the notes, but not that about slip which turns in place alone do not show."""
    return [note for note in result.notes if 'it may go unnoticed that both wheels' not in note]


def with_stops(commands):
    return [one for command in commands for one in (command, (0.6, 0.0, 0.0))]


def stepped(readings, steps, random):
    """Return readings of encoders with some steps per turn, from random angles."""
    step = 2.0 * np.pi / steps
    return np.floor(readings / step + random.uniform(0.0, 1.0, 2)) * step


def bag_messages(recording, *, kind=PoseStamped, topic='/mocap/pose', position=True, clock=0.0):
    """Return the messages of a recording as (seconds, topic, message), as `write_bag` takes them.

    Args:
        recording: The recording.
        kind: Type of the reference.
        topic: Topic of the reference.
        position: Whether the joint states have positions beside their velocities.
        clock: Added to the stamps of the reference (s).
    """
    begin, sent = 100.0, []
    speeds = np.gradient(recording.wheel_angles, recording.wheel_time, axis=0)
    for time, angles, speed in zip(
        recording.wheel_time.tolist(), recording.wheel_angles, speeds, strict=True
    ):
        message = JointState(name=JOINTS, velocity=speed[::-1].tolist())
        if position:
            message.position = angles[::-1].tolist()
        message.header.stamp = stamp(round((begin + time) * 1e9))
        sent.append((begin + time, '/joint_states', message))
    for time, pose in zip(recording.pose_time.tolist(), recording.poses, strict=True):
        message = kind()
        message.header.frame_id = 'mocap'
        message.header.stamp = stamp(round((begin + clock + time) * 1e9))
        if kind is PoseStamped:
            message.pose = pose_message(pose)
        else:
            message.pose.pose = pose_message(pose)
        sent.append((begin + time, topic, message))
    return sorted(sent, key=lambda one: one[0])
