"""What a message type means, as the installed message packages say it.

A bag stores the full definition of each type, so that it can be read where the type is not installed.
"""

from __future__ import annotations

import importlib.util
import json
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

DELIMITER = '=' * 80
_FIELD = re.compile(r'^\s*([A-Za-z]\w*(?:/[A-Za-z]\w*)?)(?:<=\d+)?(?:\[[^]]*\])?\s+[A-Za-z]\w*')
_PRIMITIVE = re.compile(r'bool|byte|char|float(32|64)|u?int(8|16|32|64)|w?string')


class UnknownTypeError(Exception):
    """No installed package defines a message type."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Definition:
    """A message type."""

    name: str
    """`package/msg/Name`."""
    text: str
    """Its .msg file, followed by those of all types that it is made of, as rosbag2 stores it."""
    type_hash: str
    """`RIHS01_` and 64 hexadecimal digits (REP 2011)."""


@cache
def definition(name: str) -> Definition:
    """Look a message type up.

    Args:
        name: `package/msg/Name`.

    Raises:
        UnknownTypeError: No installed package defines it.
    """
    package, interface, message = _split(name)
    if interface != 'msg':
        raise UnknownTypeError(f'only messages can be recorded, got {name!r}')
    described = json.loads(_file(package, message, '.json').read_text(encoding='utf-8'))
    hashes = {one['type_name']: one['hash_string'] for one in described['type_hashes']}
    return Definition(name=name, text=_full_text(package, message, set()), type_hash=hashes[name])


def _split(name: str) -> tuple[str, str, str]:
    parts = name.split('/')
    if len(parts) != 3 or not all(parts):
        raise UnknownTypeError(f'a message type must be named package/msg/Name, got {name!r}')
    return parts[0], parts[1], parts[2]


def _full_text(package: str, message: str, seen: set[tuple[str, str]]) -> str:
    """Give a .msg file and, depth first and in the order of their names, those that it needs."""
    text = _file(package, message, '.msg').read_text(encoding='utf-8')
    parts = [text]
    for dependency in sorted(_dependencies(package, text)):
        if dependency not in seen:
            seen.add(dependency)
            head = f'\n{DELIMITER}\nMSG: {"/".join(dependency)}\n'
            parts.append(head + _full_text(*dependency, seen))
    return ''.join(parts)


def _dependencies(package: str, text: str) -> set[tuple[str, str]]:
    found = set()
    for line in text.splitlines():
        match = _FIELD.match(line)
        if match is None or _PRIMITIVE.fullmatch(match.group(1)):
            continue
        owner, _, name = match.group(1).rpartition('/')
        found.add((owner or package, name))
    return found


def _file(package: str, message: str, ending: str) -> Path:
    """Find a file of an interface package: it lies in the share directory beside its Python code."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        spec = None
    if spec is not None and spec.origin is not None:
        for parent in Path(spec.origin).parents:
            path = parent / 'share' / package / 'msg' / f'{message}{ending}'
            if path.is_file():
                return path
    raise UnknownTypeError(f'no installed package defines {package}/msg/{message}')
