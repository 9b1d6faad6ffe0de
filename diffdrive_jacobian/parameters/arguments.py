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

"""Parameters on the command line of ROS nodes, where no node is there to take them. Imports no ROS."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.file import concerns, sections
from diffdrive_jacobian.text import printable

SHORT = 3
"""Length of names of parameters that are close to each other if half of the letters agree."""


def given_parameters(arguments: Sequence[str], nodes: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return the parameters that ROS arguments give to nodes; later ones take precedence.

    Args:
        arguments: The arguments, which follow `--ros-args`. A level of the log has no effect.
        nodes: Fully qualified names of the nodes.

    Returns:
        The values by name, for each node.

    Raises:
        UserError: An argument is neither a parameter nor a file of parameters, or it is invalid.
    """
    given: dict[str, dict[str, Any]] = {node: {} for node in nodes}
    for pattern, values in _rules(arguments):
        for node in nodes:
            if concerns(pattern, node):
                given[node].update(values)
    return given


def check_names(arguments: Sequence[str], known: Collection[str]) -> None:
    """Raise UserError if ROS arguments give a parameter by `-p` that is not known.

    A file may be for other processes, too.
    """
    for flag, rule in pairwise(arguments):
        if flag in ('-p', '--param'):
            _, values = _rule(rule)
            for text in unknown(values, known):
                raise UserError(f'no node of this program has the {text}')


def unknown(names: Iterable[str], known: Collection[str]) -> Iterator[str]:
    """Yield `parameter 'NAME'`, with what was probably meant, for each name that is not known."""
    for name in sorted({*names} - {*known}):
        close = ' or '.join(f"'{one}'" for one in resembling(name, known))
        hint = f'; did you mean {close}?' if close else ''
        yield f"parameter '{printable(name)}'{hint}"


def resembling(name: str, known: Collection[str]) -> list[str]:
    """Return the known names that were probably meant, in alphabetical order.

    They differ by upper case, by a few letters, or are the last part of a name with dots.
    """
    # Slow to import.
    import difflib

    names = sorted(known)
    close = [one for one in names if one.lower() == name.lower()]
    close = close or [one for one in names if one.endswith(f'.{name}')][:3]
    close = close or difflib.get_close_matches(name, names, n=1)
    if not close and len(name) <= SHORT:
        close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    return sorted(close)


def _rules(arguments: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield parameters, each with the name of the nodes for which they are."""
    words = iter(arguments)
    for word in words:
        if word in ('--ros-args', '--'):
            continue
        value = next(words, None)
        if word not in ('-p', '--param', '--params-file', '--log-level') or value is None:
            raise UserError(
                f'without rclpy, ROS arguments must be -p NAME:=VALUE or --params-file FILE, got '
                f"'{printable(word)}'"
            )
        if word == '--params-file':
            yield from sections(value)
        elif word != '--log-level':
            yield _rule(value)


def _rule(text: str) -> tuple[str, dict[str, Any]]:
    """Return the parameter of a rule `NAME:=VALUE` or `NODE:NAME:=VALUE`."""
    # Slow to import.
    from diffdrive_jacobian.safe_yaml import YAML_ERRORS, load_yaml

    left, separator, value = text.partition(':=')
    node, _, name = left.rpartition(':')
    try:
        if not (separator and name):
            raise ValueError('it has no name')
        return f'/{node.strip("/")}' if node else '/**', {name: load_yaml(value)}
    except YAML_ERRORS as error:
        raise UserError(f"ROS arguments: -p must be NAME:=VALUE, got '{printable(text)}'") from error
