"""Parameter files that contain parameters of none of the nodes of a process."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any


def warn_of_unused_files(program: str, ros: Sequence[str], nodes: Sequence[str]) -> None:
    """Print a warning for each parameter file without parameters of any of the nodes.

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
                f'{program}: warning: --params-file {path} has no parameters of these nodes: '
                f'it is for {", ".join(names)}, the nodes are {", ".join(nodes)}',
                file=sys.stderr,
            )


def node_names(path: str) -> list[str]:
    """Return the names of the nodes, with wildcards, that have parameters in a file.

    The list is empty if the file is invalid.
    """
    # Slow to import, and a node without such a file does not need it.
    from diffdrive_jacobian.bounded_yaml import YAML_ERRORS, load_yaml

    try:
        content = load_yaml(Path(path))
    except (OSError, *YAML_ERRORS):
        return []
    return list(dict.fromkeys(_node_names(content, '')))


def _node_names(section: Any, prefix: str) -> Iterator[str]:
    for key, value in section.items() if isinstance(section, dict) else ():
        if key == 'ros__parameters':
            yield prefix or '/'
        else:
            yield from _node_names(value, f'{prefix}/{str(key).strip("/")}')


def concerns(name: str, node: str) -> bool:
    """Return whether rcl applies the parameters under a name to a node.

    Args:
        name: Name in a parameter file. `*` stands for one token, `**` for any number of tokens.
        node: Fully qualified name of the node.
    """
    tokens = {'*': '/[^/]+', '**': '(/[^/]+)*'}
    pattern = ''.join(tokens.get(token, '/' + re.escape(token)) for token in name.strip('/').split('/'))
    return re.fullmatch(pattern, node) is not None
