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
from collections.abc import Callable, Iterable
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.control.path import Path
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.numerics.checks import between, finite, number, short
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
COLUMNS = {
    **{'x': 'x', 'x_m': 'x', 'y': 'y', 'y_m': 'y', 'theta': 'theta', 'theta_rad': 'theta'},
    **{'t': 't', 'time': 't', 'time_s': 't'},
}
"""Names of the columns of a file, those of `plot_run --csv` included, to what they are."""
_UNNAMED = {2: ('x', 'y'), 3: ('x', 'y', 'theta'), 4: ('x', 'y', 'theta', 't')}


class PathError(DiffdriveError, ValueError):
    """A text is no path, or a file has none. The message says where and what is allowed."""


def _check_size(name: str, size: float) -> None:
    between(LEAST_SIZE, GREATEST_SIZE, unit='m')(name, size)


def circle_path(radius: float) -> Path:
    """Return a circle to the left, of a radius in [0.001, 1e5] (m)."""
    radius = number('radius', radius, _check_size)
    return _shape(lambda u: (radius * np.sin(u), radius * (1.0 - np.cos(u))), 2.0 * math.pi * radius)


def line_path(length: float) -> Path:
    """Return a straight line of a length in [0.001, 1e5] (m)."""
    length = number('length', length, _check_size)
    return _shape(lambda u: (length * u / (2.0 * math.pi), 0.0 * u), length)


def figure_eight_path(size: float) -> Path:
    """Return a figure eight, the lemniscate of Bernoulli, from one of its ends to the left.

    With `c = a / (1 + sin(u)^2)` it is `x = c sin(u) cos(u), y = a - c cos(u)`. It is 2 a long in y, and
    narrowest at its ends, with the radius a/3. The size a is in [0.001, 1e5] (m).
    """
    a = number('size', size, _check_size)

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
            return SHAPES[shape](number('size', float(size), _check_size))
        except ValueError:
            raise PathError(
                f'size of a shape must be in [{LEAST_SIZE:g}, {GREATEST_SIZE:g}] m, got '
                f'{short(text, repr)}'
            ) from None
    file = FilePath(text)
    read = _READERS.get(file.suffix.lower())
    if read is None:
        raise PathError(f'path must be {ALLOWED}, got {short(text, repr)}')
    try:
        if not file.is_file():
            raise PathError('there is no such file')
        if (taken := file.stat().st_size) > MAX_FILE_SIZE:
            raise PathError(
                f'it must have at most {format_size(MAX_FILE_SIZE)}, got {format_size(taken)}'
            )
        columns = read(file)
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


def _read_csv(file: FilePath) -> dict[str, Floats]:
    """Return the columns of a CSV file. Errors give the line."""
    with open(file, encoding='utf-8-sig', newline='') as stream:
        reader = csv.reader(line for line in stream)
        names: dict[int, str] | None = None
        rows: list[list[float]] = []
        width = 0
        for row in reader:
            cells = [cell.strip() for cell in row]
            if not any(cells) or cells[0].startswith('#'):
                continue
            if names is None:
                names, width = _column_names(cells), len(cells)
                if not _is_number(cells[0]):
                    continue
            place = f'line {reader.line_num}'
            if len(cells) != width:
                raise PathError(f'{place} must have {width} columns, got {len(cells)}')
            rows.append([_value(f'{place}: {name}', cells[at]) for at, name in names.items()])
            _check_count(len(rows))
    if names is None or not rows:
        raise PathError('it must have a pose in each line, got none')
    columns = np.reshape(np.array(rows, dtype=np.float64), (-1, len(names))).T
    return dict(zip(names.values(), columns, strict=True))


def _column_names(cells: list[str]) -> dict[int, str]:
    """Return which columns of a CSV file are which, by their index."""
    if _is_number(cells[0]):
        if len(cells) not in _UNNAMED:
            raise PathError(f'columns without names must be x, y[, theta[, t]], got {len(cells)}')
        return dict(enumerate(_UNNAMED[len(cells)]))
    found = {at: COLUMNS[name.lower()] for at, name in enumerate(cells) if name.lower() in COLUMNS}
    _check_names(found.values(), cells)
    return found


def _read_yaml(file: FilePath) -> dict[str, Floats]:
    """Return the columns of a YAML file. Errors give the number of the pose."""
    # ruamel.yaml takes time to import, and the laws do not need it.
    from diffdrive_jacobian.safe_yaml import YAML_ERRORS, load_yaml

    try:
        content = load_yaml(file)
    except YAML_ERRORS as error:
        if isinstance(error, UnicodeDecodeError):
            raise
        raise PathError(f'it must be YAML: {error}') from error
    poses = content.get('poses') if isinstance(content, dict) else content
    if not isinstance(poses, list) or not poses:
        raise PathError(f"it must be a list of poses or have one as 'poses', got {short(content, repr)}")
    _check_count(len(poses))
    rows = [_named(f'pose {index}', pose) for index, pose in enumerate(poses, 1)]
    for index, row in enumerate(rows, 1):
        if row.keys() != rows[0].keys():
            raise PathError(
                f'pose {index} must have {", ".join(rows[0])} as pose 1 has, got {", ".join(row)}'
            )
    return {
        name: np.array([_value(f'pose {at}: {name}', row[name]) for at, row in enumerate(rows, 1)])
        for name in rows[0]
    }


_READERS = {'.csv': _read_csv, '.yaml': _read_yaml, '.yml': _read_yaml}


def _named(place: str, pose: Any) -> dict[str, Any]:
    """Return the entries of a pose in YAML by their names."""
    if isinstance(pose, dict):
        found = {COLUMNS[name]: value for name, value in pose.items() if name in COLUMNS}
        _check_names(found, [*map(str, pose)], f'{place}: ')
        return found
    if not isinstance(pose, list) or len(pose) not in _UNNAMED:
        raise PathError(f'{place} must be [x, y], [x, y, theta] or a map, got {short(pose, repr)}')
    return dict(zip(_UNNAMED[len(pose)], pose, strict=True))


def _check_names(found: Iterable[str], got: list[str], place: str = '') -> None:
    found = list(found)
    if len(set(found)) < len(found):
        raise PathError(f'{place}columns must have different names, got {short(", ".join(got))}')
    if not {'x', 'y'} <= set(found):
        raise PathError(
            f'{place}columns must have x and y, and may have theta and t, got {short(", ".join(got))}'
        )


def _check_count(count: int) -> None:
    if count > MAX_FILE_POSES:
        raise PathError(f'it must have at most {MAX_FILE_POSES} poses, got more')


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _value(place: str, value: Any) -> float:
    try:
        # A text comes from CSV; YAML has numbers.
        return number(place, float(value) if isinstance(value, str) else value, finite)
    except ValueError:
        raise PathError(f'{place} must be a finite number, got {short(value, repr)}') from None
