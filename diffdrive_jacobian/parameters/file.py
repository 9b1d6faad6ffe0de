"""ROS parameter files, read without ROS: for whom they are, and what virtual_robot gets."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from diffdrive_jacobian.bounded_yaml import YAML_ERRORS, load_yaml
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.text import printable

Sections = list[tuple[str, dict[str, Any]]]
"""The name of a node, with wildcards, and its parameters, as often as the file has some."""


def sections(path: str) -> Sections:
    """Return the parameters in a ROS parameter file with the names for which they are.

    Raises:
        UserError: The file cannot be read or is not a ROS parameter file.
    """
    try:
        content = load_yaml(Path(path))
    except (OSError, *YAML_ERRORS) as error:
        why = printable(' '.join(str(error).split()), 200)
        raise UserError(f'--params-file must be a file of ROS parameters, got {path}: {why}') from error
    return list(_sections(content, ''))


def robot_parameters(path: str) -> dict[str, Any]:
    """Return the parameters of virtual_robot in a ROS parameter file, by name.

    Raises:
        UserError: The file cannot be read, is not a ROS parameter file, or has no such parameters.
    """
    found = sections(path)
    values: dict[str, Any] = {}
    for name, parameters in found:
        if is_shared(name) or name.endswith('/virtual_robot'):
            values.update(parameters)
    if not values:
        others = ', '.join(name for name, _ in found)
        raise UserError(
            f'--params-file must be a file of ROS parameters, got {path}: it has none of virtual_robot'
            + (f', but of {others}' if others else '')
        )
    return values


def concerns(name: str, node: str) -> bool:
    """Return whether rcl applies the parameters under a name to a node.

    Args:
        name: Name in a parameter file. `*` stands for one token, `**` for any number of tokens.
        node: Fully qualified name of the node.
    """
    tokens = {'*': '/[^/]+', '**': '(/[^/]+)*'}
    pattern = ''.join(tokens.get(token, '/' + re.escape(token)) for token in name.strip('/').split('/'))
    return re.fullmatch(pattern, node) is not None


def is_shared(name: str) -> bool:
    """Return whether a name in a parameter file stands for nodes of any name."""
    return name.rpartition('/')[2] in ('*', '**')


def _sections(section: Any, prefix: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for key, value in section.items() if isinstance(section, dict) else ():
        if key != 'ros__parameters':
            yield from _sections(value, f'{prefix}/{str(key).strip("/")}')
        elif parameters := dict(_flat(value, '')):
            yield prefix or '/', parameters


def _flat(section: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in section.items() if isinstance(section, dict) else ():
        if isinstance(value, dict):
            yield from _flat(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value
