"""Validation of metadata.yaml, recorded parameters and topics of a bag.

rosbags does not check these values. They are checked once, before they are used, so that all tools
report the same damage and name the same key.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import ReaderError
from ruamel.yaml.error import YAMLError

from diffdrive_jacobian.bags.bounded_reader import parse_bounded_qos
from diffdrive_jacobian.bags.files import NotARegularFileError, check_regular
from diffdrive_jacobian.bags.storage import STORAGES
from diffdrive_jacobian.bounded_yaml import YAML_ERRORS, TooLargeError, load_yaml
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.text import printable

LATEST_VERSION = 9
"""Of metadata.yaml, that rosbags reads."""
ROOT = 'rosbag2_bagfile_information'
INVALID = (ReaderError, YAMLError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""What rosbags and the YAML parser raise on values of unexpected types."""
_COMPRESSIONS = ('', 'none', 'file', 'message', 'storage')
_INT64 = 2**63


class MetadataError(DiffdriveError, ValueError):
    """A value in a bag is invalid; the message says which, what it is, and what is allowed."""


def check_metadata(source: Path | str) -> None:
    """Check the content of metadata.yaml.

    Args:
        source: The file, or its text.

    Raises:
        OSError: The file cannot be read.
        MetadataError: It, or a data file that it lists, is not a regular file; or it is not YAML of
            moderate size; or one of its values is invalid.
    """
    try:
        if isinstance(source, Path):
            check_regular(source)
        found = load_yaml(source)
    except NotARegularFileError as error:
        raise MetadataError(str(error)) from error
    except TooLargeError as error:
        raise MetadataError(f'metadata.yaml is too large: {error}') from error
    except YAML_ERRORS as error:
        raise MetadataError(f'metadata.yaml is not valid YAML: {printable(error, 120)}') from error
    whole = _mapping(found, '')
    root = _mapping(_required(whole, ROOT, ''), ROOT)
    _integer(_required(root, 'version', ''), 'version', 1, LATEST_VERSION)
    _choice(_required(root, 'storage_identifier', ''), 'storage_identifier', sorted(STORAGES))
    paths = _sequence(_required(root, 'relative_file_paths', ''), 'relative_file_paths')
    names: set[str] = set()
    for index, path in enumerate(paths):
        where = f'relative_file_paths[{index}]'
        if not _string(path, where) or '\0' in path:
            raise _wrong(where, 'the name of a file', path)
        # rosbags reads, and unpacks, a file as often as it is listed.
        if Path(path).name in names:
            raise _wrong(where, 'a file that is not listed before', path)
        names.add(Path(path).name)
        if isinstance(source, Path):
            _check_data_file(source.parent / Path(path).name)
    count = _integer(_required(root, 'message_count', ''), 'message_count', 0, _INT64 - 1)
    for key, name in (('duration', 'nanoseconds'), ('starting_time', 'nanoseconds_since_epoch')):
        value = _required(_mapping(_required(root, key, ''), key), name, key)
        # Writers differ for a bag without messages.
        _integer(value, f'{key}.{name}', 0 if count else -_INT64, _INT64 - 1)
    topics = _sequence(_required(root, 'topics_with_message_count', ''), 'topics_with_message_count')
    for index, topic in enumerate(topics):
        _check_topic(_mapping(topic, f'topics_with_message_count[{index}]'), index)
    if 'compression_mode' in root:
        mode = _string(root['compression_mode'], 'compression_mode')
        _choice(mode.lower(), 'compression_mode', _COMPRESSIONS)
    for key in ('compression_format', 'ros_distro'):
        if root.get(key) is not None:
            _string(root[key], key)
    for index, file in enumerate(_sequence(root.get('files', []), 'files')):
        _mapping(file, f'files[{index}]')
    check_custom_data(root.get('custom_data'))


def _check_data_file(path: Path) -> None:
    try:
        check_regular(path)
    except NotARegularFileError as error:
        raise MetadataError(str(error)) from error
    except OSError:
        # rosbags reports a file that is missing.
        pass


def _check_topic(topic: dict[str, Any], index: int) -> None:
    where = f'topics_with_message_count[{index}]'
    count = _required(topic, 'message_count', where)
    _integer(count, f'{where}.message_count', 0, _INT64 - 1)
    where += '.topic_metadata'
    described = _mapping(_required(topic, 'topic_metadata', where[: -len('.topic_metadata')]), where)
    for key in ('name', 'type', 'serialization_format'):
        if not _string(_required(described, key, where), f'{where}.{key}'):
            raise _wrong(f'{where}.{key}', 'text that is not empty', '')
    _choice(described['serialization_format'], f'{where}.serialization_format', ['cdr'])
    _string(described.get('type_description_hash', ''), f'{where}.type_description_hash')
    try:
        parse_bounded_qos(described.get('offered_qos_profiles', []))
    except (*INVALID, RecursionError) as error:
        key = f'{where}.offered_qos_profiles'
        raise _wrong(key, 'a list of QoS profiles', described['offered_qos_profiles']) from error


def check_custom_data(custom: object) -> dict[str, str]:
    """Return custom data, {} for None.

    Raises:
        MetadataError: It is not a map of texts.
    """
    custom = {} if custom is None else custom
    if not isinstance(custom, dict) or not all(isinstance(one, str) for one in _flat(custom)):
        raise _wrong('custom_data', 'a map of texts', custom)
    return custom


def parse_parameters(key: str, text: str) -> dict[str, Any]:
    """Return the parameters of a node from an entry of the custom data.

    Args:
        key: The entry's key.
        text: Its value.

    Raises:
        MetadataError: It is not a JSON object.
    """
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MetadataError(f'the {printable(key)} are not JSON: {printable(error)}') from error
    if not isinstance(values, dict):
        raise MetadataError(
            f'the {printable(key)} must be a JSON object, got {printable(repr(text), 40)}'
        )
    return values


def check_connections(described: Iterable[Connection], stored: Iterable[Connection]) -> None:
    """Check the topics of an open bag.

    rosbags reads a message only if metadata.yaml describes its topic exactly as the data file does, and
    skips all others silently.

    Args:
        described: The bag's topics according to metadata.yaml.
        stored: The topics of the data files. They are the same if the bag is a single file.

    Raises:
        MetadataError: A topic's name or type is not text, or a topic with messages is not described.
    """
    described, stored = list(described), list(stored)
    for connection in [*described, *stored]:
        for what, value in (('name', connection.topic), ('type', connection.msgtype)):
            if not isinstance(value, str) or not value:
                raise MetadataError(f'the {what} of a topic must be text, got {printable(repr(value))}')
        if not isinstance(connection.ext, ConnectionExtRosbag2):
            raise MetadataError(f'{printable(connection.topic)} is not a topic of ROS 2')
    by_name = defaultdict(list)
    for connection in described:
        by_name[connection.topic, connection.msgtype].append(connection)
    for connection in stored:
        candidates = by_name[connection.topic, connection.msgtype]
        if connection.msgcount and not any(_alike(connection, one) for one in candidates):
            raise MetadataError(
                f'metadata.yaml does not describe the topic {printable(connection.topic)} of '
                f'{printable(connection.msgtype)} as the data file does '
                '(name, type, type hash, QoS, serialization)'
            )


def _alike(stored: Connection, described: Connection) -> bool:
    """Return whether rosbags considers two topics the same."""
    if (stored.topic, stored.msgtype, stored.ext) != (described.topic, described.msgtype, described.ext):
        return False
    return not stored.digest or not described.digest or stored.digest == described.digest


# --- Checks of single values


def _required(mapping: dict[str, Any], key: str, where: str) -> Any:
    if key not in mapping:
        raise MetadataError(f'metadata.yaml lacks {f"{where}.{key}" if where else key}')
    return mapping[key]


def _wrong(where: str, allowed: str, got: object) -> MetadataError:
    return MetadataError(
        f'metadata.yaml: {where or "its content"} must be {allowed}, got {printable(repr(got), 40)}'
    )


def _mapping(value: object, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _wrong(where, 'a map', value)
    return value


def _sequence(value: object, where: str) -> list[Any]:
    if not isinstance(value, list):
        raise _wrong(where, 'a list', value)
    return value


def _string(value: object, where: str) -> str:
    if not isinstance(value, str):
        raise _wrong(where, 'text', value)
    return value


def _choice(value: object, where: str, choices: Sequence[str]) -> None:
    if value not in choices:
        raise _wrong(where, f'one of {", ".join(repr(one) for one in choices)}', value)


def _integer(value: object, where: str, low: int, high: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise _wrong(where, f'an integer from {low} to {high}', value)
    return value


def _flat(mapping: dict[Any, Any]) -> list[Any]:
    return [*mapping.keys(), *mapping.values()]
