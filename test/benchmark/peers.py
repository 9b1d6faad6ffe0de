"""Packages that pip installs beside `se2.integrate`: unicycles that are moved by constant twists.

- ir-sim: `irsim.lib.algorithm.kinematics.differential_kinematics`, robot by robot.
- roboticstoolbox-python: `roboticstoolbox.mobile.Unicycle`, moved by its `step` as its simulation does,
  and by its `f`, which moves all robots at once by the same odometry (for its particle filter).

All of them take Euler's step. They are heavy, print while they are imported, and choose a backend of
matplotlib and filters of warnings for the whole process: this runs as a child (see child.py).
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from table import interleave

V, OMEGA, DT, STEPS = 0.22, 0.5, 0.02, 3000
ROBOTS = 8192
OURS, OURS_ALIKE = 'our integrate', 'our integrate, one twist for all'
PEERS = {
    'ir-sim differential_kinematics': OURS,
    'roboticstoolbox Unicycle.step': OURS,
    'roboticstoolbox Unicycle.f, one twist for all': OURS_ALIKE,
}
"""What is measured, and which of ours is beside it."""
IRSIM, STEP, F = PEERS

Move = Callable[[int, int], Any]
"""Moves so many robots for so many steps; gives where one of them ends that was at [0, 0, 0]."""


def measure(rounds: int, seconds: float) -> dict[str, Any]:
    """Measure all that can be imported.

    Gives speeds (million robot-steps per second of CPU time, for every round) and errors (m) of each
    side, what was driven for the errors, and why a package is missing.
    """
    moves, missing = _sides()
    errors = {}
    for side, move in moves.items():
        x, y, *_ = move(1, STEPS)
        radius, turn = V / OMEGA, OMEGA * DT * STEPS
        errors[side] = math.hypot(x - radius * math.sin(turn), y - radius * (1.0 - math.cos(turn)))
        if not errors[side] < 0.01:
            raise RuntimeError(f'{side} ends {errors[side]} m from the closed form')

    def speed(side: str) -> float:
        batch = (1, 500) if side in (IRSIM, STEP) else (ROBOTS, 20)
        done, begun = 0, time.process_time()
        while (taken := time.process_time() - begun) < seconds:
            moves[side](*batch)
            done += math.prod(batch)
        return done / taken * 1e-6

    return {
        'speeds': interleave(moves, rounds, speed),
        'errors': errors,
        'arc': f'error after {STEPS * DT:g} s of {V:g} m/s, {OMEGA:g} rad/s at {1.0 / DT:g} Hz (m)',
        'missing': missing,
    }


def _sides() -> tuple[dict[str, Move], dict[str, str]]:
    os.environ['MPLBACKEND'] = 'Agg'
    moves: dict[str, Move] = {}
    missing = {}
    try:
        moves[IRSIM] = _irsim()
    except ImportError as error:
        missing['ir-sim'] = str(error)
    try:
        moves[STEP], moves[F] = _roboticstoolbox()
    except ImportError as error:
        missing['roboticstoolbox-python'] = str(error)
    ours = {OURS: _ours(alike=False), OURS_ALIKE: _ours(alike=True)}
    return {side: ours[side] for side in dict.fromkeys(PEERS[peer] for peer in moves)} | moves, missing


def _starts(robots: int) -> Any:
    """Give poses at the origin, the first of them [0, 0, 0]."""
    return np.stack([*np.zeros((2, robots)), np.linspace(0.0, 3.0, robots)], axis=-1)


def _ours(alike: bool) -> Move:
    from diffdrive_jacobian.kinematics.se2 import integrate

    def move(robots: int, steps: int) -> Any:
        pose = _starts(robots)
        twist = np.array([V, OMEGA]) if alike else np.tile([V, OMEGA], (robots, 1))
        for _ in range(steps):
            pose = integrate(pose, twist, DT)
        return pose[0]

    return move


def _irsim() -> Move:
    from irsim.lib.algorithm.kinematics import differential_kinematics

    def move(robots: int, steps: int) -> Any:
        for _ in range(robots):
            state, velocity = np.zeros((3, 1)), np.array([[V], [OMEGA]])
            for _ in range(steps):
                state = differential_kinematics(state, velocity, DT)
        return state[:, 0]

    return move


def _roboticstoolbox() -> tuple[Move, Move]:
    from roboticstoolbox.mobile import Unicycle

    robot = Unicycle(dt=DT)

    def step(robots: int, steps: int) -> Any:
        for _ in range(robots):
            robot.init(x0=np.zeros(3), animate=False)
            for _ in range(steps):
                robot.step((V, OMEGA), animate=False)
        return robot.x

    def f(robots: int, steps: int) -> Any:
        states, odometry = _starts(robots), (V * DT, OMEGA * DT)
        for _ in range(steps):
            states = robot.f(states, odometry)
        return states[0]

    return step, f
