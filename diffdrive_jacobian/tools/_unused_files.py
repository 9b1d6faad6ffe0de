"""Parameter files that contain parameters of none of the nodes of a process."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise

from diffdrive_jacobian.errors import UserError


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
