"""Files of ROS parameters that concern none of the nodes of a process."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

MAX_SIZE = 1_000_000
"""Larger files are not parsed for the names of nodes (bytes)."""


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
    """Read the names of nodes, with wildcards, for which a file has parameters.

    Only the structure of the file is parsed and no alias is expanded. Files that rcl does not read
    either, and those larger than MAX_SIZE, give no names.
    """
    # Slow to import, and a node without such a file does not need it.
    from ruamel.yaml.error import YAMLError

    try:
        if os.path.getsize(path) > MAX_SIZE:
            return []
        names = dict.fromkeys(_node_names(Path(path).read_text()))
    except (OSError, UnicodeError, YAMLError):
        return []
    return list(names)


def _node_names(text: str) -> Iterator[str]:
    from ruamel.yaml import YAML
    from ruamel.yaml.events import (
        CollectionEndEvent,
        CollectionStartEvent,
        MappingStartEvent,
        ScalarEvent,
    )

    # Of each collection that is open: its key in the collection around it, the key whose value comes
    # next, and whether it is a mapping.
    outer: list[str | None] = []
    key: str | None = None
    mapping = False
    stack: list[tuple[str | None, bool]] = []
    for event in YAML(typ='safe', pure=True).parse(text):
        if isinstance(event, CollectionStartEvent):
            stack.append((key, mapping))
            outer.append(key)
            key, mapping = None, isinstance(event, MappingStartEvent)
        elif isinstance(event, CollectionEndEvent):
            _, mapping = stack.pop()
            outer.pop()
            key = None
        elif isinstance(event, ScalarEvent) and mapping and key is None:
            key = str(event.value)
            if key == 'ros__parameters':
                names = [name.strip('/') for name in outer if name is not None]
                yield '/' + '/'.join(names)
        else:
            key = None


def concerns(name: str, node: str) -> bool:
    """Return whether a name in a parameter file, where `*` stands for one token and `**` for any number
    of them, is that of a node, as rcl understands it.
    """
    tokens = {'*': '/[^/]+', '**': '(/[^/]+)*'}
    pattern = ''.join(tokens.get(token, '/' + re.escape(token)) for token in name.strip('/').split('/'))
    return re.fullmatch(pattern, node) is not None
