"""The options of the tools: what several tools have, and the types of their arguments.

Each `add_...` adds an option with its name, type, check and help, so that it is the same in every tool.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.conversion import MAX_PATH_POSES, MAX_POSITION
from diffdrive_jacobian.numerics import fields
from diffdrive_jacobian.numerics.fields import Check, between, finite, inside, integer, one_of
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.file import configurations
from diffdrive_jacobian.tools._cli import ROS_HINT, is_number

if TYPE_CHECKING:
    from diffdrive_jacobian.control import Path as PlannedPath

T = TypeVar('T')

STORAGES = ('mcap', 'sqlite3')
"""File formats of bags."""
MAX_PORT = 65535

# --- Types of arguments


def number(text: str) -> float:
    """Parse a finite number."""
    text = text.strip()
    if not is_number(text):
        hint = f' ({ROS_HINT})' if ':=' in text else ''
        raise argparse.ArgumentTypeError(f'must be a number, got {text!r}{hint}')
    return _checked(finite, float(text))


def number_that(check: Check) -> Callable[[str], float]:
    """Return a type of arguments: the finite numbers that a check accepts."""
    return lambda text: _checked(check, number(text))


def integer_from(low: int, high: float = math.inf) -> Callable[[str], int]:
    """Return a type of arguments: integers from `low` to `high`."""
    check = partial(integer, low=low, high=high)
    # Python reads more as an integer than people write on a command line.

    def parse(text: str) -> int:
        text = text.strip()
        # Python reads more as an integer than people write on a command line.
        value = int(text) if re.fullmatch('-?[0-9]{1,99}', text) else text
        return int(_checked(check, value))

    return parse


def _checked(check: Check, value: T) -> T:
    """Return a value that a check accepts; argparse puts the name of the argument before the message."""
    try:
        check('', value)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error).strip()) from None
    return value


def angle(text: str) -> float:
    """Parse an angle (rad). More than one turn is rejected: it is probably in degrees."""
    value = number(text)
    if not inside(value, -math.tau, math.tau):
        raise argparse.ArgumentTypeError(_not_in_radians(value))
    return value


def _not_in_radians(value: float) -> str:
    return (
        f"must be in radians, from -2 pi to 2 pi, got '{value:g}' "
        f'({value:g} degrees are {math.radians(value):.6g} rad)'
    )


coordinate = number_that(between(-MAX_POSITION, MAX_POSITION, unit='m'))
"""Parses a coordinate of a goal (m)."""
positive = number_that(fields.positive)
"""Parses a positive finite number."""
not_negative = number_that(fields.not_negative)
"""Parses a finite number that is zero or positive."""
count = integer_from(1)
"""Parses an integer of at least one."""


def tolerance(text: str) -> float:
    """Parse a distance that is a valid xy_goal_tolerance (m)."""
    # Not above: it imports every control law.
    from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters

    value = number(text)
    try:
        GoToGoalParameters(xy_goal_tolerance=value)
    except ParameterError as error:
        raise argparse.ArgumentTypeError(str(error).split("' ", 1)[1]) from error
    return value


def bag_folder(text: str) -> str:
    """Parse the name of a bag, which is a directory. A name with the ending of a file is rejected."""
    stem, ending = os.path.splitext(text.rstrip('/'))
    if ending.lower() in _FILE_ENDINGS:
        raise argparse.ArgumentTypeError(
            f'must name a bag, which is a directory, got {text!r}, the name of a file; '
            f'did you mean {stem!r}?'
        )
    return text


_FILE_ENDINGS = ('.png', '.svg', '.pdf', '.jpg', '.jpeg', '.csv', '.txt', '.yaml', '.yml')


def namespace(text: str) -> str:
    """Parse a namespace of ROS; return it with a leading slash, the root as `/`."""
    found = '/' + text.strip('/')
    if not re.fullmatch(r'/|(/[A-Za-z_][A-Za-z0-9_]*)+', found):
        raise argparse.ArgumentTypeError(
            f'must be a namespace of letters, digits and _, as /robot1, got {text!r}'
        )
    return found


def readable_file(text: str) -> str:
    """Parse the name of a readable file."""
    if not os.path.isfile(text):
        raise argparse.ArgumentTypeError(f'no such file: {text!r}')
    if not os.access(text, os.R_OK):
        raise argparse.ArgumentTypeError(f'file cannot be read: {text!r}')
    return text


# --- Values


def add_value(
    parser: argparse.ArgumentParser,
    name: str,
    unit: str,
    text: str,
    *,
    default: object = None,
    kind: Callable[[str], Any] = positive,
) -> None:
    """Add an option that has a number, by default a positive one.

    Args:
        parser: The parser.
        name: Its name, or a short and a long one: `--rate`, or `-r --rate`.
        unit: What the help writes for the value.
        text: Help. The default is added, if there is one.
        default: Default. None: the help describes what is done without the option.
        kind: Type of the argument.
    """
    described = text if default is None else f'{text} (default: %(default)s)'
    parser.add_argument(*name.split(), metavar=unit, type=kind, default=default, help=described)


def add_timeout(parser: argparse.ArgumentParser, text: str, default: float | None = None) -> None:
    """Add the option for the longest duration of what a tool does (s)."""
    add_value(parser, '--timeout', 'SECONDS', text, default=default)


def add_controller(
    parser: argparse.ArgumentParser, names: Iterable[str], text: str, default: object = None
) -> None:
    """Add the option for the controller, by its name.

    Args:
        parser: The parser.
        names: The controllers.
        text: Help. The default is added, if there is one; `%(choices)s` are the controllers.
        default: Default. None: the help describes what is done without the option.
    """
    described = text if default is None else f'{text} (default: %(default)s)'
    parser.add_argument('--controller', choices=names, metavar='NAME', default=default, help=described)


def add_path(parser: argparse.ArgumentParser, name: str, what: str = '') -> None:
    """Add the argument or the option for a path, which `given_path` reads."""
    parser.add_argument(
        name,
        metavar='PATH',
        help=f'{what}circle:RADIUS, line:LENGTH or eight:SIZE (m), or a .csv or .yaml file of poses',
    )


def given_path(parser: argparse.ArgumentParser, options: argparse.Namespace) -> PlannedPath:
    """Return the path that was given; a trajectory has no `--speed`."""
    # Not above: --help needs no NumPy.
    from diffdrive_jacobian.control.path_source import PathError, planned_path

    try:
        path = planned_path(options.path)
    except PathError as error:
        parser.error(str(error))
    if len(path.poses) > MAX_PATH_POSES:
        parser.error(f'a path must have at most {MAX_PATH_POSES} poses, got {len(path.poses)}')
    if path.times is not None and options.speed is not None:
        parser.error(f'--speed has no effect on the trajectory {options.path}, whose poses have times')
    return path


def is_relative(path: str) -> bool:
    """Return whether a path is a shape, which begins at the robot."""
    from diffdrive_jacobian.control.path_source import is_shape

    return is_shape(path)


def add_heading(parser: argparse.ArgumentParser, text: str) -> None:
    """Add the options for a heading, which `given_heading` evaluates."""
    parser.add_argument('--heading', metavar='RAD', type=number, help=text)
    parser.add_argument(
        '--degrees', action='store_true', help='the heading is in degrees (default: radians)'
    )


def given_heading(parser: argparse.ArgumentParser, options: argparse.Namespace) -> float | None:
    """Return the heading that was given (rad); None: none was.

    More than one turn is rejected: in radians it is probably meant in degrees.
    """
    value: float | None = options.heading
    if value is None:
        if options.degrees:
            parser.error('--degrees needs --heading, whose unit it changes')
        return None
    if options.degrees:
        if not inside(value, -360.0, 360.0):
            parser.error(f"argument --heading: must be from -360 to 360 degrees, got '{value:g}'")
        return math.radians(value)
    if not inside(value, -math.tau, math.tau):
        parser.error(f'argument --heading: {_not_in_radians(value)}; --degrees accepts them')
    return value


FOLLOWING = {
    '--max-acceleration': ('A', 'largest acceleration and deceleration (m/s^2) (default: no limit)'),
    '--max-yaw-acceleration': ('A', 'largest angular acceleration (rad/s^2) (default: no limit)'),
    '--wheel-lag': ('S', 'time constant with which the wheels follow commands (s) (default: 0)'),
    '--command-delay': ('S', 'time from a command to its effect on the wheels (s) (default: 0)'),
}
"""Options for a robot that takes time to follow commands, with unit and help."""


def add_following(parser: argparse.ArgumentParser) -> None:
    """Add the options for a robot that takes time to follow commands, see `following_parameters`."""
    for option, (unit, text) in FOLLOWING.items():
        add_value(parser, option, unit, text)


def following_parameters(options: argparse.Namespace) -> dict[str, float]:
    """Return what these options are as parameters of virtual_robot and of go_to_goal."""
    given: dict[str, float | None] = {
        'wheel_lag': options.wheel_lag,
        'command_delay': options.command_delay,
    }
    for axis, limit in (
        ('linear.x', options.max_acceleration),
        ('angular.z', options.max_yaw_acceleration),
    ):
        for name, sign in (
            ('max_acceleration', 1.0),
            ('max_deceleration', -1.0),
            ('max_acceleration_reverse', -1.0),
            ('max_deceleration_reverse', 1.0),
        ):
            given[f'{axis}.{name}'] = None if limit is None else sign * limit
    return {name: value for name, value in given.items() if value is not None}


# --- Files


def add_bag(parser: argparse.ArgumentParser, text: str = 'directory of a bag', **kwargs: Any) -> None:
    """Add the argument for a bag, of type Path.

    Args:
        parser: The parser.
        text: Help.
        kwargs: As for `argparse.ArgumentParser.add_argument`, such as `nargs`.
    """
    parser.add_argument('bag', metavar='BAG', type=Path, help=text, **kwargs)


def add_bags(parser: argparse.ArgumentParser) -> None:
    """Add the argument for one or more bags, a list of Path, which `given_bags` checks."""
    parser.add_argument('bags', metavar='BAG', type=Path, nargs='+', help='directory of a bag')


def given_bags(options: argparse.Namespace) -> list[Path]:
    """Return the bags that were given.

    Raises:
        UserError: One was given twice.
    """
    bags: list[Path] = options.bags
    if len({bag.resolve() for bag in bags}) < len(bags):
        raise UserError(f'each bag can be given once, got {" ".join(map(str, bags))}')
    return bags


def add_output(
    parser: argparse.ArgumentParser, what: str, text: str, kind: Callable[[str], Any] = str
) -> None:
    """Add the option for the file or the directory to write.

    Args:
        parser: The parser.
        what: What the help writes for it.
        text: Help.
        kind: Type of the argument.
    """
    parser.add_argument('-o', '--output', metavar=what, type=kind, help=text)


def add_force(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the option to overwrite files.

    Args:
        parser: The parser.
        what: What is overwritten.
    """
    parser.add_argument('--force', action='store_true', help=f'overwrite {what} (default: refuse)')


def add_no_plot(parser: argparse.ArgumentParser, text: str) -> None:
    """Add the option to draw no picture."""
    parser.add_argument('--no-plot', action='store_true', help=text)


def add_storage(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """Add the option for the file format of a bag to write. None: that of the bag that is read."""
    parser.add_argument(
        '-s',
        '--storage',
        choices=STORAGES,
        default=default,
        help=f'storage format (default: {default or "that of BAG"})',
    )


def add_params_file(
    parser: argparse.ArgumentParser, text: str = 'file of ROS parameters (YAML)'
) -> None:
    """Add the options for a parameter file without `--ros-args`: by its path, or by the robot's name.

    Args:
        parser: The parser.
        text: What the file contains.
    """
    group = parser.add_mutually_exclusive_group()
    group.add_argument('--params-file', metavar='FILE', type=readable_file, help=text)
    names = ', '.join(configurations()) or 'none is installed'
    group.add_argument(
        '--robot',
        metavar='NAME',
        dest='params_file',
        type=_configuration,
        help=f'the installed parameter file of a robot: {names}',
    )


def _configuration(name: str) -> str:
    """Return the path of the installed parameter file of a robot."""
    installed = configurations()
    return str(installed[_checked(one_of(*installed), name)])


def with_params_file(ros: list[str], options: argparse.Namespace) -> list[str]:
    """Return the ROS arguments with that parameter file. Those that the user gave take precedence."""
    if options.params_file is None:
        return ros
    return ['--ros-args', '--params-file', options.params_file, '--', *ros]


def warn_of_unused_files(program: str, ros: Sequence[str], nodes: Sequence[str]) -> None:
    """Print a warning for each parameter file without parameters of any of the nodes.

    Args:
        program: Name of the program.
        ros: The ROS arguments, in which files follow `--params-file`.
        nodes: Fully qualified names of the nodes.
    """
    for flag, path in pairwise(ros):
        if flag == '--params-file' and (why := _unused(path, nodes)):
            print(f'{program}: warning: --params-file {path} has no parameters{why}', file=sys.stderr)


def _unused(path: str, nodes: Sequence[str]) -> str:
    """Describe why a file has no effect. Empty: it has one, or is only readable by rcl."""
    # Slow to import, and a node without such a file does not need it.
    from diffdrive_jacobian.parameters.file import concerns, sections

    try:
        names = list(dict.fromkeys(name for name, _ in sections(path)))
    except UserError:
        return ''
    if not names:
        return ': they stand under NODE: ros__parameters:'
    if any(concerns(name, node) for name in names for node in nodes):
        return ''
    return f' of these nodes: it is for {", ".join(names)}, the nodes are {", ".join(nodes)}'


# --- Topics, nodes and pages


def add_namespace(parser: argparse.ArgumentParser) -> None:
    """Add the option for a bag of several robots."""
    parser.add_argument(
        '--namespace',
        metavar='NS',
        type=namespace,
        help='namespace of the robot in a bag of several, as /robot1 (default: that of the only robot)',
    )


def add_wait_matching(parser: argparse.ArgumentParser, what: str, default: str) -> None:
    """Add the option of `ros2 topic pub` for subscriptions that are discovered late.

    Args:
        parser: The parser.
        what: What must have the subscriptions, with its verb.
        default: What is done without the option.
    """
    parser.add_argument(
        '-w',
        '--wait-matching-subscriptions',
        dest='readers',
        metavar='N',
        type=count,
        help=f'wait until {what} N subscriptions (default: {default})',
    )


def add_page(parser: argparse.ArgumentParser) -> None:
    """Add the options of the page."""
    parser.add_argument(
        '--port',
        metavar='PORT',
        type=integer_from(1, MAX_PORT),
        default=0,
        help='TCP port of the page (default: any free one)',
    )
    parser.add_argument(
        '--no-browser', action='store_true', help='only print the address, do not open a browser'
    )
