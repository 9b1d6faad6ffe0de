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

"""Message types of the installed packages: their definitions and their Python classes.

A bag stores the full definition of each type, so that it can be read where the type is not installed.

Names of types come from bags and from other processes. A package is imported only if its name is a valid
one, the first module of that name on the import path lies in an installation prefix, and the share
directory of the same prefix holds the .msg file. All of that is checked without importing anything.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.messages.names import import_type
from diffdrive_jacobian.messages.structure import (
    CODES,
    Array,
    FieldType,
    Number,
    Sequence,
    Structure,
    Text,
)
from diffdrive_jacobian.text import printable

GOALS = 'nav_msgs/msg/Goals'
GOALS_DEFINITION = """std_msgs/Header header
geometry_msgs/PoseStamped[] goals
"""
"""The only type of ROS 2 Jazzy that is read here and that rosbags lacks."""
_NUMBERS = {'bool': 'boolean', 'byte': 'octet', 'char': 'uint8', 'float32': 'float', 'float64': 'double'}
"""Types of numbers in .msg files to their names in rosidl, where these differ."""
_NONE = 'structure_needs_at_least_one_member'
"""The only field of a message without fields, as rosbags has it."""
_HASH = re.compile('RIHS01_[0-9a-f]{64}')
DELIMITER = '=' * 80
_NAME = re.compile(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9_]*)')
_LIBRARIES = (('lib',), ('lib64',), ('local', 'lib'), ('Lib',))
"""Directories of Python packages, relative to a prefix."""
_FIELD = re.compile(r'^\s*([A-Za-z]\w*(?:/[A-Za-z]\w*)?)(?:<=\d+)?(?:\[[^]]*\])?\s+[A-Za-z]\w*')
_PRIMITIVE = re.compile(r'bool|byte|char|float(32|64)|u?int(8|16|32|64)|w?string')


@cache
def _typestore() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(GOALS_DEFINITION, GOALS))
    return store


def is_known(type_name: str) -> bool:
    """Return whether a type (`package/msg/Name`) is known without ROS."""
    return type_name in _typestore().fielddefs


def _store_with(type_name: str) -> Typestore:
    if not is_known(type_name):
        raise UnknownTypeError(f'{printable(type_name)} is not a type of ROS 2 Jazzy')
    return _typestore()


@cache
def known_definition(type_name: str) -> Definition:
    """Return the definition of a type (`package/msg/Name`) that is known without ROS.

    Raises:
        UnknownTypeError: It is not known.
    """
    store = _store_with(type_name)
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return Definition(name=type_name, text=text, type_hash=store.hash_rihs01(type_name))


@cache
def known_structure(type_name: str) -> Structure:
    """Return the types of the fields of a type that is known without ROS.

    Raises:
        UnknownTypeError: It is not known.
    """
    return _structure(_store_with(type_name).fielddefs, type_name)


def installed_structure(type_name: str) -> Structure:
    """Return the types of the fields of an installed message type.

    Raises:
        UnknownTypeError: No installed package defines it, or its files are invalid.
    """
    text = definition(type_name).text
    try:
        return _structure(get_types_from_msg(text, type_name), type_name)
    except (TypesysError, LookupError, RecursionError) as error:
        raise UnknownTypeError(
            f'the installed definition of {type_name} is invalid: {printable(repr(error))}'
        ) from error


def _structure(definitions: Mapping[str, Any], name: str) -> Structure:
    """Return the types of the fields of a message from definitions that rosbags has parsed."""

    def field(described: Any) -> FieldType:
        node, content = described
        if node == Nodetype.NAME:
            return _structure(definitions, content)
        kind, count = content
        if node == Nodetype.ARRAY:
            return Array(field(kind), count)
        if node == Nodetype.SEQUENCE:
            return Sequence(field(kind), count or None)
        if kind in ('string', 'wstring'):
            return Text(kind == 'wstring', count or None)
        return Number(CODES[_NUMBERS.get(kind, kind)])

    _, fields = definitions[name]
    own = ((field_name, field(described)) for field_name, described in fields if field_name != _NONE)
    return Structure(name.replace('/msg/', '/'), tuple(own))


def recorded_definition_differs(type_name: str, type_hashes: Iterable[str]) -> bool:
    """Return whether a known type was recorded with another definition, by its hashes in a bag.

    Hashes that are empty or no RIHS01 hash do not count.
    """
    known = _typestore().hash_rihs01(type_name)
    return any(_HASH.fullmatch(one) and one != known for one in type_hashes)


def type_hashes(connection: Connection, stored: Iterable[Connection]) -> list[str]:
    """Return the hashes of a topic's type in metadata.yaml and in the data files (`stored`)."""
    alike = (one for one in stored if (one.topic, one.msgtype) == (connection.topic, connection.msgtype))
    return [str(one.digest) for one in (connection, *alike)]


class UnknownTypeError(DiffdriveError):
    """No installed package defines a message type."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Definition:
    """A message type."""

    name: str
    """`package/msg/Name`."""
    text: str
    """Its .msg file, followed by those of all types in its fields, as rosbag2 stores it."""
    type_hash: str
    """`RIHS01_` and 64 hexadecimal digits (REP 2011)."""


@cache
def definition(name: str) -> Definition:
    """Return the definition of an installed message type (`package/msg/Name`).

    Raises:
        UnknownTypeError: No installed package defines it, or its files are invalid.
    """
    package, message = _split(name)
    try:
        described = json.loads(_file(package, message, '.json').read_text(encoding='utf-8'))
        hashes = {one['type_name']: one['hash_string'] for one in described['type_hashes']}
        text = _full_text(package, message, set())
        return Definition(name=name, text=text, type_hash=hashes[name])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise UnknownTypeError(
            f'the installed definition of {name} is invalid: {printable(repr(error))}'
        ) from error


def definition_and_hash(type_name: str, text: str, type_hash: str) -> tuple[str, str]:
    """Return the definition of a type, and its hash, given what a bag has of them; '': nothing.

    Raises:
        UnknownTypeError: The bag lacks one of them, and the type is not known.
    """
    known = None
    try:
        known = _installed_or_known(type_name)
        reason = f'{type_name} is installed in another version than it was recorded'
    except UnknownTypeError as error:
        reason = str(error)
    # Where the hashes are the same, the text in the file may be damaged, or differ in comments.
    if known is not None and (
        type_hash == known.type_hash or (not type_hash and text in ('', known.text))
    ):
        return known.text, known.type_hash
    if text and type_hash:
        return text, type_hash
    if not text:
        raise UnknownTypeError(reason)
    try:
        # rosbags' `register` would generate code from it and execute that.
        store = get_typestore(Stores.EMPTY)
        store.fielddefs.update(get_types_from_msg(text, type_name))
        return text, store.hash_rihs01(type_name)
    except (TypesysError, LookupError, ValueError, AssertionError, RecursionError) as error:
        raise UnknownTypeError(reason) from error


def _installed_or_known(type_name: str) -> Definition:
    try:
        return definition(type_name)
    except UnknownTypeError:
        if is_known(type_name):
            return known_definition(type_name)
        raise


@cache
def message_class(name: str) -> Any:
    """Return the Python class of a message type (`package/msg/Name`).

    Raises:
        UnknownTypeError: No installed package defines it, or its Python code or its type support is not
            installed or cannot be loaded.
    """
    package, message = _split(name)
    _file(package, message, '.msg')
    try:
        found = import_type(name)
    except (ImportError, AttributeError) as error:
        raise UnknownTypeError(f'the Python code of {name} is not installed') from error
    # Code of other packages can raise any exception.
    except Exception as error:
        raise UnknownTypeError(
            f'the Python code of {name} cannot be imported: {printable(repr(error))}'
        ) from error
    # As rclpy does when it creates a subscription.
    kind: Any = type(found)
    try:
        if kind._TYPE_SUPPORT is None:
            kind.__import_type_support__()
        missing = kind._TYPE_SUPPORT is None
    # UnsupportedTypeSupport of rosidl_generator_py is a plain Exception.
    except Exception as error:
        raise UnknownTypeError(
            f'the type support of {name} cannot be loaded: {printable(repr(error))}'
        ) from error
    if missing:
        raise UnknownTypeError(f'the type support of {name} is not installed')
    return found


def _split(name: str) -> tuple[str, str]:
    """Return package and message of a valid name of a message type."""
    if (match := _NAME.fullmatch(name)) is None:
        raise UnknownTypeError(
            f'a message type must be named package/msg/Name, got {printable(repr(name))}'
        )
    return match[1], match[2]


def _full_text(package: str, message: str, seen: set[tuple[str, str]]) -> str:
    """Return a .msg file and those that it depends on, depth first and sorted by name."""
    text = _file(package, message, '.msg').read_text(encoding='utf-8')
    parts = [text]
    for dependency in sorted(_dependencies(package, text)):
        if dependency not in seen:
            seen.add(dependency)
            head = f'\n{DELIMITER}\nMSG: {"/".join(dependency)}\n'
            parts.append(head + _full_text(*dependency, seen))
    return ''.join(parts)


def _dependencies(package: str, text: str) -> set[tuple[str, str]]:
    types = (match[1].rpartition('/') for match in map(_FIELD.match, text.splitlines()) if match)
    return {(owner or package, name) for owner, _, name in types if not _PRIMITIVE.fullmatch(name)}


def _file(package: str, message: str, ending: str) -> Path:
    """Return a file of an interface package, from the prefix that also has its Python code."""
    for prefix in _prefixes(package):
        path = prefix / 'share' / package / 'msg' / f'{message}{ending}'
        if path.is_file():
            return path
    raise UnknownTypeError(f'no installed package defines {package}/msg/{message}')


def _prefixes(package: str) -> list[Path]:
    """Return the installation prefixes that the module which `import` would find may belong to."""
    # Code beside a bag is not installed: it is found by a relative entry, or in the current directory.
    here = Path.cwd()
    installed = [entry for entry in sys.path if os.path.isabs(entry) and Path(entry).resolve() != here]
    # For a name without dots this imports nothing, not even a parent.
    spec, expected = PathFinder.find_spec(package), PathFinder.find_spec(package, installed)
    if spec is None or spec.origin is None or expected is None or spec.origin != expected.origin:
        return []
    library = Path(spec.origin).parent.parent
    return [
        prefix
        for prefix in library.parents
        if any(library.relative_to(prefix).parts[: len(one)] == one for one in _LIBRARIES)
    ]
