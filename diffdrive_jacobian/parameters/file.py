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

"""ROS parameter files, read without ROS: for whom they are, what virtual_robot gets, installed ones."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.text import printable

Sections = list[tuple[str, dict[str, Any]]]
"""The name of a node, with wildcards, and its parameters, as often as the file has some."""


def sections(path: str) -> Sections:
    """Return the parameters in a ROS parameter file with the names for which they are.

    Raises:
        UserError: The file cannot be read or is not a ROS parameter file.
    """
    # Slow to import.
    from diffdrive_jacobian.safe_yaml import YAML_ERRORS, load_yaml

    try:
        return list(_sections(load_yaml(Path(path)), ''))
    except (OSError, *YAML_ERRORS) as error:
        why = printable(' '.join(str(error).split()), 200)
        raise UserError(f'--params-file must be a file of ROS parameters, got {path}: {why}') from error


def robot_parameters(path: str) -> dict[str, Any]:
    """Return the parameters of virtual_robot in a ROS parameter file, by name.

    Raises:
        UserError: The file cannot be read, is not a ROS parameter file, has no such parameters, or has
            those of several robots.
    """
    found = sections(path)
    values: dict[str, Any] = {}
    several = sorted({name for name, _ in found if name.endswith('/virtual_robot') and '*' not in name})
    if len(several) > 1:
        raise UserError(
            f'--params-file must be for one virtual_robot, got {path} for {", ".join(several)}'
        )
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


# --- Files of robots that are installed with this package

PACKAGE = 'diffdrive_jacobian'
SHARE = Path('share', PACKAGE, 'config')
"""Directory of the files below the prefix of an installation."""


def configurations() -> dict[str, Path]:
    """Return the parameter files by the names of the robots, sorted."""
    found: dict[str, Path] = {}
    for file in _files():
        found.setdefault(file.stem, file)
    if not found:
        for file in _listed_files():
            found.setdefault(file.stem, file)
    return dict(sorted(found.items()))


def _files() -> Iterator[Path]:
    """Yield the files of the clone, of the Python installation and of the ROS installation."""
    # An editable installation has no copy of them.
    above = Path(__file__).parents[2]
    if (above / 'setup.py').is_file():
        yield from (above / 'config').glob('*.yaml')
    # As `pip install --target` lays it out, and below a prefix, in lib/python3.X/site-packages.
    yield from (above / SHARE).glob('*.yaml')
    if len(above.parents) > 2:
        yield from (above.parents[2] / SHARE).glob('*.yaml')
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        if prefix:
            yield from (Path(prefix) / SHARE).glob('*.yaml')


def _listed_files() -> Iterator[Path]:
    """Yield the files that the installation lists, which may be anywhere."""
    # Not above: it takes 20 ms to import.
    from importlib import metadata

    try:
        files = metadata.distribution(PACKAGE).files or ()
    except metadata.PackageNotFoundError:
        return
    for file in files:
        if file.suffix == '.yaml' and file.parent.parts[-len(SHARE.parts) :] == SHARE.parts:
            path = Path(str(file.locate())).resolve()
            if path.is_file():
                yield path
