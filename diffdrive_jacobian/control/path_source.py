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

"""Paths by a short text: a shape and its size, or the name of a file of poses.

    circle:1.0      a circle to the left of the robot, of this radius (m)
    line:2.0        a straight line ahead, of this length (m)
    eight:1.0       a figure eight, of this length from its middle to its ends (m)
    poses.csv       x, y and perhaps theta and t in columns
    poses.yaml      a list of poses

Shapes begin at the origin, along the x axis.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path as FilePath
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control.path import Path
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.numerics.checks import between, number, short
from diffdrive_jacobian.text import format_size, printable

Floats = NDArray[np.float64]

MAX_FILE_POSES = 100_000
"""Most poses of a file."""
MAX_FILE_SIZE = 20_000_000
"""Size of the largest file (bytes)."""
SPACING = 0.05
"""Largest distance between the poses of a shape (m), that of common planners."""
MOST, FEWEST = 5_000, 64
"""Number of poses of large and of small shapes."""
LEAST_SIZE, GREATEST_SIZE = 1e-3, 1e5
"""Sizes of shapes (m)."""
NAMES = {
    'x': ('x', 'x_m'),
    'y': ('y', 'y_m'),
    'theta': ('theta', 'theta_rad'),
    't': ('t', 'time', 'time_s'),
}
"""Names of the columns of a file, also those of `plot_run --csv`."""
COLUMNS = {name: column for column, names in NAMES.items() for name in names}
UNNAMED = {2: ('x', 'y'), 3: ('x', 'y', 'theta'), 4: ('x', 'y', 'theta', 't')}


class PathError(DiffdriveError, ValueError):
    """A text is no path, or a file has none. The message says where and what is allowed."""


_size = between(LEAST_SIZE, GREATEST_SIZE, unit='m')


def circle_path(radius: float) -> Path:
    """Return a circle to the left, of a radius in [0.001, 1e5] (m)."""
    radius = _size('radius', radius)
    return _shape(lambda u: (radius * np.sin(u), radius * (1.0 - np.cos(u))), 2.0 * math.pi * radius)


def line_path(length: float) -> Path:
    """Return a straight line of a length in [0.001, 1e5] (m)."""
    length = _size('length', length)
    return _shape(lambda u: (length * u / (2.0 * math.pi), 0.0 * u), length)


def figure_eight_path(size: float) -> Path:
    """Return a figure eight, the lemniscate of Bernoulli, from one of its ends to the left.

    With `c = a / (1 + sin(u)^2)` it is `x = c sin(u) cos(u), y = a - c cos(u)`. It is 2 a long in y, and
    narrowest at its ends, with the radius a/3. The size a is in [0.001, 1e5] (m).
    """
    a = _size('size', size)

    def point(u: Floats) -> tuple[Floats, Floats]:
        c = a / (1.0 + np.sin(u) ** 2)
        return c * np.sin(u) * np.cos(u), a - c * np.cos(u)

    return _shape(point, 2.0 * math.pi * a)


SHAPES: dict[str, Callable[[float], Path]] = {
    'circle': circle_path,
    'line': line_path,
    'eight': figure_eight_path,
}
"""Shapes by their names, and what makes them of their size (m)."""
ALLOWED = 'circle:RADIUS, line:LENGTH, eight:SIZE (m) or the name of a .csv or .yaml file of poses'


def is_shape(text: str) -> bool:
    """Return whether a text is to be a shape rather than the name of a file."""
    return text.partition(':')[0] in SHAPES


def planned_path(text: str) -> Path:
    """Return the path of a text such as `circle:1.0` or `poses.csv`.

    A file of poses in CSV has their columns: x and y, perhaps theta, and the time t of a trajectory (m,
    m, rad, s). The first line names them in any order, also as `plot_run --csv` writes them, and other
    columns are ignored. Without names they are in this order. A YAML file has a list of maps with these
    names, or of lists in this order, perhaps under the name `poses`. A text that is neither, a file that
    cannot be read, and poses that are no path raise PathError.
    """
    shape, _, size = text.partition(':')
    if shape in SHAPES and not size:
        raise PathError(f'{shape} needs its size (m), as in {shape}:1.0, got {short(text, repr)}')
    if shape in SHAPES:
        try:
            return SHAPES[shape](float(size))
        except ValueError:
            raise PathError(
                f'size of a shape must be in [{LEAST_SIZE:g}, {GREATEST_SIZE:g}] m, got '
                f'{short(text, repr)}'
            ) from None
    file = FilePath(text)
    read = READERS.get(file.suffix.lower())
    if read is None:
        raise PathError(f'path must be {ALLOWED}, got {short(text, repr)}')
    try:
        if not file.is_file():
            raise PathError('there is no such file')
        if (taken := file.stat().st_size) > MAX_FILE_SIZE:
            raise PathError(
                f'it must have at most {format_size(MAX_FILE_SIZE)}, got {format_size(taken)}'
            )
        columns = _columns(read(file))
        poses = np.column_stack([columns['x'], columns['y'], columns.get('theta', 0.0 * columns['x'])])
        return Path(poses, columns.get('t'))
    except UnicodeDecodeError as error:
        raise PathError(f'{text}: it must be text in UTF-8, got other bytes') from error
    except (OSError, ValueError, csv.Error) as error:
        raise PathError(f'{text}: {printable(" ".join(str(error).split()), 200)}') from error


def _shape(point: Callable[[Floats], tuple[Floats, Floats]], length: float) -> Path:
    """Return the path of a curve over an angle from 0 to 2 pi, with the headings of its tangents.

    `length` is that of the curve, or more where its points are not evenly spaced.
    """
    count = min(max(math.ceil(length / SPACING), FEWEST), MOST)
    angles: Floats = np.linspace(0.0, 2.0 * math.pi, count + 1, dtype=np.float64)
    path = Path(np.column_stack(point(angles)))
    # The end of a closed path is its beginning.
    inside = np.minimum(path.arc_lengths, np.nextafter(path.length, 0.0))
    headings = path.poses_at(inside)[:, 2]
    return Path(np.column_stack([path.poses[:, :2], headings]))


# --- Files

Row: TypeAlias = tuple[str, Sequence[Any], Sequence[Any]]
"""Where a pose stands in its file, the names of its columns, and their values."""


def _csv_rows(file: FilePath) -> Iterator[Row]:
    """Yield the poses of a CSV file. The first line may name the columns."""
    with open(file, encoding='utf-8-sig', newline='') as stream:
        reader = csv.reader(stream)
        names: Sequence[str] = ()
        for cells in reader:
            row = [cell.strip() for cell in cells]
            if not any(row) or row[0].startswith('#'):
                continue
            place = f'line {reader.line_num}'
            if not names and not _is_number(row[0]):
                names = row
                continue
            names = names or _names(place, row)
            if len(row) != len(names):
                raise PathError(f'{place} must have {len(names)} columns, got {len(row)}')
            yield place, names, row


def _yaml_rows(file: FilePath) -> Iterator[Row]:
    """Yield the poses of a YAML file, each a map or a list."""
    # ruamel.yaml takes time to import, and the laws do not need it.
    from diffdrive_jacobian.safe_yaml import YAML_ERRORS, load_yaml

    try:
        content = load_yaml(file)
    except YAML_ERRORS as error:
        if isinstance(error, UnicodeDecodeError):
            raise
        raise PathError(f'it must be YAML: {error}') from error
    poses = content.get('poses') if isinstance(content, dict) else content
    if not isinstance(poses, list):
        raise PathError(f"it must be a list of poses or have one as 'poses', got {short(content, repr)}")
    for index, pose in enumerate(poses, 1):
        place = f'pose {index}'
        if isinstance(pose, dict):
            yield place, list(pose), list(pose.values())
        elif isinstance(pose, list):
            yield place, _names(place, pose), pose
        else:
            raise PathError(f'{place} must be [x, y], [x, y, theta] or a map, got {short(pose, repr)}')


READERS = {'.csv': _csv_rows, '.yaml': _yaml_rows, '.yml': _yaml_rows}


def _names(place: str, row: Sequence[Any]) -> Sequence[str]:
    if len(row) not in UNNAMED:
        raise PathError(
            f'{place}: columns without names must be x, y[, theta[, t]], got {len(row)} of them'
        )
    return UNNAMED[len(row)]


def _columns(rows: Iterable[Row]) -> dict[str, Floats]:
    """Return the columns of a file by what they are."""
    poses: list[dict[str, float]] = []
    for place, names, values in rows:
        if len(poses) == MAX_FILE_POSES:
            raise PathError(f'it must have at most {MAX_FILE_POSES} poses, got more')
        known = [COLUMNS.get(str(name).lower(), '') for name in names]
        named = [pair for pair in zip(known, values, strict=True) if pair[0]]
        pose = {name: _value(f'{place}: {name}', value) for name, value in named}
        got = short(', '.join(map(str, names)))
        if len(pose) < len(named):
            raise PathError(f'{place}: columns must have different names, got {got}')
        if not {'x', 'y'} <= pose.keys():
            raise PathError(f'{place}: columns must have x and y, and may have theta and t, got {got}')
        if poses and pose.keys() != poses[0].keys():
            raise PathError(f'{place} must have {", ".join(poses[0])} as the first pose has, got {got}')
        poses.append(pose)
    if not poses:
        raise PathError('it must have a list of poses, or a pose in each line, got none')
    return {name: np.array([pose[name] for pose in poses]) for name in poses[0]}


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _value(place: str, value: Any) -> float:
    try:
        # A text comes from CSV; YAML has numbers.
        return number(place, float(value) if isinstance(value, str) else value)
    except ValueError:
        raise PathError(f'{place} must be a finite number, got {short(value, repr)}') from None
