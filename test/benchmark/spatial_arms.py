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

"""Arms in space beside Pinocchio and roboticstoolbox: `python test/benchmark/spatial_arms.py [--quick]`.

The robots of `kinematics.spatial_arm`: Jacobians of 10,000 random configurations (with --quick 100), and
their largest difference from those of the others for the same Denavit-Hartenberg parameters; and inverse
kinematics of 10,000 poses that random joints within the limits reach, from random starts within them.
Up to 20 restarts, each search of at most 500 steps (ours all together), tolerance 1e-6. Times are CPU
times per configuration or target, in one thread.

Pinocchio has no solver of its own: it stands in the second table as the loop of its example, with the
gains of that and the limits of the joints as a check of the result. What is not installed is left out
(pip install pin roboticstoolbox-python).
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from diffdrive_jacobian.kinematics.spatial import pose_vector, pose_vector_difference
from diffdrive_jacobian.kinematics.spatial_arm import IIWA, PANDA, UR5, SpatialArm

Floats = NDArray[np.float64]
ROBOTS = {'UR5': UR5, 'Panda': PANDA, 'iiwa': IIWA}
TOLERANCE, RESTARTS, STEPS = 1e-6, 20, 500
SINGLE = 1000
"""Targets that are solved one after the other."""


class Answer(NamedTuple):
    """What was found for one target."""

    q: Floats
    steps: int


class Peer(NamedTuple):
    """Another package: makes functions of an arm."""

    package: str
    jacobian: Callable[[SpatialArm], Callable[[Floats], Floats]]
    solver: Callable[[SpatialArm], Callable[[Floats, Floats], Answer]]


# --- Pinocchio


def _pinocchio_model(arm: SpatialArm) -> tuple[Any, Any, int]:
    pin = importlib.import_module('pinocchio')
    model, parent, place = pin.Model(), 0, pin.SE3.Identity()
    for a, alpha, d, theta in zip(arm.a, arm.alpha, arm.d, arm.theta, strict=True):
        turned = pin.SE3(pin.utils.rotate('z', theta), np.zeros(3))
        parent = model.addJoint(parent, pin.JointModelRZ(), place * turned, f'joint{parent}')
        place = pin.SE3(pin.utils.rotate('x', alpha), np.array([a, 0.0, d]))
    tip = model.addFrame(pin.Frame('tip', parent, 0, place, pin.FrameType.OP_FRAME))
    return pin, model, tip


def _pinocchio_jacobian(arm: SpatialArm) -> Callable[[Floats], Floats]:
    pin, model, tip = _pinocchio_model(arm)
    data, axes = model.createData(), pin.LOCAL_WORLD_ALIGNED
    return lambda q: np.array(pin.computeFrameJacobian(model, data, q, tip, axes))


def _pinocchio_solver(arm: SpatialArm) -> Callable[[Floats, Floats], Answer]:
    pin, model, tip = _pinocchio_model(arm)
    data, step, damping = model.createData(), 0.1, 1e-12
    assert arm.limits is not None
    lower, upper = arm.limits

    def solve(target: Floats, starts: Floats) -> Answer:
        wanted, steps, q = pin.SE3(target[:3, :3], target[:3, 3]), 0, starts[0]
        for start in starts:
            q = start
            for _ in range(STEPS):
                pin.framesForwardKinematics(model, data, q)
                missing = data.oMf[tip].actInv(wanted)
                e = pin.log(missing).vector
                steps += 1
                if e @ e <= TOLERANCE**2:
                    break
                J = -pin.Jlog6(missing.inverse()) @ pin.computeFrameJacobian(
                    model, data, q, tip, pin.LOCAL
                )
                q = pin.integrate(
                    model, q, -J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), e) * step
                )
            if e @ e <= TOLERANCE**2:
                turned = q - 2.0 * np.pi * np.round((q - 0.5 * (lower + upper)) / (2.0 * np.pi))
                if np.all((turned >= lower) & (turned <= upper)):
                    return Answer(turned, steps)
        return Answer(q, steps)

    return solve


# --- roboticstoolbox


def _toolbox_chain(arm: SpatialArm) -> Any:
    toolbox = importlib.import_module('roboticstoolbox')
    links = [
        toolbox.RevoluteDH(a=a, alpha=alpha, d=d, offset=theta, qlim=limits)
        for a, alpha, d, theta, limits in zip(
            arm.a, arm.alpha, arm.d, arm.theta, np.transpose(arm.limits), strict=True
        )
    ]
    return toolbox.DHRobot(links).ets()


def _toolbox_jacobian(arm: SpatialArm) -> Callable[[Floats], Floats]:
    chain = _toolbox_chain(arm)
    return lambda q: np.asarray(chain.jacob0(q))


def _toolbox_solver(arm: SpatialArm) -> Callable[[Floats, Floats], Answer]:
    chain = _toolbox_chain(arm)

    def solve(target: Floats, starts: Floats) -> Answer:
        # It reads columns; its own restarts; its error is half the square.
        answer = chain.ik_LM(
            np.asfortranarray(target),
            **{'q0': starts[0], 'ilimit': STEPS, 'slimit': len(starts), 'tol': 0.5 * TOLERANCE**2},
            **{'joint_limits': True, 'k': 0.1, 'method': 'chan'},
        )
        return Answer(np.asarray(answer.q).reshape(-1), int(np.sum(answer.iterations)))

    return solve


PEERS = {
    'Pinocchio': Peer('pinocchio', _pinocchio_jacobian, _pinocchio_solver),
    'roboticstoolbox': Peer('roboticstoolbox', _toolbox_jacobian, _toolbox_solver),
}

# --- Tables


def within(arm: SpatialArm, rng: np.random.Generator, count: int) -> Floats:
    """Return random joints within the limits, at most half a turn from 0."""
    assert arm.limits is not None
    lower, upper = np.clip(arm.limits, -np.pi, np.pi)
    return rng.uniform(lower, upper, (count, arm.joints))


def error(arm: SpatialArm, q: Floats, targets: Floats) -> Floats:
    """Return what is missing, as checked here; infinite beyond the limits."""
    assert arm.limits is not None
    missing = pose_vector_difference(pose_vector(targets), pose_vector(arm.forward_kinematics(q)))
    inside = np.all((q >= arm.limits[0] - 1e-9) & (q <= arm.limits[1] + 1e-9), axis=-1)
    return np.asarray(np.where(inside, np.linalg.norm(missing, axis=-1), np.inf))


def jacobians(count: int, peers: dict[str, Peer]) -> Table:
    """Compare Jacobians."""
    made = Table(title=f'Jacobians of {count} configurations')
    for heading in ('robot', 'package', 'largest difference', 'us each, one by one', 'in a batch'):
        made.add_column(heading, justify='left' if heading in ('robot', 'package') else 'right')
    rng = np.random.default_rng(7)
    for name, arm in ROBOTS.items():
        q = within(arm, rng, count)
        began = time.process_time()
        ours = arm.jacobian(q)
        batch = (time.process_time() - began) / count
        some = q[:SINGLE]
        began = time.process_time()
        for one in some:
            arm.jacobian(one)
        single = (time.process_time() - began) / len(some)
        made.add_row(name, 'ours', '-', f'{1e6 * single:.1f}', f'{1e6 * batch:.1f}')
        for package, peer in peers.items():
            jacobian = peer.jacobian(arm)
            jacobian(q[0])
            began = time.process_time()
            theirs = [jacobian(one) for one in q]
            took = (time.process_time() - began) / count
            made.add_row(name, package, f'{abs(ours - theirs).max():.1e}', f'{1e6 * took:.1f}', '-')
        made.add_section()
    return made


def searches(count: int, peers: dict[str, Peer]) -> Table:
    """Compare inverse kinematics."""
    made = Table(title=f'Inverse kinematics of {count} reachable poses within the limits')
    for heading in ('robot', 'package', 'found (%)', 'not found', 'steps: median', '95 %', 'ms each'):
        made.add_column(heading, justify='left' if heading in ('robot', 'package') else 'right')
    for name, arm in ROBOTS.items():
        rng = np.random.default_rng(11)
        q, q0 = within(arm, rng, count), within(arm, rng, count)
        targets = arm.forward_kinematics(q)
        more = within(arm, rng, RESTARTS)
        began = time.process_time()
        result = arm.inverse_kinematics(
            targets, q0, restarts=RESTARTS, max_iterations=STEPS * (RESTARTS + 1), tolerance=TOLERANCE
        )
        took = (time.process_time() - began) / count
        row(made, name, 'ours, in a batch', error(arm, result.q, targets), result.iterations, took)
        some = min(count, SINGLE)
        began = time.process_time()
        for target, start in zip(targets[:some], q0, strict=False):
            arm.inverse_kinematics(target, start, restarts=RESTARTS, tolerance=TOLERANCE)
        made.add_row(
            name,
            f'ours, one by one ({some})',
            *['-'] * 4,
            f'{1e3 * (time.process_time() - began) / some:.2f}',
        )
        for package, peer in peers.items():
            solve = peer.solver(arm)
            solve(targets[0], q0[:1])
            began = time.process_time()
            answers = [
                solve(target, np.concatenate([start[np.newaxis], more]))
                for target, start in zip(targets, q0, strict=True)
            ]
            took = (time.process_time() - began) / count
            off = error(arm, np.array([answer.q for answer in answers]), targets)
            row(made, name, package, off, np.array([answer.steps for answer in answers]), took)
        made.add_section()
    return made


def row(made: Table, name: str, package: str, off: Floats, steps: Any, took: float) -> None:
    """Add a row. A part in a thousand for rounding: forward kinematics are not the peer's own."""
    found = off <= 1.001 * TOLERANCE
    made.add_row(
        *(name, package, f'{100.0 * found.mean():.2f}', f'{(~found).sum()}'),
        *(f'{np.median(steps):.0f}', f'{np.percentile(steps, 95):.0f}', f'{1e3 * took:.2f}'),
    )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--quick', action='store_true', help='100 configurations each, to try it')
    count = 100 if parser.parse_args().quick else 10_000
    if not os.environ.get('OPENBLAS_NUM_THREADS'):
        # Read when NumPy is imported.
        os.environ['OPENBLAS_NUM_THREADS'] = '1'
        os.execv(sys.executable, [sys.executable, *sys.argv])
    console, peers = Console(width=110), {}
    for name, peer in PEERS.items():
        try:
            module = importlib.import_module(peer.package)
        except ImportError as missing:
            console.print(f'left out: {name} ({missing})', highlight=False)
        else:
            peers[name] = peer
            console.print(f'{name} {module.__version__}', highlight=False)
    console.print(jacobians(count, peers))
    console.print(searches(count, peers))


if __name__ == '__main__':
    main()
