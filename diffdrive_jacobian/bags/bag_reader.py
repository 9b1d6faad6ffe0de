"""Opening of bags of unknown origin, whose metadata is checked, and their messages and parameters."""

from __future__ import annotations

import json
import shlex
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.metadata import parse_qos
from ruamel.yaml.error import YAMLError

from diffdrive_jacobian.bags.corrected_reader import CorrectedReader
from diffdrive_jacobian.bags.files import NotARegularFileError, check_regular, is_recoverable, journal_of
from diffdrive_jacobian.bags.journal import LEFT_OUT, LOST, PARAMETERS
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.numerics.checks import (
    integer,
    mapping,
    nonempty,
    one_of,
    optional,
    sequence,
    short,
    text,
)
from diffdrive_jacobian.safe_yaml import YAML_ERRORS, load_yaml
from diffdrive_jacobian.text import PATH_LIMIT, printable

LATEST_VERSION = 9
"""Of metadata.yaml, that rosbags reads."""
ROOT = 'rosbag2_bagfile_information'
INVALID = (ReaderError, YAMLError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""What rosbags and the YAML parser raise on values of unexpected types."""
_COMPRESSIONS = ('', 'none', 'file', 'message', 'storage')
_INT64 = 2**63


class MetadataError(DiffdriveError, ValueError):
    """A value in a bag is invalid; the message says which, what it is, and what is allowed."""


def check_metadata(path: Path) -> None:
    """Check metadata.yaml, whose values rosbags does not check.

    Raises:
        NotARegularFileError: It, or a data file that it lists, is a directory, a pipe, ...
        OSError: It cannot be read.
        MetadataError: It is not YAML, or one of its values is invalid.
    """
    check_regular(path)
    try:
        found = load_yaml(path, aliases=True)
    except YAML_ERRORS as error:
        raise MetadataError(f'metadata.yaml is not valid YAML: {printable(error, 120)}') from error
    with _reported():
        _check_content(found, path.parent)


def _check_content(found: object, folder: Path) -> None:
    root = mapping(ROOT, _required(mapping('its content', found), ROOT))
    integer('version', _required(root, 'version'), 1, LATEST_VERSION)
    one_of('mcap', 'sqlite3')('storage_identifier', _required(root, 'storage_identifier'))
    paths = sequence('relative_file_paths', _required(root, 'relative_file_paths'))
    names: set[str] = set()
    for index, path in enumerate(paths):
        where = f'relative_file_paths[{index}]'
        if '\0' in nonempty(where, path):
            raise ValueError(f'{where} must be the name of a file, got {short(path, repr)}')
        # rosbags reads, and unpacks, a file as often as it is listed.
        if Path(path).name in names:
            raise ValueError(
                f'{where} must be a file that is not listed before, got {short(path, repr)}'
            )
        names.add(Path(path).name)
        # rosbags reports a file that is missing.
        with suppress(FileNotFoundError):
            check_regular(folder / Path(path).name)
    count = integer('message_count', _required(root, 'message_count'), 0, _INT64 - 1)
    for key, name in (('duration', 'nanoseconds'), ('starting_time', 'nanoseconds_since_epoch')):
        value = _required(mapping(key, _required(root, key)), name, key)
        # Writers differ for a bag without messages.
        integer(f'{key}.{name}', value, 0 if count else -_INT64, _INT64 - 1)
    topics = sequence('topics_with_message_count', _required(root, 'topics_with_message_count'))
    for index, topic in enumerate(topics):
        where = f'topics_with_message_count[{index}]'
        _check_topic(mapping(where, topic), where)
    if 'compression_mode' in root:
        mode = text('compression_mode', root['compression_mode'])
        one_of(*_COMPRESSIONS)('compression_mode', mode.lower())
    for key in ('compression_format', 'ros_distro'):
        optional(text)(key, root.get(key))
    for index, file in enumerate(sequence('files', root.get('files', []))):
        mapping(f'files[{index}]', file)
    check_custom_data(root.get('custom_data'))


@contextmanager
def _reported() -> Iterator[None]:
    """Raise a MetadataError where a check fails."""
    try:
        yield
    except MetadataError:
        raise
    except ValueError as error:
        raise MetadataError(f'metadata.yaml: {error}') from error


def _check_topic(topic: dict[str, Any], where: str) -> None:
    integer(f'{where}.message_count', _required(topic, 'message_count', where), 0, _INT64 - 1)
    described = _required(topic, 'topic_metadata', where)
    where += '.topic_metadata'
    mapping(where, described)
    for key in ('name', 'type', 'serialization_format'):
        nonempty(f'{where}.{key}', _required(described, key, where))
    one_of('cdr')(f'{where}.serialization_format', described['serialization_format'])
    text(f'{where}.type_description_hash', described.get('type_description_hash', ''))
    profiles = described.get('offered_qos_profiles', [])
    try:
        parse_qos(profiles)
    except (*INVALID, RecursionError) as error:
        raise ValueError(
            f'{where}.offered_qos_profiles must be a list of QoS profiles, got {short(profiles, repr)}'
        ) from error


def check_custom_data(custom: object) -> dict[str, str]:
    """Return custom data, {} for None.

    Raises:
        MetadataError: It is not a map of texts.
    """
    with _reported():
        entries: dict[str, str] = mapping('custom_data', {} if custom is None else custom)
        for entry in (*entries.keys(), *entries.values()):
            text('each key and value of custom_data', entry)
    return entries


def parse_parameters(key: str, content: str) -> dict[str, Any]:
    """Return the parameters of a node from the key and the value of an entry of the custom data.

    Raises:
        MetadataError: It is not a JSON object.
    """
    try:
        values = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise MetadataError(f'the {printable(key)} are not JSON: {printable(error)}') from error
    if not isinstance(values, dict):
        raise MetadataError(
            f'the {printable(key)} must be a JSON object, got {printable(repr(content), 40)}'
        )
    return values


def check_connections(described: Iterable[Connection], stored: Iterable[Connection]) -> None:
    """Check the topics of an open bag, as metadata.yaml describes them and as its data files do.

    rosbags reads a message only if both are the same, and skips all others silently.

    Raises:
        MetadataError: A topic's name or type is not text, or a topic with messages is not described.
    """
    described, stored = list(described), list(stored)
    for connection in [*described, *stored]:
        for what, value in (('name', connection.topic), ('type', connection.msgtype)):
            try:
                nonempty(f'the {what} of a topic', value)
            except ValueError as error:
                raise MetadataError(str(error)) from error
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


def _required(found: dict[str, Any], key: str, where: str = '') -> Any:
    if key not in found:
        raise MetadataError(f'metadata.yaml lacks {f"{where}.{key}" if where else key}')
    return found[key]


class BagError(DiffdriveError):
    """A bag cannot be read, or lacks what is needed; the message says which and what."""

    def __init__(self, message: str) -> None:
        """Escape control characters in the message: names in it may come from the bag."""
        super().__init__(printable(message, PATH_LIMIT))


class ReadingInterruptedError(DiffdriveError):
    """The user does not want the result any more."""


class DamagedBagError(BagError):
    """A bag is damaged; the message also names the command that saves what can be read."""

    def __init__(self, path: Path, why: str) -> None:
        """Set the message from the bag and what is wrong with it."""
        super().__init__(f'{printable(path, PATH_LIMIT)} is damaged: {why}{_advice(path)}')
        self.why = why


def _advice(path: Path) -> str:
    """Return the command that saves the messages of a damaged bag, or '' if it has none."""
    return f' ({_command(path)} saves what can be read)' if is_recoverable(path) else ''


def _command(path: Path) -> str:
    return f'`recover_run {printable(shlex.quote(str(path)), PATH_LIMIT)}`'


@contextmanager
def open_bag(path: Path) -> Iterator[Reader]:
    """Open a bag; `messages` reads it.

    Raises:
        BagError: There is none, or it is damaged.
    """
    name = printable(path, PATH_LIMIT)
    if not path.exists():
        if (journal := journal_of(path)).is_file():
            raise BagError(
                f'there is no bag {name}, but the journal of an interrupted recording: '
                f'{_command(journal)} makes the bag of it'
            )
        raise BagError(f'there is no bag {name}')
    if not path.is_dir() and not path.is_file():
        raise BagError(f'{name} is not a bag: it is not a regular file')
    if path.is_file() and not is_recoverable(path):
        raise BagError(f'{name} is not a bag: it is neither MCAP nor SQLite')
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        what = 'an empty folder' if not any(path.iterdir()) else 'a folder without metadata.yaml'
        raise BagError(f'{name} is {what}, not a bag{_advice(path)}')
    try:
        if path.is_dir():
            check_metadata(path / 'metadata.yaml')
        reader = CorrectedReader(path)
        reader.open()
    except (MetadataError, NotARegularFileError) as error:
        raise DamagedBagError(path, str(error)) from error
    except Exception as error:  # whatever the parsers of a damaged file raise
        raise DamagedBagError(path, f'it cannot be read: {printable(repr(error), 200)}') from error
    try:
        try:
            custom_data(reader)
            check_connections(reader.connections, stored_connections(reader))
        except MetadataError as error:
            raise DamagedBagError(path, str(error)) from error
        yield reader
    finally:
        reader.close()


def stored_connections(reader: Reader) -> list[Connection]:
    """Return the topics of an open bag as its data files describe them."""
    storages = getattr(reader.storage, 'storages', [reader.storage])
    return [connection for storage in storages for connection in storage.connections]


def custom_data(reader: Reader) -> dict[str, str]:
    """Return the custom data of an open bag."""
    return check_custom_data(reader.storage.metadata.custom)


def lost_messages(custom: Mapping[str, str]) -> dict[str, int]:
    """Return how many messages of each topic a recorder noted as lost in the custom data."""
    noted = _noted(custom, LOST).items()
    return {topic: count for topic, count in noted if isinstance(count, int) and count > 0}


def noted_losses(custom: Mapping[str, str]) -> Iterator[str]:
    """Describe what was lost according to the notes of a recorder in the custom data."""
    for topic, why in sorted(_noted(custom, LEFT_OUT).items()):
        yield f'{printable(topic)} was not recorded: {printable(why)}'
    for topic, count in sorted(_noted(custom, LOST).items()):
        if count:
            yield f'{printable(count)} messages on {printable(topic)} while it was recorded'


def _noted(custom: Mapping[str, str], key: str) -> dict[str, Any]:
    try:
        noted = json.loads(custom.get(key, '{}'))
    except (ValueError, RecursionError):
        noted = None
    return noted if isinstance(noted, dict) else {'an unknown topic': custom[key]}


def recorded_parameters(reader: Reader) -> dict[str, dict[str, Any]]:
    """Return the parameters of the nodes at the beginning of a recording, by full name of the node.

    Raises:
        BagError: They are damaged.
    """
    try:
        return {
            key.removeprefix(PARAMETERS): parse_parameters(key, text)
            for key, text in custom_data(reader).items()
            if key.startswith(PARAMETERS)
        }
    except MetadataError as error:
        raise DamagedBagError(Path(str(reader.path)), str(error)) from error


def messages(
    reader: Reader, connections: Sequence[Connection], invalid: Counter[str] | None = None
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield the messages of some topics in the order of their recording.

    Args:
        reader: An open bag.
        connections: Some of its topics.
        invalid: Counts, by topic, the messages that have an invalid time or are not bytes, which is
            possible in SQLite. They are left out.

    Yields:
        Topic, time of recording (ns) and CDR of each message.

    Raises:
        BagError: The bag is damaged.
    """
    if not connections:
        # rosbags takes an empty list for all topics.
        return
    try:
        for connection, received, data in reader.messages(connections):
            if (
                isinstance(data, (bytes, memoryview))
                and isinstance(received, int)
                and 0 <= received < 2**63
            ):
                yield connection, received, bytes(data)
            elif invalid is not None:
                invalid[connection.topic] += 1
    except Exception as error:  # as in open_bag
        raise DamagedBagError(Path(str(reader.path)), printable(repr(error), 200)) from error


def find_damage(path: Path) -> str:
    """Read a bag completely and return what is wrong with it, or '' if nothing is or it is not a bag.

    Messages that cannot be decoded are not damage: readers skip them.
    """
    try:
        with open_bag(path) as reader:
            recorded_parameters(reader)
            invalid: Counter[str] = Counter()
            found = sum(1 for _ in messages(reader, reader.connections, invalid)) + invalid.total()
            if found != reader.message_count:
                return f'it should have {reader.message_count} messages, {found} can be read'
    except BagError as error:
        return error.why if isinstance(error, DamagedBagError) else ''
    return ''
