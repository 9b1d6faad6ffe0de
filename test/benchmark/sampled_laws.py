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

"""Sampled laws at and beyond their bounds: `python test/benchmark/sampled_laws.py`.

For each law, robots with random gains, rates and starts: the share that arrives within the bounds of
doc/mathematics.md, "Control laws", and with 1.1, 1.5 and 2 times the slope that they allow. The robots
start from rest. Commands are held for a period and take effect at once, one period late, or up to one
period late. The robots are simulated here, with nothing but the laws of the package.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from diffdrive_jacobian.control import go_to_goal, go_to_pose, offset_point, turn_in_place

Array = NDArray[np.float64]
TOLERANCE = 0.02
"""Of the position (m) and of the heading (rad)."""
DELAYS: dict[str, float | None] = {'none': 0.0, 'one sample': 1.0, 'up to one': None}
"""Delay of the commands in samples; None: another one for each robot."""
ORIGIN = np.zeros(3)


class Robots(NamedTuple):
    """Robots that drive to the origin."""

    gains: Array
    """Gains times the period, and lengths, shape (n gains, n)."""
    poses: Array
    samples: Array
    """Number of samples after which a robot has not arrived."""


class Case(NamedTuple):
    """A law and the robots that try it."""

    draw: Callable[[np.random.Generator, Array], Robots]
    """Return robots for slopes of omega over the heading, times the period, shape (n,)."""
    law: Callable[..., tuple[Any, Any]]
    """Poses, rates and gains to `(v, omega)`."""


def starts(rng: np.random.Generator, count: int) -> Array:
    """Return poses near the origin, shape (n, 3)."""
    return rng.uniform([-3.0, -3.0, -np.pi], [3.0, 3.0, np.pi], (count, 3))


def turns(rng: np.random.Generator, slope: Array) -> Robots:
    """Return robots with Kp of that size, on the origin."""
    poses = starts(rng, len(slope)) * [0.0, 0.0, 1.0]
    return Robots(slope[np.newaxis], poses, np.full(len(slope), 2000.0))


def to_goals(rng: np.random.Generator, slope: Array) -> Robots:
    """Return robots with Kp + Kv of that size, Kp > Kv."""
    Kv = np.minimum(slope * 10.0 ** rng.uniform(-2.0, np.log10(0.5), len(slope)), 0.95)
    return Robots(np.array([slope - Kv, Kv]), starts(rng, len(slope)), 300.0 + 40.0 / Kv)


def to_poses(rng: np.random.Generator, slope: Array) -> Robots:
    """Return robots with Kp + Kv (1 + 2.74 h) of that size, Kp > 2 Kv."""
    Kp = slope * rng.uniform(0.2, 0.95, len(slope))
    Kv = np.minimum(0.5 * Kp * 10.0 ** rng.uniform(-1.0, 0.0, len(slope)), 0.9 * (slope - Kp))
    h = (slope - Kp - Kv) / (2.74 * Kv)
    # A large weight makes the robot circle about the goal until its heading is right.
    return Robots(np.array([Kp, Kv, h]), starts(rng, len(slope)), 300.0 + 40.0 / Kv + 20.0 * h / Kp)


def to_points(rng: np.random.Generator, slope: Array) -> Robots:
    """Return robots with k (1 + distance / |d|) of that size."""
    k = np.minimum(slope * 10.0 ** rng.uniform(-2.0, 0.0, len(slope)), 0.95)
    d = rng.choice([-1.0, 1.0], len(slope)) * 10.0 ** rng.uniform(-1.0, 0.0, len(slope))
    distance, bearing, theta = (slope / k - 1.0) * abs(d), *rng.uniform(-np.pi, np.pi, (2, len(slope)))
    x, y = distance * np.cos(bearing) - d * np.cos(theta), distance * np.sin(bearing) - d * np.sin(theta)
    return Robots(np.array([k, d]), np.column_stack([x, y, theta]), 300.0 + 40.0 / k)


CASES = {
    'turn in place': Case(turns, lambda poses, rate, Kp: turn_in_place(poses[:, 2], 0.0, Kp * rate)),
    'go_to_goal': Case(
        to_goals, lambda poses, rate, Kp, Kv: go_to_goal(poses, ORIGIN[:2], Kp * rate, Kv * rate)
    ),
    'pose': Case(
        to_poses,
        lambda poses, rate, Kp, Kv, h: go_to_pose(poses, ORIGIN, Kp * rate, Kv * rate, h),
    ),
    'offset_point': Case(
        to_points, lambda poses, rate, k, d: offset_point(poses, ORIGIN[:2], k * rate, d)
    ),
}


def moved(poses: Array, v: Array, omega: Array, duration: Array) -> Array:
    """Return the poses at the end of exact arcs."""
    turn = omega * duration
    chord, middle = v * duration * np.sinc(turn / 2.0 / np.pi), poses[:, 2] + turn / 2.0
    return poses + np.column_stack([chord * np.cos(middle), chord * np.sin(middle), turn])


def arrived(name: str, factor: float, delay: float | None, count: int, seed: int = 1) -> Array:
    """Drive robots to the origin and return whether each arrives, shape (n,).

    Args:
        name: The law.
        factor: Slope, relative to the largest that the bound allows; 1: at random from 0.2 to 0.99
            of it.
        delay: Delay of the commands in samples; None: at random up to one.
        count: Number of robots.
        seed: Seed of the random numbers.
    """
    case, rng = CASES[name], np.random.default_rng(seed)
    share = rng.uniform(*((0.2, 0.99) if factor == 1.0 else (0.98 * factor, 1.02 * factor)), count)
    robots = case.draw(rng, share * (2.0 if delay == 0.0 else 1.0))
    rate = 2.0 * 100.0 ** rng.uniform(0.0, 1.0, count)
    late = rng.uniform(0.0, 1.0, count) if delay is None else np.full(count, delay)
    poses, gains, rows = robots.poses, robots.gains, np.arange(count)
    found, last = np.zeros(count, dtype=bool), np.zeros((2, count))
    for step in range(int(robots.samples.max()) + 1):
        x, y, theta = poses.T
        if name == 'turn in place':
            done = np.abs(np.sin(theta / 2.0)) <= TOLERANCE / 2.0
        else:
            d = gains[1] if name == 'offset_point' else 0.0
            done = np.hypot(x + d * np.cos(theta), y + d * np.sin(theta)) <= TOLERANCE
        found[rows[done]] = True
        left = ~done & (step < robots.samples[rows])
        if not left.any():
            break
        poses, gains, last, rows = poses[left], gains[:, left], last[:, left], rows[left]
        twist = np.array(case.law(poses, rate[rows], *gains))
        poses = moved(poses, *last, late[rows] / rate[rows])
        poses = moved(poses, *twist, (1.0 - late[rows]) / rate[rows])
        last = twist
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--robots', type=int, default=10_000, help='of each cell (default: 10000)')
    count = parser.parse_args().robots
    table = Table(title=f'robots that do not arrive, of {count}')
    for title in ('law', 'delay', 'within the bound', '1.1 times', '1.5 times', 'twice'):
        table.add_column(title, justify='left' if title in ('law', 'delay') else 'right')
    for name in CASES:
        for label, delay in DELAYS.items():
            lost = [
                int(count - arrived(name, factor, delay, count).sum()) for factor in (1.0, 1.1, 1.5, 2.0)
            ]
            table.add_row(name, label, *map(str, lost))
    Console().print(table)


if __name__ == '__main__':
    main()
