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

"""Estimate wheel radii and wheel separation from recorded drives with a reference of the pose."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from diffdrive_jacobian.calibration import Calibration, Geometry, Given, calibrate
from diffdrive_jacobian.calibration.data import (
    WheelsAndReference,
    read_wheels_and_reference,
)
from diffdrive_jacobian.calibration.description import (
    describe,
    explain_undetermined,
    parameter_file,
)
from diffdrive_jacobian.calibration.model import GIVEN_NOISE
from diffdrive_jacobian.errors import NotDoneError, UserError
from diffdrive_jacobian.numerics.checks import between
from diffdrive_jacobian.plots.calibration_pictures import calibration_figure
from diffdrive_jacobian.plots.output_files import cannot_write, create, new_file
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE

PROGRAM = 'calibrate_run'
ENDINGS = ('yaml', 'yml')
RADIUS_BOUNDS, SEPARATION_BOUNDS = (1e-3, 10.0), (1e-3, 100.0)
"""Nominal dimensions that the nodes accept (m)."""
GIVEN = ('yaw_offset', 'time_offset', 'wheel_noise', 'position_noise', 'heading_noise')
"""Options that are fields of `Given`."""


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool and return its exit code."""
    options = _parser().parse(arguments, ros=False)
    bags = _cli.given_bags(options)
    output, picture = _outputs(options, bags)
    read: list[WheelsAndReference] = []
    for bag in bags:
        read.append(
            read_wheels_and_reference(
                bag,
                wheels=options.wheels_topic,
                reference=options.reference,
                names=None if options.wheels is None else tuple(options.wheels),
                interrupted=lambda: signals.count > 0,
            )
        )
        for note in read[-1].notes:
            _output.note(PROGRAM, f'{bag}: {note}')
    nominal = _nominal(options, read)
    lever_arm = None if options.lever_arm is None else tuple(options.lever_arm)
    given = Given(lever_arm=lever_arm, **{name: getattr(options, name) for name in GIVEN})
    result = calibrate([one.recording for one in read], nominal, given)
    for note in result.notes:
        _output.note(PROGRAM, note)
    _output.check(signals, 'nothing was written')
    _print_summary(result, read)
    if missing := explain_undetermined(result):
        raise NotDoneError(f'{missing}. Nothing was written')
    _write(result, read, output, picture, signals, replace=options.force)
    return DONE


def _print_summary(result: Calibration, read: Sequence[WheelsAndReference]) -> None:
    for one, offset in zip(read, result.clocks[:, 0].tolist(), strict=True):
        recording = one.recording
        begin = max(recording.wheel_time[0], recording.pose_time[0] + offset)
        end = min(recording.wheel_time[-1], recording.pose_time[-1] + offset)
        left, right = map(printable, one.wheel_names)
        print(
            f'{recording.name}: {end - begin:.1f} s, {len(recording.pose_time)} poses on '
            f'{printable(one.reference_topic)}, {len(recording.wheel_time)} samples of {left} and '
            f'{right} on {printable(one.wheels_topic)}'
        )
    print(*describe(result), sep='\n')


def _write(
    result: Calibration,
    read: Sequence[WheelsAndReference],
    output: Path,
    picture: Path | None,
    signals: Signals,
    *,
    replace: bool,
) -> None:
    """Write the parameter file and the picture, and print their names."""
    names = ', '.join(printable(Path(one.recording.name).name) for one in read)
    files: list[tuple[Path, bytes]] = [(output, parameter_file(result, names).encode())]
    if picture is not None:
        try:
            drawn = _output.drawn(PROGRAM, signals, 'png', lambda: calibration_figure(result))
            files.append((picture, drawn))
        except UserError as error:
            _output.note(PROGRAM, f'not drawn: {error}')
    done: list[Path] = []
    for path, data in files:
        try:
            create(path, data, replace=replace)
        except OSError as error:
            what = '; nothing was written'
            if replace:
                what = f'; written: {", ".join(map(str, done)) or "nothing"}'
            else:
                for one in done:
                    one.unlink(missing_ok=True)
            raise cannot_write(path, error, what) from error
        done.append(path)
    for path in done:
        _output.say(path)


def _outputs(options: argparse.Namespace, bags: Sequence[Path]) -> tuple[Path, Path | None]:
    """Return the paths of the parameter file and of the picture.

    Raises:
        UserError, NotDoneError: As for `new_file`.
    """
    name = options.output
    if name is None:
        stem = '_and_'.join(bag.resolve().name for bag in bags)
        name = str(bags[0].resolve().parent / f'{stem}_calibration.yaml')
    output = new_file(name, ENDINGS, 'parameter file', replace=options.force)
    picture = None
    if not options.no_plot:
        path = os.path.splitext(name)[0] + '.png'
        picture = new_file(path, ('png',), 'picture', replace=options.force)
    return output, picture


def _nominal(options: argparse.Namespace, read: Sequence[WheelsAndReference]) -> Geometry:
    """Return the nominal dimensions, of the options or of the parameters in the bags.

    Raises:
        UserError: They are unknown, out of range, or differ between the bags.
    """
    radius, separation = options.wheel_radius, options.wheel_separation
    if radius is None or separation is None:
        recorded = {one.dimensions for one in read if one.dimensions is not None}
        if len(recorded) > 1:
            listed = ', '.join(f'{r:g} and {s:g} m' for r, s in sorted(recorded))
            raise UserError(
                f'the bags have several wheel radii and separations, {listed}: choose with '
                '--wheel-radius and --wheel-separation'
            )
        if not recorded:
            raise UserError(
                'the bag has no parameters wheel_radius and wheel_separation of a node: both must be '
                'given with --wheel-radius and --wheel-separation'
            )
        known = recorded.pop()
        radius = known[0] if radius is None else radius
        separation = known[1] if separation is None else separation
    try:
        between(*RADIUS_BOUNDS, unit='m')('the wheel radius', radius)
        between(*SEPARATION_BOUNDS, unit='m')('the wheel separation', separation)
    except ValueError as error:
        raise UserError(str(error)) from error
    return Geometry(wheel_radius=radius, wheel_separation=separation)


def _noise(name: str) -> Callable[[str], float]:
    return _cli.number_that(between(*GIVEN_NOISE[name]))


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        description='Estimate the wheel radii and the wheel separation of a robot from recorded drives '
        'with a reference of its pose, such as motion capture or SLAM. Writes the multipliers of '
        'virtual_robot, wheel_bridge and diff_drive_controller as a parameter file, and a picture. '
        'Existing files are not overwritten. Exit code 0: calibrated; 1: the drives do not determine '
        'the parameters, contradict each other, or a file cannot be written; 2: wrong arguments, or a '
        'bag cannot be read; 130: interrupted.',
    )
    parser.add_bags()
    parser.add_output(
        'FILE',
        'parameter file to write, .yaml; the picture is FILE.png (default: BAG_calibration.yaml '
        'beside the first bag)',
    )
    parser.add_argument('--no-plot', action='store_true', help='do not draw')
    parser.add_force('the parameter file and the picture')
    parser.add_argument(
        '--reference',
        metavar='TOPIC',
        help='topic of the reference: Odometry, PoseStamped or PoseWithCovarianceStamped (default: '
        'ground_truth, or the only topic of poses)',
    )
    parser.add_argument(
        '--wheels-topic',
        metavar='TOPIC',
        help='topic of the wheels, JointState; positions are preferred to velocities (default: '
        'joint_states)',
    )
    parser.add_argument(
        '--wheels',
        metavar=('LEFT', 'RIGHT'),
        nargs=2,
        help='joints of the left and the right wheel (default: from the parameters in the bag, or the '
        'joints with left and right in their names)',
    )
    for name in ('radius', 'separation'):
        text = f'nominal wheel {name} (m) (default: from the parameters in the bag)'
        parser.add_value(f'--wheel-{name}', 'M', text)
    parser.add_argument(
        '--lever-arm',
        metavar=('X', 'Y'),
        nargs=2,
        type=_cli.coordinate,
        help='position of the sensor in the body frame (m) (default: estimated)',
    )
    for name, unit, kind, text in (
        ('yaw-offset', 'RAD', _cli.angle, 'heading of the sensor in the body frame (rad)'),
        ('time-offset', 'SECONDS', _cli.number, 'added to the times of the reference (s)'),
        (
            'wheel-noise',
            'M',
            _noise('wheel_noise'),
            'variance of the distance travelled by a wheel, per distance (m)',
        ),
        (
            'position-noise',
            'M',
            _noise('position_noise'),
            'standard deviation of the positions of the reference (m)',
        ),
        (
            'heading-noise',
            'RAD',
            _noise('heading_noise'),
            'standard deviation of the headings of the reference (rad)',
        ),
    ):
        parser.add_value(f'--{name}', unit, f'{text} (default: estimated)', kind=kind)
    return parser
