"""Command lines of the tools: how they are read and refused, and the exit codes."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from typing import Any, TypeVar

from diffdrive_jacobian import __version__
from diffdrive_jacobian.parameters.declaration import (
    NodeParameters,
    specifications,
)
from diffdrive_jacobian.text import PATH_LIMIT, printable

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
            own.append(f' {argument}' if argument.startswith('-') and is_number(argument) else argument)
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


def is_number(text: str) -> bool:
    """Return whether a text is a number as people write it on a command line."""
    # Python reads more as a number than people write on a command line.
    if '_' in text or not text.isascii():
        return False
    try:
        float(text)
    except ValueError:
        return False
    return True


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


def complain(program: str, message: object, code: int = USER_ERROR) -> int:
    """Print an error as argparse does; return the exit code."""
    print(f'{program}: error: {message}', file=sys.stderr)
    return code


def interrupted(program: str, result: str = '') -> int:
    """Print that a signal was caught, and what became of the files; return the exit code."""
    print(f'{program}: interrupted{f": {result}" if result else ""}', file=sys.stderr)
    return INTERRUPTED


def cannot_write(program: str, path: object, error: OSError, result: str = '') -> int:
    """Print that a file cannot be written, and what was written instead; return the exit code."""
    message = f'{path} cannot be written: {error.strerror or error}{result}'
    return complain(program, printable(message, PATH_LIMIT), FAILED)
