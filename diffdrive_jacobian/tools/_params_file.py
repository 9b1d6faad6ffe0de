"""The robot's parameters from a file of ROS parameters, for tools that run no node."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from diffdrive_jacobian.ros.runner import UserError


def robot_parameters(path: str) -> dict[str, Any]:
    """Read the robot's parameters from a file of ROS parameters.

    Raises:
        UserError: The file is none of that kind.
    """
    try:
        content = YAML(typ='safe').load(Path(path))
        values: dict[str, Any] = {}
        for key, section in content.items():
            if key.rstrip('/').split('/')[-1] in ('virtual_robot', '**'):
                values.update(_flat(section['ros__parameters'], ''))
    except (OSError, UnicodeError, YAMLError, AttributeError, KeyError, TypeError) as error:
        raise UserError(
            f'--params-file must be a file of ROS parameters, got {path}: {_in_one_line(error)}'
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


def _in_one_line(error: Exception) -> str:
    return ' '.join(str(error).split())
