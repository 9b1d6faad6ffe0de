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

"""Draw a picture of the documents."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from diffdrive_jacobian import plots
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.numerics.checks import short
from diffdrive_jacobian.plots.output_files import FORMATS, extension, new_file
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from diffdrive_jacobian.kinematics.spatial_arm import SpatialArm

PROGRAM = 'plot_jacobian'
OPTIONS = {
    '--lengths': ('arm_at', 'arm_ellipses', 'damping'),
    '--dh': ('arm_at',),
    '--q': ('arm_at',),
}
"""The pictures for which an option is."""
PARAMETERS = {'a', 'alpha', 'd', 'theta', 'prismatic'}


@_output.tool(PROGRAM)
def main(words: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    parser = _parser()
    options = parser.parse(words, ros=False)
    _check(parser, options)
    output = f'{options.name}.png' if options.output is None else options.output
    path = new_file(output, FORMATS, 'picture', replace=options.force)
    arguments = _arguments(options)

    def draw() -> Figure:
        try:
            return cast('Figure', getattr(plots, options.name)(**arguments))
        except ValueError as error:
            raise UserError(str(error)) from error

    _output.write(path, _output.drawn(PROGRAM, signals, extension(path), draw), replace=options.force)
    _output.say(path)
    return DONE


def _check(parser: _cli.Parser, options: argparse.Namespace) -> None:
    """Refuse options that have no effect, or exclude each other."""
    for option, values in (('--lengths', options.lengths), ('--dh', options.dh), ('--q', options.q)):
        pictures = OPTIONS[option]
        if values is not None and options.name not in pictures:
            parser.error(f'{option} has no effect with {options.name}, but with {", ".join(pictures)}')
    if options.lengths is not None and options.dh is not None:
        parser.error('--lengths and --dh exclude each other')


def _arguments(options: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of the picture.

    Raises:
        UserError: The file has no arm, or the joints are not those of it.
    """
    from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

    if options.name != 'arm_at':
        return {} if options.lengths is None else {'lengths': options.lengths}
    found: dict[str, Any] = {}
    if options.lengths is not None:
        found['arm'] = PlanarArm(options.lengths)
    if options.dh is not None:
        found['arm'] = _read_arm(options.dh)
    if options.q is not None:
        found['q'] = options.q
    return found


def _read_arm(path: str) -> SpatialArm:
    """Read the map of the parameters a, alpha, d, and perhaps theta and prismatic, from YAML.

    Raises:
        UserError: The file cannot be read, or has none.
    """
    from diffdrive_jacobian.kinematics.spatial_arm import SpatialArm
    from diffdrive_jacobian.safe_yaml import YAML_ERRORS, load_yaml

    allowed = 'a map with a, alpha and d, and perhaps theta and prismatic'
    try:
        found = load_yaml(Path(path))
        if not isinstance(found, dict) or not {'a', 'alpha', 'd'} <= found.keys() <= PARAMETERS:
            raise UserError(f'--dh {path} must be {allowed}, got {short(found, repr)}')
        return SpatialArm(**found)
    except OSError as error:
        raise UserError(f'--dh {path} cannot be read: {error.strerror or error}') from error
    except (TypeError, *YAML_ERRORS) as error:
        why = printable(' '.join(str(error).split()), 200)
        raise UserError(f'--dh {path} must be {allowed}: {why}') from error


def _name(text: str) -> str:
    """Parse the name of a picture."""
    if text not in plots.PICTURES:
        raise argparse.ArgumentTypeError(f'must be one of {", ".join(plots.PICTURES)}, got {text!r}')
    return text


def _parser() -> _cli.Parser:
    width = max(map(len, plots.PICTURES))
    pictures = '\n'.join(f'  {name:{width}}  {what}' for name, what in plots.PICTURES.items())
    parser = _cli.Parser(
        prog=PROGRAM,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Draw a picture of the documents, to scale and computed by the library:\n\n'
        f'{pictures}\n\n'
        'An existing file is not overwritten without --force. Exit code 0: drawn; 1: the file cannot\n'
        'be written; 2: wrong arguments, or no matplotlib; 130: interrupted.',
    )
    parser.add_argument('name', metavar='NAME', type=_name, help='the picture, one of those above')
    parser.add_argument(
        '--lengths',
        metavar='M',
        nargs='+',
        type=_cli.positive,
        help=f'lengths of the links, for {", ".join(OPTIONS["--lengths"])} (m)',
    )
    parser.add_argument(
        '--dh',
        metavar='FILE',
        help='standard Denavit-Hartenberg parameters of an arm in space (YAML: a, alpha, d, and perhaps '
        'theta and prismatic), for arm_at (m, rad)',
    )
    parser.add_argument(
        '--q', metavar='Q', nargs='+', type=_cli.number, help='joints, for arm_at (rad, or m)'
    )
    parser.add_output('FILE', f'file to write, .{", .".join(FORMATS)} (default: NAME.png)')
    parser.add_force('the file')
    return parser
