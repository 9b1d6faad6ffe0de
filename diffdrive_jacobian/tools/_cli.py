"""Arguments and exit codes of the command-line tools."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

from diffdrive_jacobian import __version__
from diffdrive_jacobian.messages.plausibility import MAX_POSITION
from diffdrive_jacobian.numerics import fields
from diffdrive_jacobian.numerics.fields import Check, between, finite, inside, integer, one_of
from diffdrive_jacobian.parameters.configurations import configurations
from diffdrive_jacobian.parameters.declaration import (
    NodeParameters,
    ParameterError,
    specifications,
)

T = TypeVar('T')

DONE, FAILED, USER_ERROR, INTERRUPTED = 0, 1, 2, 130
"""Exit codes: done, not done, wrong arguments, interrupted by a signal."""


class Parser(argparse.ArgumentParser):
    """A parser with the option that every tool has."""

    def __init__(self, *, prog: str, **kwargs: Any) -> None:
        """Add `--version`. Arguments as for `argparse.ArgumentParser`."""
        super().__init__(prog=prog, **kwargs)
        version = f'{prog} (diffdrive_jacobian) {__version__}'
        self.add_argument('--version', action='version', version=version, help='print the version')

    @property
    def long_options(self) -> list[str]:
        """The options that begin with two dashes."""
        return [name for name in self._option_string_actions if name.startswith('--')]


def split_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate a tool's own arguments from those between `--ros-args` and `--`.

    Returns:
        The tool's own arguments and the ROS arguments. Negative numbers of the former get a leading
        space: argparse regards `-1e3` as an option otherwise.
    """
    own: list[str] = []
    ros: list[str] = []
    in_ros = False
    for argument in arguments:
        if argument == '--ros-args':
            in_ros = True
        if in_ros:
            ros.append(argument)
            in_ros = argument != '--'
        else:
            own.append(f' {argument}' if argument.startswith('-') and _is_number(argument) else argument)
    return own, ros


def parse(
    parser: Parser,
    own: Sequence[str],
    *,
    ros: bool = True,
    parameters: Sequence[type[NodeParameters]] = (),
    hint: str = '',
) -> argparse.Namespace:
    """Parse a tool's own arguments.

    An error message about arguments that are not known says what was probably meant.

    Args:
        parser: The parser.
        own: The arguments.
        ros: Whether the tool takes ROS arguments.
        parameters: Parameters of the nodes that the tool runs.
        hint: Hint if there is no better one and an argument is no option. Empty: none.
    """
    options, unknown = parser.parse_known_args(own)
    if unknown:
        words = [word.strip() for word in unknown]
        if any(word in _ROS_OPTIONS or ':=' in word for word in words):
            found = ROS_HINT if ros else f'{parser.prog} takes no ROS arguments'
        else:
            found = _meant(parser, words, parameters)
        if not found and not words[0].startswith('--'):
            found = hint
        parser.error(f'unrecognized arguments: {" ".join(words)}' + (f' ({found})' if found else ''))
    return options


def _meant(parser: Parser, words: Sequence[str], parameters: Sequence[type[NodeParameters]]) -> str:
    """Return what was probably meant by the first unknown option. Empty: this is not known."""
    place = next((index for index, word in enumerate(words) if word.startswith('--')), None)
    if place is None:
        return ''
    option, _, value = words[place].partition('=')
    name = option[2:].replace('-', '_')
    if any(name in specifications(one) for one in parameters):
        after = ''.join(words[place + 1 : place + 2])
        value = value or (after if after and not after.startswith('--') else 'VALUE')
        return f'{name} is a ROS parameter: --ros-args -p {name}:={value}'
    # Slow to import.
    import difflib

    close = difflib.get_close_matches(option, parser.long_options, n=1)
    return f'did you mean {close[0]}?' if close else ''


ROS_HINT = 'ROS arguments come after --ros-args, as in --ros-args -p NAME:=VALUE'
_ROS_OPTIONS = ('--ros-args', '-p', '--param', '-r', '--remap', '--log-level', '--enclave', '-e')


def _is_number(text: str) -> bool:
    # Python reads more as a number than people write on a command line.
    if '_' in text or not text.isascii():
        return False
    try:
        float(text)
    except ValueError:
        return False
    return True


def number(text: str) -> float:
    """Parse a finite number."""
    text = text.strip()
    if not _is_number(text):
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


def distances(distance: float, true_distance: float) -> str:
    """Return how far a robot is from its goal (m), in words. A true distance of NaN is not known."""
    if math.isnan(true_distance):
        return f'{distance:.3f} m from the goal'
    return f'{distance:.3f} m from the goal by odometry, {true_distance:.3f} m by ground truth'


def add_force(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the option to overwrite files.

    Args:
        parser: The parser.
        what: What is overwritten.
    """
    parser.add_argument('--force', action='store_true', help=f'overwrite {what} (default: refuse)')


def refuse_without(
    parser: argparse.ArgumentParser, options: argparse.Namespace, option: str, *needed: str
) -> None:
    """Refuse an option that has no effect without one of others.

    Args:
        parser: The parser.
        options: The parsed options.
        option: The option, as `--force`.
        needed: The others.
    """
    if _is_given(options, option) and not any(_is_given(options, one) for one in needed):
        parser.error(f'{option} has no effect without {" or ".join(needed)}')


def refuse_with(
    parser: argparse.ArgumentParser, options: argparse.Namespace, option: str, *others: str
) -> None:
    """Refuse an option that has no effect beside one of others.

    Args:
        parser: The parser.
        options: The parsed options.
        option: The option.
        others: The others.
    """
    for other in others:
        if _is_given(options, option) and _is_given(options, other):
            parser.error(f'{option} has no effect with {other}')


def _is_given(options: argparse.Namespace, option: str) -> bool:
    """Return whether an option was given whose default is None, False or an empty list."""
    value = getattr(options, option.lstrip('-').replace('-', '_'))
    return not (value is None or value is False or value == [] or value == math.inf)


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


coordinate = number_that(between(-MAX_POSITION, MAX_POSITION, unit='m'))
"""Parses a coordinate of a goal (m)."""
positive = number_that(fields.positive)
"""Parses a positive finite number."""
count = integer_from(1)
"""Parses an integer of at least one."""


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


def readable_file(text: str) -> str:
    """Parse the name of a readable file."""
    if not os.path.isfile(text):
        raise argparse.ArgumentTypeError(f'no such file: {text!r}')
    if not os.access(text, os.R_OK):
        raise argparse.ArgumentTypeError(f'file cannot be read: {text!r}')
    return text


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


def add_namespace(parser: argparse.ArgumentParser) -> None:
    """Add the option for a bag of several robots."""
    parser.add_argument(
        '--namespace',
        metavar='NS',
        type=namespace,
        help='namespace of the robot in a bag of several, as /robot1 (default: that of the only robot)',
    )


def namespace(text: str) -> str:
    """Parse a namespace of ROS; return it with a leading slash, the root as `/`."""
    found = '/' + text.strip('/')
    if not re.fullmatch(r'/|(/[A-Za-z_][A-Za-z0-9_]*)+', found):
        raise argparse.ArgumentTypeError(
            f'must be a namespace of letters, digits and _, as /robot1, got {text!r}'
        )
    return found


def with_params_file(ros: list[str], options: argparse.Namespace) -> list[str]:
    """Return the ROS arguments with that parameter file. Those that the user gave take precedence."""
    if options.params_file is None:
        return ros
    return ['--ros-args', '--params-file', options.params_file, '--', *ros]


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: `1 topic`, `2 topics`."""
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def complain(program: str, message: object, code: int = USER_ERROR) -> int:
    """Print an error as argparse does; return the exit code."""
    print(f'{program}: error: {message}', file=sys.stderr)
    return code
