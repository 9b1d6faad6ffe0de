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

"""Inverse kinematics of planar arms by other packages, one target after the other.

Each peer searches from the start that is given, then from up to `restarts` random ones; a step is one
evaluation of the error, or what the peer itself reports. All stop at the same error. Positions, or
positions and headings. `available()` imports what is installed.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

Floats = NDArray[np.float64]
STEPS = 500
"""Of one search at the most."""


class Answer(NamedTuple):
    """What a peer found for one target."""

    q: Floats
    steps: int
    searches: int
    """The starts that were used."""


class Measured(NamedTuple):
    """What a peer found for many, as checked here, not as it says itself."""

    found: NDArray[np.bool_]
    first: NDArray[np.bool_]
    """Whether the first search was enough."""
    steps: NDArray[np.int64]
    seconds: float
    """CPU time per target."""


class Peer(NamedTuple):
    """A package, and how it is asked: `make(lengths, heading, tolerance)` gives a function of target,
    starts, which returns an answer.
    """

    name: str
    package: str
    make: Callable[[Any, bool, float], Callable[[Floats, Floats], Answer]]


def measure(
    peer: Peer,
    lengths: list[float],
    heading: bool,
    targets: Floats,
    q0: Floats,
    restarts: int,
    tolerance: float,
) -> Measured:
    """Solve for every target, shape (k, 3), from q0, shape (k, n), and shared restart points."""
    n = len(lengths)
    more = np.random.default_rng(0).uniform(-np.pi, np.pi, (restarts, n))
    solve = peer.make(lengths, heading, tolerance)
    solve(targets[0], np.concatenate([q0[:1], more]))
    began = time.process_time()
    answers = [
        solve(target, np.concatenate([start[np.newaxis], more]))
        for target, start in zip(targets, q0, strict=True)
    ]
    took = (time.process_time() - began) / len(targets)
    reached = PlanarArm(lengths).forward_kinematics(np.stack([answer.q for answer in answers]))
    off = targets - reached
    off[:, 2] = np.angle(np.exp(1j * off[:, 2])) if heading else 0.0
    # A thousandth for rounding, as forward kinematics are not the peer's own.
    found = np.linalg.norm(off, axis=1) <= 1.001 * tolerance
    first = found & np.array([answer.searches == 1 for answer in answers])
    return Measured(found, first, np.array([answer.steps for answer in answers]), took)


class _Arm:
    """Error and Jacobian of one configuration, without checks of arguments."""

    def __init__(self, lengths: Any, heading: bool) -> None:
        self.lengths, self.heading = np.asarray(lengths, dtype=np.float64), heading

    def error(self, q: Floats, target: Floats) -> Floats:
        angles = np.cumsum(q)
        x, y = self.lengths @ np.cos(angles) - target[0], self.lengths @ np.sin(angles) - target[1]
        if not self.heading:
            return np.array([x, y])
        return np.array([x, y, math.remainder(angles[-1] - target[2], math.tau)])

    def jacobian(self, q: Floats, *_: Any) -> Floats:
        angles = np.cumsum(q)
        J = np.ones((3 if self.heading else 2, len(q)))
        J[0] = -np.cumsum((self.lengths * np.sin(angles))[::-1])[::-1]
        J[1] = np.cumsum((self.lengths * np.cos(angles))[::-1])[::-1]
        return J


class _ReachedError(Exception):
    """Raised out of SciPy when the error is small enough: it knows no such criterion."""


def _scipy(lengths: Any, heading: bool, tolerance: float) -> Callable[[Floats, Floats], Answer]:
    least_squares = importlib.import_module('scipy.optimize').least_squares
    arm = _Arm(lengths, heading)

    def solve(target: Floats, starts: Floats) -> Answer:
        steps, last = 0, starts[0]

        def error(q: Floats) -> Floats:
            nonlocal steps, last
            e, steps, last = arm.error(q, target), steps + 1, q
            if e @ e <= tolerance**2:
                raise _ReachedError
            return e

        search = 0
        for start in starts:
            search += 1
            try:
                options = {'ftol': 1e-15, 'xtol': 1e-15, 'gtol': 1e-15}
                least_squares(error, start, arm.jacobian, max_nfev=STEPS, **options)
            except _ReachedError:
                break
        return Answer(last.copy(), steps, search)

    return solve


def _pinocchio(lengths: Any, heading: bool, tolerance: float) -> Callable[[Floats, Floats], Answer]:
    """The loop and gains of Pinocchio's own example (CLIK), for it has no solver."""
    pin = importlib.import_module('pinocchio')
    model, parent, place = pin.Model(), 0, pin.SE3.Identity()
    for index, length in enumerate(lengths):
        parent = model.addJoint(parent, pin.JointModelRZ(), place, f'joint{index}')
        place = pin.SE3(np.eye(3), np.array([length, 0.0, 0.0]))
    tip = model.addFrame(pin.Frame('tip', parent, 0, place, pin.FrameType.OP_FRAME))
    data = model.createData()
    rows = [0, 1, 5] if heading else [0, 1]
    step, damping = 0.1, 1e-12

    def solve(target: Floats, starts: Floats) -> Answer:
        steps, q = 0, starts[0]
        for search, start in enumerate(starts, 1):
            q = start
            for _ in range(STEPS):
                pin.framesForwardKinematics(model, data, q)
                pose = data.oMf[tip]
                e = pose.translation[:2] - target[:2]
                if heading:
                    angle = math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])
                    e = np.append(e, math.remainder(angle - target[2], math.tau))
                steps += 1
                if e @ e <= tolerance**2:
                    return Answer(q, steps, search)
                J = pin.computeFrameJacobian(model, data, q, tip, pin.LOCAL_WORLD_ALIGNED)[rows]
                v = -J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(rows)), e)
                q = pin.integrate(model, q, v * step)
        return Answer(q, steps, search)

    return solve


def _roboticstoolbox(
    lengths: Any, heading: bool, tolerance: float
) -> Callable[[Floats, Floats], Answer]:
    ET = importlib.import_module('roboticstoolbox').ET
    chain: Any = None
    for length in lengths:
        # From the left, one by one: products of chains number their joints anew.
        chain = (ET.Rz() if chain is None else chain * ET.Rz()) * ET.tx(length)
    mask = np.array([1.0, 1.0, 0.0, 0.0, 0.0, float(heading)])

    def solve(target: Floats, starts: Floats) -> Answer:
        c, s = math.cos(target[2]), math.sin(target[2])
        pose = np.eye(4, order='F')  # it reads columns
        pose[:2] = [[c, -s, 0.0, target[0]], [s, c, 0.0, target[1]]]
        # Its own restarts; its error is half the square.
        answer = chain.ik_LM(
            pose,
            q0=starts[0],
            ilimit=STEPS,
            slimit=len(starts),
            tol=0.5 * tolerance**2,
            mask=mask,
            joint_limits=False,
            k=0.1,
            method='chan',
        )
        return Answer(np.asarray(answer[0]), int(answer[2]), int(answer[3]))

    return solve


PEERS = (
    Peer('scipy.optimize.least_squares', 'scipy', _scipy),
    Peer("Pinocchio's example loop", 'pinocchio', _pinocchio),
    Peer('roboticstoolbox ik_LM', 'roboticstoolbox', _roboticstoolbox),
)


def available(packages: list[str]) -> tuple[list[Peer], list[str]]:
    """Return those of the peers that can be imported, and what to say of all of them."""
    there, notes = [], []
    for peer in PEERS:
        if peer.package not in packages:
            continue
        try:
            module = importlib.import_module(peer.package)
        except ImportError as error:
            notes.append(f'left out: {peer.name} ({error})')
        else:
            there.append(peer)
            notes.append(f'{peer.package} {module.__version__}')
    return there, notes
