"""Parameters of virtual_robot from a ROS parameter file, for tools that run no node."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from diffdrive_jacobian.bounded_yaml import YAML_ERRORS, load_yaml
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.text import printable


def robot_parameters(path: str) -> dict[str, Any]:
    """Return the parameters of virtual_robot in a ROS parameter file, by name.

    Raises:
        UserError: The file cannot be read or is not a ROS parameter file.
    """
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
