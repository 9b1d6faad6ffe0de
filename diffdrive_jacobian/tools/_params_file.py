"""Files of ROS parameters: the robot's parameters for tools that run no node, and the names of nodes."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from diffdrive_jacobian.ros.errors import UserError
from diffdrive_jacobian.text import printable


def robot_parameters(path: str) -> dict[str, Any]:
    """Read the robot's parameters from a file of ROS parameters.

    Raises:
        UserError: The file is none of that kind.
    """
    # ruamel.yaml is slow to import, and a node needs it only for a file.
    from diffdrive_jacobian.bounded_yaml import YAML_ERRORS, load_yaml

    try:
        content = load_yaml(Path(path))
        values: dict[str, Any] = {}
        for key, section in content.items():
            if key.rstrip('/').split('/')[-1] in ('virtual_robot', '**'):
                values.update(_flat(section['ros__parameters'], ''))
    except (OSError, AttributeError, KeyError, TypeError, *YAML_ERRORS) as error:
        raise UserError(
            f'--params-file must be a file of ROS parameters, got {path}: {_on_one_line(error)}'
        ) from error
    return values


def warn_of_unused_files(program: str, ros: Sequence[str], nodes: Sequence[str]) -> None:
    """Print a warning for each parameter file that concerns none of the nodes.

    Args:
        program: Name of the program.
        ros: The ROS arguments, in which files follow `--params-file`.
        nodes: Fully qualified names of the nodes.
    """
    for flag, path in pairwise(ros):
        if flag != '--params-file':
            continue
        names = node_names(path)
        if names and not any(concerns(name, node) for name in names for node in nodes):
            print(
                f'{program}: warning: --params-file {path} concerns none of the nodes: '
                f'the file names {", ".join(names)}; the nodes are {", ".join(nodes)}',
                file=sys.stderr,
            )


def node_names(path: str) -> list[str]:
    """Read the names of nodes, with wildcards, that have parameters in a file; none if it is invalid."""
    from diffdrive_jacobian.bounded_yaml import YAML_ERRORS, load_yaml

    try:
        content = load_yaml(Path(path))
    except (OSError, *YAML_ERRORS):
        return []
    return list(dict.fromkeys(_node_names(content, '')))


def _node_names(section: Any, prefix: str) -> Iterator[str]:
    for key, value in section.items() if isinstance(section, dict) else ():
        if key == 'ros__parameters':
            yield prefix
        else:
            yield from _node_names(value, f'{prefix}/{str(key).strip("/")}')


def concerns(name: str, node: str) -> bool:
    """Return whether a name in a parameter file, where `*` stands for one token and `**` for any number
    of them, is that of a node, as rcl understands it.
    """
    tokens = {'*': '/[^/]+', '**': '(/[^/]+)*'}
    pattern = ''.join(tokens.get(token, '/' + re.escape(token)) for token in name.strip('/').split('/'))
    return re.fullmatch(pattern, node) is not None


def _flat(section: dict[str, Any], prefix: str) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in section.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f'{prefix}{key}.'))
        else:
            flat[f'{prefix}{key}'] = value
    return flat


def _on_one_line(error: Exception) -> str:
    return printable(' '.join(str(error).split()), 200)
