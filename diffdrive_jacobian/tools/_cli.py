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

"""Command lines of the tools: how they are parsed, and the options that several tools have."""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from diffdrive_jacobian import __version__
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.messages.conversion import MAX_PATH_POSES, MAX_POSITION
from diffdrive_jacobian.numerics import checks
from diffdrive_jacobian.numerics.checks import Check, between, finite, integer, one_of
from diffdrive_jacobian.parameters.declaration import NodeParameters, ParameterError
from diffdrive_jacobian.parameters.file import configurations
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.tools._output import note

if TYPE_CHECKING:
    from diffdrive_jacobian.control import Path as PlannedPath
    from diffdrive_jacobian.live.session import Share

T = TypeVar('T')

ROS_HINT = 'ROS arguments come after --ros-args, as in --ros-args -p NAME:=VALUE'
_ROS_OPTIONS = ('--ros-args', '-p', '--param', '-r', '--remap', '--log-level', '--enclave', '-e')
_FILE_ENDINGS = (
    '.png',
    '.svg',
    '.pdf',
    '.jpg',
    '.jpeg',
    '.csv',
    '.txt',
    '.yaml',
    '.yml',
    '.db3',
    '.mcap',
)

# --- Types of arguments


def is_number(text: str) -> bool:
    """Return whether a text is a number as people write it on a command line."""
    # Python reads more as a number, such as 1_000.
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
    if not is_number(text):
        hint = f' ({ROS_HINT})' if ':=' in text else ''
        raise argparse.ArgumentTypeError(f'must be a number, got {text!r}{hint}')
    return _checked(finite, float(text))


def number_that(check: Check) -> Callable[[str], float]:
    """Return a type of arguments: the finite numbers that a check accepts."""
    return lambda text: _checked(check, number(text))


def integer_from(low: int, high: float = math.inf) -> Callable[[str], int]:
    """Return a type of arguments: integers from `low` to `high`."""

    def parse(text: str) -> int:
        text = text.strip()
        # Python reads more as an integer than people write on a command line.
        value = int(text) if re.fullmatch('-?[0-9]{1,99}', text) else text
        return int(_checked(partial(integer, low=low, high=high), value))

    return parse


def _checked(check: Check, value: T) -> T:
    """Return a value that a check accepts; argparse puts the name of the argument before the message."""
    try:
        check('', value)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error).strip()) from None
    return value


def _in_radians(_: str, value: float) -> None:
    """Require at most one turn: more is probably in degrees."""
    if value not in between(-math.tau, math.tau):
        raise ValueError(
            f"must be in radians, from -2 pi to 2 pi, got '{value:g}' "
            f'({value:g} degrees are {math.radians(value):.6g} rad)'
        )


angle = number_that(_in_radians)
"""Parses an angle (rad)."""
coordinate = number_that(between(-MAX_POSITION, MAX_POSITION, unit='m'))
"""Parses a coordinate of a goal (m)."""
positive = number_that(checks.positive)
"""Parses a positive finite number."""
not_negative = number_that(checks.not_negative)
"""Parses a finite number that is zero or positive."""


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


def namespace(text: str) -> str:
    """Parse a namespace of ROS; return it with a leading slash, the root as `/`."""
    found = '/' + text.strip('/')
    if not re.fullmatch(r'/|(/[A-Za-z_][A-Za-z0-9_]*)+', found):
        raise argparse.ArgumentTypeError(
            f'must be a namespace of letters, digits and _, as /robot1, got {text!r}'
        )
    return found


def topic(text: str) -> str:
    """Parse the name of a topic. Which names ROS accepts is checked later."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise argparse.ArgumentTypeError(f'must be the name of a topic, got {text!r}') from None
    return text


def _readable_file(text: str) -> str:
    if not os.path.isfile(text):
        raise argparse.ArgumentTypeError(f'no such file: {text!r}')
    if not os.access(text, os.R_OK):
        raise argparse.ArgumentTypeError(f'file cannot be read: {text!r}')
    return text


def _configuration(name: str) -> str:
    """Return the path of the installed parameter file of a robot."""
    installed = configurations()
    return str(installed[_checked(one_of(*installed), name)])


# --- Command lines


def split_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate a tool's own arguments from those between `--ros-args` and `--`.

    Negative numbers of the former get a leading space: argparse regards `-1e3` as an option otherwise.
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
            own.append(f' {argument}' if argument.startswith('-') and is_number(argument) else argument)
    return own, ros


class Parser(argparse.ArgumentParser):
    """A parser with the options that several tools have.

    Each `add_...` adds an option with its name, type, check and help, so that it is the same everywhere.
    """

    def __init__(self, *, prog: str, **kwargs: Any) -> None:
        """Add `--version`. Arguments as for `argparse.ArgumentParser`."""
        super().__init__(prog=prog, **kwargs)
        version = f'{prog} (diffdrive_jacobian) {__version__}'
        self.add_argument('--version', action='version', version=version, help='print the version')

    @property
    def long_options(self) -> list[str]:
        """The options that begin with two dashes."""
        return [name for name in self._option_string_actions if name.startswith('--')]

    def parse(
        self,
        arguments: Sequence[str],
        *,
        ros: bool = True,
        parameters: Sequence[NodeParameters] = (),
        hint: str = '',
    ) -> argparse.Namespace:
        """Parse a command line. An error about unknown arguments says what was probably meant.

        Args:
            arguments: The command line.
            ros: Whether the tool takes ROS arguments. They become `ros` of the result, after a file of
                `--params-file`, over which they take precedence.
            parameters: Parameters of the nodes that the tool runs.
            hint: Hint if there is no better one and an argument is no option. Empty: none.
        """
        own, of_ros = split_arguments(arguments)
        options, unknown = self.parse_known_args(own if ros else [*own, *of_ros])
        if unknown:
            words = [word.strip() for word in unknown]
            if any(word in _ROS_OPTIONS or ':=' in word for word in words):
                found = ROS_HINT if ros else f'{self.prog} takes no ROS arguments'
            else:
                found = self._meant(words, parameters)
            if not found and not words[0].startswith('--'):
                found = hint
            self.error(f'unrecognized arguments: {" ".join(words)}' + (f' ({found})' if found else ''))
        if file := getattr(options, 'params_file', None):
            of_ros = ['--ros-args', '--params-file', file, '--', *of_ros]
        options.ros = of_ros
        return options

    def _meant(self, words: Sequence[str], parameters: Sequence[NodeParameters]) -> str:
        """Return what was probably meant by the first unknown option. Empty: this is not known."""
        place = next((index for index, word in enumerate(words) if word.startswith('--')), None)
        if place is None:
            return ''
        option, _, value = words[place].partition('=')
        name = option[2:].replace('-', '_')
        if any(name in one.declared() for one in parameters):
            after = ''.join(words[place + 1 : place + 2])
            value = value or (after if after and not after.startswith('--') else 'VALUE')
            return f'{name} is a ROS parameter: --ros-args -p {name}:={value}'
        # Slow to import.
        import difflib

        known = {one.strip('-'): one for one in self.long_options}
        close = difflib.get_close_matches(option.strip('-'), known, n=1)
        return f'did you mean {known[close[0]]}?' if close else ''

    def refuse_without(self, options: argparse.Namespace, option: str, *needed: str) -> None:
        """Refuse an option that has no effect without one of others."""
        if _is_given(options, option) and not any(_is_given(options, one) for one in needed):
            self.error(f'{option} has no effect without {" or ".join(needed)}')

    def refuse_with(self, options: argparse.Namespace, option: str, other: str) -> None:
        """Refuse an option that has no effect beside another one."""
        if _is_given(options, option) and _is_given(options, other):
            self.error(f'{option} has no effect with {other}')

    # --- Values

    def add_value(
        self,
        name: str,
        unit: str,
        text: str,
        *,
        default: object = None,
        kind: Callable[[str], Any] = positive,
    ) -> None:
        """Add an option that has a number, by default a positive one.

        Args:
            name: Its name, or a short and a long one: `-r --rate`.
            unit: What the help writes for the value.
            text: Help. The default is added, if there is one.
            default: Default. None: the help describes what is done without the option.
            kind: Type of the argument.
        """
        described = text if default is None else f'{text} (default: %(default)s)'
        self.add_argument(*name.split(), metavar=unit, type=kind, default=default, help=described)

    def add_timeout(self, text: str, default: float | None = None) -> None:
        """Add the option for the longest duration of what a tool does (s)."""
        self.add_value('--timeout', 'SECONDS', text, default=default)

    def add_path(self, name: str, what: str = '') -> None:
        """Add the argument or the option for a path, which `given_path` reads."""
        text = 'circle:RADIUS, line:LENGTH or eight:SIZE (m), or a .csv or .yaml file of poses'
        self.add_argument(name, metavar='PATH', help=f'{what}{text}')

    def add_trajectory(self, name: str = '--trajectory') -> None:
        """Add the option for a trajectory of constant speed along the path, which `given_path` reads."""
        self.add_value(
            name,
            'M/S',
            'drive the path as a trajectory of this constant speed: each pose has its time, which the '
            'robot keeps (m/s) (default: a path without times)',
        )

    def given_path(self, options: argparse.Namespace) -> PlannedPath:
        """Return the path that was given, with the times of `--trajectory`."""
        # Not above: --help needs no NumPy.
        from diffdrive_jacobian.control.path_source import PathError, planned_path

        try:
            path = planned_path(options.path)
        except PathError as error:
            self.error(str(error))
        if len(path.poses) > MAX_PATH_POSES:
            self.error(f'a path must have at most {MAX_PATH_POSES} poses, got {len(path.poses)}')
        for option in ('--speed', '--trajectory'):
            if path.times is not None and getattr(options, option[2:], None) is not None:
                self.error(
                    f'{option} has no effect on the trajectory {options.path}, whose poses have times'
                )
        return path if options.trajectory is None else path.timed(options.trajectory)

    def add_heading(self, text: str) -> None:
        """Add the options for a heading, which `given_heading` evaluates."""
        self.add_argument('--heading', metavar='RAD', type=number, help=text)
        self.add_argument(
            '--degrees', action='store_true', help='the heading is in degrees (default: radians)'
        )

    def given_heading(self, options: argparse.Namespace) -> float | None:
        """Return the heading that was given (rad); None: none was. More than one turn is rejected."""
        value: float | None = options.heading
        if value is None:
            if options.degrees:
                self.error('--degrees needs --heading, whose unit it changes')
            return None
        if options.degrees:
            if value not in between(-360.0, 360.0):
                self.error(f"argument --heading: must be from -360 to 360 degrees, got '{value:g}'")
            return math.radians(value)
        try:
            _in_radians('', value)
        except ValueError as error:
            self.error(f'argument --heading: {error}; --degrees accepts them')
        return value

    def add_following(self) -> None:
        """Add the options for a robot that takes time to follow commands: `following_parameters`."""
        for name, unit, text in (
            ('max-acceleration', 'A', 'largest acceleration and deceleration (m/s^2)'),
            ('max-yaw-acceleration', 'A', 'largest angular acceleration (rad/s^2)'),
            ('wheel-lag', 'S', 'time constant with which the wheels follow commands (s)'),
            ('command-delay', 'S', 'time from a command to its effect on the wheels (s)'),
        ):
            default = 'no limit' if unit == 'A' else '0'
            self.add_value(f'--{name}', unit, f'{text} (default: {default})')

    # --- Files

    def add_bag(self, text: str = 'directory of a bag', **kwargs: Any) -> None:
        """Add the argument for a bag, of type Path. `kwargs` as for `add_argument`, such as `nargs`."""
        self.add_argument('bag', metavar='BAG', type=Path, help=text, **kwargs)

    def add_bags(self) -> None:
        """Add the argument for one or more bags, a list of Path, which `given_bags` checks."""
        self.add_argument('bags', metavar='BAG', type=Path, nargs='+', help='directory of a bag')

    def add_output(self, what: str, text: str, kind: Callable[[str], Any] = str) -> None:
        """Add the option for the file or the directory to write, for which the help writes `what`."""
        self.add_argument('-o', '--output', metavar=what, type=kind, help=text)

    def add_force(self, what: str) -> None:
        """Add the option to overwrite what is named."""
        self.add_argument('--force', action='store_true', help=f'overwrite {what} (default: refuse)')

    def refuse(self, *names: str, why: str) -> None:
        """Refuse an option that other programs have, and say why."""

        def refuse(value: str) -> NoReturn:
            raise argparse.ArgumentTypeError(f'{why}, got {value!r}')

        self.add_argument(*names, type=refuse, help=argparse.SUPPRESS)

    def refuse_storage(self) -> None:
        """Refuse `--storage`, which the programs of rosbag2 have."""
        self.refuse(
            *('-s', '--storage'),
            why='bags are written as MCAP, and `ros2 bag convert` writes other formats',
        )

    def add_params_file(self, text: str = 'file of ROS parameters (YAML)') -> None:
        """Add the options for a parameter file without `--ros-args`: its path, or the robot's name."""
        group = self.add_mutually_exclusive_group()
        group.add_argument('--params-file', metavar='FILE', type=_readable_file, help=text)
        names = ', '.join(configurations()) or 'none is installed'
        group.add_argument(
            '--robot',
            metavar='NAME',
            dest='params_file',
            type=_configuration,
            help=f'the installed parameter file of a robot: {names}',
        )

    # --- Topics, nodes and pages

    def add_namespace(self) -> None:
        """Add the option for a bag of several robots."""
        self.add_argument(
            '--namespace',
            metavar='NS',
            type=namespace,
            help='namespace of the robot in a bag of several, as /robot1 (default: that of the only '
            'robot)',
        )

    def add_wait_matching(self, what: str, default: str) -> None:
        """Add the option of `ros2 topic pub` for subscriptions of `what` that are discovered late."""
        self.add_argument(
            '-w',
            '--wait-matching-subscriptions',
            dest='readers',
            metavar='N',
            type=integer_from(1),
            help=f'wait until {what} N subscriptions (default: {default})',
        )

    def add_page(self) -> None:
        """Add the options of the page."""
        self.add_argument(
            '--port',
            metavar='PORT',
            type=integer_from(1, 65535),
            default=0,
            help='TCP port of the page (default: any free one)',
        )
        self.add_argument(
            '--no-browser', action='store_true', help='only print the address, do not open a browser'
        )
        self.add_value(
            '--share',
            'ADDRESS',
            'let others look at the page by this address of this machine, such as 192.168.1.7, with a '
            'link and a QR code of their own (default: nobody)',
            kind=_address,
        )
        self.add_argument(
            '--share-control', action='store_true', help='with --share: let them steer, too'
        )

    def given_share(self, options: argparse.Namespace) -> Share | None:
        """Return with whom the page is shared; None: with nobody."""
        self.refuse_without(options, '--share-control', '--share')
        if options.share is None:
            return None
        # Slow to import.
        from diffdrive_jacobian.live.session import Share

        return Share(options.share, options.share_control)


def _is_given(options: argparse.Namespace, option: str) -> bool:
    """Return whether an option was given whose default is None or False."""
    value = getattr(options, option.lstrip('-').replace('-', '_'))
    return value is not None and value is not False


# --- What was given


def _address(text: str) -> str:
    """Return the address of one interface of a machine."""
    # Slow to import.
    import ipaddress

    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        address = None
    if address is None or address.is_unspecified or address.is_loopback or address.is_multicast:
        raise argparse.ArgumentTypeError(
            'must be the address by which others reach this machine, such as 192.168.1.7, got '
            f'{printable(text)}'
        )
    return str(address)


def is_relative(path: str) -> bool:
    """Return whether a path is a shape, which begins at the robot."""
    from diffdrive_jacobian.control.path_source import is_shape

    return is_shape(path)


def following_parameters(options: argparse.Namespace) -> dict[str, float]:
    """Return what the options of `add_following` are as parameters of virtual_robot and go_to_goal."""
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


def given_bags(options: argparse.Namespace) -> list[Path]:
    """Return the bags that were given.

    Raises:
        UserError: One was given twice, or cannot be found.
    """
    bags: list[Path] = options.bags
    for bag in bags:
        try:
            bag.resolve()
        except (OSError, RuntimeError):
            raise UserError(f'there is no bag {bag}: its links form a loop') from None
    if len({bag.resolve() for bag in bags}) < len(bags):
        raise UserError(f'each bag can be given once, got {" ".join(map(str, bags))}')
    return bags


def warn_of_unused_files(program: str, ros: Sequence[str], nodes: Sequence[str]) -> None:
    """Print a warning for each `--params-file` in ROS arguments without parameters of any of the nodes.

    Args:
        program: Name of the program.
        ros: The ROS arguments.
        nodes: Fully qualified names of the nodes.
    """
    for flag, path in pairwise(ros):
        if flag == '--params-file' and (why := _unused(path, nodes)):
            note(program, f'warning: --params-file {path} has no parameters{why}')


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
