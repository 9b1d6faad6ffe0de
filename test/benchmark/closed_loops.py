"""Closed loops in batches: robot-steps per second, the error of the motion, and memory.

Ours: `closed_loops` with document A's law, robots from random starts to random goals, outcomes only. The
steps count that each robot drove until it arrived. Beside it, with the same law:

- arrays of all robots and nothing else: no checks, nobody arrives, nothing is summed up; by the exact
  arc as ours, and by Euler's step. They take as many steps as ours do on average.
- the law as document A's script writes it, robot by robot on NumPy's scalars, moved by Euler's step with
  the Jacobian S(theta) of that script; for as many steps as the robot drives in ours.
- a loop over floats with `math`, robot by robot, by the exact arc until it has arrived.

Where they end is compared with where ours end. Packages from pip move robots by constant twists, beside
`se2.integrate`, in a process of its own (peers.py); they are left out where they are missing.

Speeds are those of one core: CPU time of the process counts, so that other processes disturb little.
"""

from __future__ import annotations

import math
import statistics
import time
import tracemalloc
from collections.abc import Callable
from typing import Any, NamedTuple

import child
import numpy as np
from numpy.typing import NDArray
from peers import PEERS
from table import Goal, Row, interleave

from diffdrive_jacobian.control.goal_laws import go_to_goal
from diffdrive_jacobian.simulation.closed_loop import closed_loops

Array = NDArray[np.float64]
ROBOTS = 8192
RATE = 50.0
DT = 1.0 / RATE
KP, KV = 3.0, 0.5
TOLERANCE = 0.02
"""Of arrival; closed_loops' default (m)."""
SPEED = 'million robot-steps per second'


class Some(NamedTuple):
    """The first so many robots, as arrays."""

    starts: Array
    goals: Array
    steps: Array
    """How many each drives until it arrives."""
    ends: Array
    """Where it stands then, `[x, y, theta]`."""

    def first(self, count: int) -> Some:
        return Some(*(field[:count] for field in self))


def made(count: int) -> Some:
    """Make robots that all arrive, from a fixed seed."""
    rng = np.random.default_rng(42)
    starts = rng.uniform([-2.0, -2.0, -math.pi], [2.0, 2.0, math.pi], (count, 3))
    goals = rng.uniform(-2.0, 2.0, (count, 2))
    outcomes = closed_loops(go_to_goal, starts, goals, KP, KV, rate=RATE)
    _check('robots that arrive', bool(outcomes.arrived.all()))
    return Some(starts, goals, np.rint(outcomes.time * RATE).astype(int), outcomes.pose)


def our(robots: Some) -> float:
    """Drive robots by closed_loops."""
    begun = time.process_time()
    outcomes = closed_loops(go_to_goal, robots.starts, robots.goals, KP, KV, rate=RATE)
    taken = time.process_time() - begun
    _check('the same outcomes', bool((np.rint(outcomes.time * RATE) == robots.steps).all()))
    return float(robots.steps.sum()) / taken * 1e-6


def arrays(robots: Some, exact: bool) -> float:
    """Drive arrays of robots, all for the same steps, and nothing else."""
    x, y, theta = np.array(robots.starts.T)
    x_goal, y_goal = np.array(robots.goals.T)
    steps = round(robots.steps.mean())
    begun = time.process_time()
    for _ in range(steps):
        dx, dy = x_goal - x, y_goal - y
        c, s = np.cos(theta), np.sin(theta)
        ahead, aside = c * dx + s * dy, c * dy - s * dx
        v, omega = KV * ahead, KP * np.arctan2(aside, ahead)
        if exact:
            half = omega * (DT / 2.0)
            chord = v * DT * np.sin(half) / np.where(half == 0.0, 1.0, half)
            theta = theta + half
            x, y, theta = x + chord * np.cos(theta), y + chord * np.sin(theta), theta + half
        else:
            x, y, theta = x + v * DT * c, y + v * DT * s, theta + omega * DT
    taken = time.process_time() - begun
    there = np.hypot(x_goal - x, y_goal - y) <= TOLERANCE
    _check('arrays that arrive', bool(there[robots.steps < 0.9 * steps].all()))
    return steps * len(x) / taken * 1e-6


def script(robots: Some) -> float:
    """Drive robot by robot, in the manner of document A's script."""

    def law(state: Array, goal: Array) -> tuple[Any, Any]:
        x, y, theta = state
        x_goal, y_goal = goal
        distance = np.sqrt((x_goal - x) ** 2 + (y_goal - y) ** 2)
        error = np.arctan2(y_goal - y, x_goal - x) - theta
        error = np.arctan2(np.sin(error), np.cos(error))
        return KV * distance * np.cos(error), KP * error

    def jacobian(theta: Any) -> Array:
        return np.array([[np.cos(theta), 0.0], [np.sin(theta), 0.0], [0.0, 1.0]])

    ends = []
    begun = time.process_time()
    for state, goal, steps in zip(robots.starts, robots.goals, robots.steps, strict=True):
        for _ in range(steps):
            v, omega = law(state, goal)
            state = state + jacobian(state[2]) @ np.array([v, omega]) * DT
        ends.append(state)
    taken = time.process_time() - begun
    away = np.hypot(*(np.array(ends)[:, :2] - robots.ends[:, :2]).T)
    _check("document A's script", bool((away < TOLERANCE).all()))
    return float(robots.steps.sum()) / taken * 1e-6


def scalars(robots: Some) -> float:
    """Drive robot by robot on floats."""
    ends, driven = [], 0
    begun = time.process_time()
    for (x, y, theta), (x_goal, y_goal) in zip(
        robots.starts.tolist(), robots.goals.tolist(), strict=True
    ):
        while True:
            dx, dy = x_goal - x, y_goal - y
            if math.sqrt(dx * dx + dy * dy) <= TOLERANCE:
                break
            c, s = math.cos(theta), math.sin(theta)
            ahead, aside = c * dx + s * dy, c * dy - s * dx
            v, half = KV * ahead, KP * math.atan2(aside, ahead) * (DT / 2.0)
            chord = v * DT * (math.sin(half) / half if half else 1.0)
            theta += half
            x, y, theta = x + chord * math.cos(theta), y + chord * math.sin(theta), theta + half
            driven += 1
        ends.append((x, y))
    taken = time.process_time() - begun
    _check('the same steps', driven == robots.steps.sum())
    _check('the same ends', bool(np.allclose(ends, robots.ends[:, :2], rtol=0.0, atol=1e-9)))
    return driven / taken * 1e-6


def peak(duration: float) -> float:
    """Measure how far memory grows while robots drive that never arrive (MB)."""
    starts, goals = np.zeros((ROBOTS, 3)), np.ones((ROBOTS, 2))
    tracemalloc.start()
    try:
        outcomes = closed_loops(go_to_goal, starts, goals, KP, 0.0, rate=RATE, duration=duration)
        _check('robots that never arrive', not outcomes.arrived.any())
        return tracemalloc.get_traced_memory()[1] * 1e-6
    finally:
        tracemalloc.stop()


def _check(what: str, held: bool) -> None:
    if not held:
        raise RuntimeError(f'{what}: expected, but not found')


def rows(quick: bool) -> list[Row]:
    """Measure all sides in turn."""
    peers, missing = _peers(quick)
    return [*_speeds(2 if quick else 15), _memory(missing), *peers]


def _speeds(rounds: int) -> list[Row]:
    robots = made(ROBOTS)
    sides: dict[str, tuple[Callable[[], float], Goal | None]] = {
        'our closed_loops': (lambda: our(robots), None),
        'bare arrays, exact arc': (lambda: arrays(robots, True), None),
        "bare arrays, Euler's step": (lambda: arrays(robots, False), None),
        "document A's script, robot by robot": (
            lambda: script(robots.first(20)),
            Goal(100.0, at_most=False),
        ),
        'floats and math, robot by robot': (
            lambda: scalars(robots.first(300)),
            Goal(5.0, at_most=False),
        ),
    }
    figures = interleave(sides, rounds, lambda side: sides[side][0]())
    ours, *others = figures
    made_here = ' and '.join(f'{statistics.median(figures[side]):.1f}' for side in others[:2])
    notes = [
        f'{ours}, {ROBOTS} robots: {statistics.median(figures[ours]):.1f} {SPEED}; 10 are wanted',
        f'bare arrays make {made_here} {SPEED} here (exact arc, Euler); a prototype made 17 elsewhere',
    ]
    return [
        Row(
            group="closed loops of document A's law",
            ours=ours,
            beside=side,
            quantity=SPEED,
            pairs=list(zip(figures[ours], figures[side], strict=True)),
            goal=sides[side][1],
            digits=3 if sides[side][1] else 1,
            notes=notes,
        )
        for side in others
    ]


def _memory(notes: list[str]) -> Row:
    peak(1.0)
    short, long = 2.0, 20.0
    return Row(
        group="closed loops of document A's law",
        ours=f'our closed_loops, {long * RATE:g} steps',
        beside=f'our closed_loops, {short * RATE:g} steps',
        quantity=f'memory for {ROBOTS} robots, peak (MB)',
        pairs=[(peak(long), peak(short))],
        goal=Goal(1.02),
        digits=2,
        notes=notes,
    )


def _peers(quick: bool) -> tuple[list[Row], list[str]]:
    """Give the rows of packages from pip, and notes on those that are missing."""
    found = child.call('peers', 'measure', rounds=2 if quick else 9, seconds=0.05 if quick else 0.2)
    speeds, errors = found['speeds'], found['errors']
    quantities = {
        SPEED: lambda ours, side: list(zip(speeds[ours], speeds[side], strict=True)),
        found['arc']: lambda ours, side: [(Small(errors[ours]), Small(errors[side]))],
    }
    return [
        Row(
            group='motion by constant twists',
            ours=ours,
            beside=side,
            quantity=quantity,
            pairs=pairs(ours, side),
            digits=3,
        )
        for quantity, pairs in quantities.items()
        for side, ours in PEERS.items()
        if side in speeds
    ], [
        f'left out: {package} ({reason}); pip install {" ".join(found["missing"])}'
        for package, reason in found['missing'].items()
    ]


class Small(float):
    """A figure that is written with an exponent, whatever digits are asked for."""

    def __format__(self, _: str) -> str:
        return super().__format__('.1e')
