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

"""Verify that a robot still moves as recorded: simulate a run again and compare it with its odometry."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from diffdrive_jacobian.bags.run import read_run
from diffdrive_jacobian.bags.verification import (
    BY_RECORDING_TIME,
    COVARIANCE_TOLERANCE,
    EXACT,
    Verification,
    verify,
)
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.file import robot_parameters
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE, FAILED

PROGRAM = 'verify_run'


def report(verification: Verification, tolerance: float, yaw_tolerance: float) -> str:
    """Return lines about the differences, with the largest allowed ones (m, rad)."""
    lines = [
        f'{len(verification.seconds)} odometry messages, commands from {verification.source}, '
        f'starting at the first {verification.start}',
        *(f'note: {note}' for note in verification.notes),
        *(f'missing: {one}' for one in verification.missing),
    ]
    for name, unit, values, allowed in (
        ('position', 'm', verification.distances, tolerance),
        ('heading', 'rad', verification.headings, yaw_tolerance),
        ('v', 'm/s', verification.speeds, tolerance),
        ('omega', 'rad/s', verification.turn_rates, yaw_tolerance),
    ):
        if values is None:
            continue
        worst = int(np.argmax(values))
        rms = float(np.sqrt(np.mean(values**2)))
        lines.append(
            f'{name}: maximum error {values[worst]:.3g} {unit} at {verification.seconds[worst]:.3f} s; '
            f'RMS {rms:.3g} {unit}; allowed {allowed:g} {unit}'
        )
        beyond = np.flatnonzero(values > allowed)
        if len(beyond):
            first = verification.seconds[beyond[0]]
            lines.append(f'{name}: exceeded in {len(beyond)} messages, first at {first:.3f} s')
    if (difference := verification.covariance_difference) is not None:
        exact = '' if difference <= COVARIANCE_TOLERANCE else 'not '
        lines.append(
            f'covariance: {exact}the exact moments of the noise model; '
            f'maximum relative difference {difference:.3g}'
        )
    if (truth := verification.truth) is not None:
        lines.append(
            f'ground truth: maximum error {np.max(truth.distances):.3g} m, '
            f'{np.max(truth.headings):.3g} rad, {np.max(truth.speeds):.3g} m/s, '
            f'{np.max(truth.turn_rates):.3g} rad/s in {len(truth.distances)} messages'
        )
    if not verification.agrees(tolerance, yaw_tolerance):
        verdict = 'the robot moves NOT as recorded'
    elif verification.missing:
        verdict = 'NOT verified: what was recorded agrees, but the recording is not whole'
    else:
        verdict = 'the robot moves as recorded'
    return '\n'.join([*lines, verdict])


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool and return its exit code."""
    return _run(PROGRAM, _parser().parse(arguments, ros=False), signals)


def run_as_option(program: str, option: str, arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool as an option of another one, and return the exit code.

    Args:
        program: Name of the other tool.
        option: The option.
        arguments: The other arguments; those that this tool does not have are refused.
        signals: Counter of the signals.
    """
    parser = _parser(program, option)
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        parser.error(f'not allowed with {option}: {" ".join(word.strip() for word in unknown)}')
    return _run(program, options, signals)


def _run(program: str, options: argparse.Namespace, signals: Signals) -> int:
    def interrupted() -> bool:
        return signals.count > 0

    parameters = None if options.params_file is None else robot_parameters(options.params_file)
    with _output.busy(program, f'reading {options.bag}'):
        run = read_run(options.bag, namespace=options.namespace, interrupted=interrupted)
    if parameters is not None and len(run.cmd_vel_out):
        raise UserError(
            '--params-file and --robot have no effect: the bag has cmd_vel_out, the commands as the '
            'robot applied them'
        )
    with _output.busy(program, 'simulating the run'):
        verification = verify(run, parameters, interrupted=interrupted)
    allowed = verification.allowed
    tolerance = allowed if options.tolerance is None else options.tolerance
    yaw_tolerance = allowed if options.yaw_tolerance is None else options.yaw_tolerance
    print(report(verification, tolerance, yaw_tolerance))
    return DONE if verification.holds(tolerance, yaw_tolerance) else FAILED


def _parser(program: str = PROGRAM, option: str = '') -> _cli.Parser:
    parser = _cli.Parser(
        prog=program,
        usage=' '.join([program, *option.split(), 'BAG [options]']),
        description='Simulate a recorded run again from its commands, and compare poses and velocities '
        'with the recorded odometry. Nothing is published, and no ROS is needed. Exit code 0: the robot '
        'moves as recorded; 1: it does not, or messages are missing; 2: wrong arguments, or the bag '
        'cannot be read; 130: interrupted.',
    )
    parser.add_bag()
    default = f'{EXACT:g} if cmd_vel_out was recorded, else {BY_RECORDING_TIME:g}'
    for name, unit, of in (
        ('--tolerance', 'M', 'position in m and of v in m/s'),
        ('--yaw-tolerance', 'RAD', 'heading in rad and of omega in rad/s'),
    ):
        parser.add_value(name, unit, f'largest allowed difference of the {of} (default: {default})')
    parser.add_params_file(
        'ROS parameters of virtual_robot (YAML), if cmd_vel_out was not recorded '
        '(default: those recorded in the bag)'
    )
    parser.add_namespace()
    return parser
