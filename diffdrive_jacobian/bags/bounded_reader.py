"""rosbags' reader for bags of unknown origin: memory and time stay in proportion to the bag's size.

rosbags decompresses to any size that a file claims, and evaluates views and generated columns of SQLite.
What is here checks before it does so. The limits are per message, per chunk and relative to the size of
a file: a bag may have any size, but a small file must not unpack to a huge one.
"""

from __future__ import annotations

import heapq
import io
import sys
from collections.abc import Collection, Generator, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache, partial
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

import apsw
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import Reader, ReaderError, storage_mcap, storage_sqlite3
from rosbags.rosbag2 import reader as rosbags_reader
from rosbags.rosbag2.metadata import parse_qos
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from ruamel.yaml.error import YAMLError

from diffdrive_jacobian.bags import mcap
from diffdrive_jacobian.bounded_yaml import TooLargeError, check_yaml, load_yaml
from diffdrive_jacobian.text import format_size

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_RECORD = 1 << 27
"""Size of the largest message, chunk or other record that is read (bytes, unpacked)."""
MAX_MESSAGE = MAX_RECORD - (1 << 24)
"""Size of the largest message that is written (bytes). What is before it in its chunk has the rest."""
MAX_OVERLAP = 1 << 29
"""Unpacked size of all chunks that are open at the same time (bytes)."""
FREE = 1 << 28
"""Unpacked size that is allowed for any file (bytes)."""
MAX_RATIO = 1000
"""Largest ratio of unpacked to packed size of a larger file."""
UNPACK_ERRORS = (ValueError, RuntimeError, EOFError, zstd.ZstdError)
"""What unpacking raises on damaged or too large data."""
_BLOCK = 1 << 20
_MAX_FRAMES = 1000
Messages = Generator[tuple[Connection, int, bytes], None, None]
MAX_KNOWN = 10_000
"""Length of texts with profiles whose values are stored (characters)."""


def check_record(size: int, what: str) -> None:
    """Raise TooLargeError if a message, chunk or other record is larger than `MAX_RECORD`."""
    if size > MAX_RECORD:
        raise TooLargeError(
            f'{what} unpacks to {format_size(size)}; at most {format_size(MAX_RECORD)} are read'
        )


class Budget:
    """Total size that one file, or the files of one bag, may unpack to, in proportion to their size."""

    def __init__(self, packed: int, ratio: int = MAX_RATIO) -> None:
        """Allow a multiple of the size of the file or files (bytes), and at least `FREE`."""
        self.limit = max(FREE, ratio * packed)
        self._used = 0

    def spend(self, size: int) -> None:
        """Count unpacked bytes, or raise TooLargeError if they are more than the limit."""
        self._used += size
        if self._used > self.limit:
            raise TooLargeError(
                f'it unpacks to more than {format_size(self.limit)}, the most that is read of a file '
                'of its size'
            )


def unpack(compression: str, data: bytes, size: int) -> bytes:
    """Decompress a chunk of MCAP by `lz4`, `zstd` or none (''), or as much of it as there is.

    At most one byte more than `size`, which the chunk declares, is returned.

    Raises:
        TooLargeError: The declared size is larger than `MAX_RECORD`.
        ValueError: The compression is unknown.
        RuntimeError, EOFError, zstd.ZstdError: The data is damaged.
    """
    check_record(size, 'a chunk')
    if compression == 'zstd':
        return _unpack_zstd(data, size + 1)
    if compression == 'lz4':
        return bytes(LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    if compression:
        raise ValueError(f'unknown compression {compression!r}')
    return data


def unpack_message(data: bytes) -> bytes:
    """Decompress a message that was compressed by itself, or raise one of `UNPACK_ERRORS`."""
    declared = zstd.get_frame_info(data).decompressed_size
    if declared is not None:
        check_record(declared, 'a message')
    unpacked = _unpack_zstd(data, MAX_RECORD + 1, whole=True)
    if len(unpacked) > MAX_RECORD:
        raise TooLargeError(f'a message unpacks to more than {format_size(MAX_RECORD)}')
    return unpacked


def _unpack_zstd(data: bytes, limit: int, *, whole: bool = False) -> bytes:
    parts: list[bytes] = []
    for _ in range(_MAX_FRAMES):
        decompressor = zstd.ZstdDecompressor()
        parts.append(decompressor.decompress(data, max_length=limit))
        limit -= len(parts[-1])
        if limit <= 0 or not decompressor.eof:
            break
        data = decompressor.unused_data
        if not data:
            return b''.join(parts)
    else:
        raise zstd.ZstdError(f'more than {_MAX_FRAMES} frames')
    if whole and limit > 0:
        raise EOFError('its compressed data is cut off')
    return b''.join(parts)


def unpack_file(path: Path, out: BinaryIO | None, budget: Budget | None = None) -> None:
    """Decompress a Zstandard file, or as much of it as there is; without `out` only check its size.

    Raises:
        TooLargeError: It unpacks to more than a file of its size may.
        OSError: It cannot be read, or `out` not be written.
        EOFError, zstd.ZstdError: It is damaged. What precedes the damage has been written.
    """
    budget = Budget(path.stat().st_size) if budget is None else budget
    with open(path, 'rb') as file:
        try:
            declared = zstd.get_frame_info(file.read(18)).decompressed_size
        except zstd.ZstdError:
            declared = None
        if declared is not None and declared > budget.limit:
            raise TooLargeError(
                f'{path.name} unpacks to {format_size(declared)}; at most {format_size(budget.limit)} '
                'are read of a file of its size'
            )
        file.seek(0)
        with zstd.open(file, 'rb') as packed:
            while block := packed.read(_BLOCK):
                try:
                    budget.spend(len(block))
                except TooLargeError as error:
                    raise TooLargeError(f'{path.name}: {error}') from None
                if out is not None:
                    out.write(block)


# --- Functions of rosbags' modules


def parse_bounded_qos(profiles: Any) -> list[Qos]:
    """Parse offered profiles as `rosbags.rosbag2.metadata.parse_qos`, or raise TooLargeError."""
    if not isinstance(profiles, str):
        return parse_qos(profiles)
    parse = _parse_known_text if len(profiles) < MAX_KNOWN else _parse_text
    return list(parse(profiles))


def _parse_text(profiles: str) -> tuple[Qos, ...]:
    with suppress(YAMLError):
        # rosbags reports invalid YAML itself.
        check_yaml(profiles)
    return tuple(parse_qos(profiles))


# Most topics of a bag have the same profiles, and rosbags parses each several times.
_parse_known_text = lru_cache(maxsize=64)(_parse_text)


# These are the only places in which rosbags decompresses chunks and parses profiles.
storage_mcap.DECOMPRESSORS.update({kind: partial(unpack, kind) for kind in ('lz4', 'zstd')})
for _module in (rosbags_reader, storage_mcap, storage_sqlite3):
    vars(_module)['parse_qos'] = parse_bounded_qos

# --- MCAP


class _BoundedFile(io.BufferedReader):
    """A file that refuses to read records of any size."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None:
            check_record(size, 'a record')
        return super().read(size)


class _McapReader(McapReader):
    """Checks how much the chunks claim to unpack to before any is unpacked."""

    def _open(self) -> None:
        assert self.bio is not None
        size = self.bio.seek(0, io.SEEK_END)
        self.bio.seek(0)
        self.bio = _BoundedFile(self.bio.detach())  # type: ignore[attr-defined]
        self._budget = Budget(size)
        super()._open()
        for chunk in self.chunks:
            if not chunk.message_index_offsets:
                # The index of a chunk's messages is optional. rosbags skips chunks without.
                chunk.channel_count.update(dict.fromkeys(self.channels, 1))

    def read_index(self) -> None:
        self._check_summary()
        super().read_index()
        if self.statistics is None and not all(one.message_index_offsets for one in self.chunks):
            # rosbags counts messages by these indexes, or scans a file without chunks.
            self.chunks.clear()
        for chunk in self.chunks:
            check_record(chunk.uncompressed_size, 'a chunk')
            check_record(chunk.compressed_size, 'a chunk')
            self._budget.spend(chunk.uncompressed_size)
        # `messages` holds all chunks unpacked whose times overlap, but one after the other of those that
        # only have the same time.
        changes = []
        for chunk in self.chunks:
            place, size = chunk.chunk_start_offset, chunk.uncompressed_size
            changes.append((chunk.message_start_time, place, 0, size))
            changes.append((chunk.message_end_time, place, 1, -size))
        unpacked = 0
        for *_, change in sorted(changes):
            unpacked += change
            if unpacked > MAX_OVERLAP:
                raise TooLargeError(
                    'its chunks overlap in time and unpack to more than '
                    f'{format_size(MAX_OVERLAP)} at once'
                )

    def _check_summary(self) -> None:
        """Raise ReaderError if the summary, which names the topics, has a checksum and is altered."""
        assert self.bio is not None
        footer = self.bio.seek(-mcap.FOOTER_END.size, io.SEEK_END)
        summary, _, checksum, _ = mcap.FOOTER_END.unpack(self.bio.read())
        if checksum and mcap.file_checksum(self.bio, summary, footer + 16) != checksum:
            raise ReaderError('the checksum of its summary is wrong')

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Messages:
        if not self.chunks:
            yield from super().messages(connections, start, stop)
            return
        channels = {connection.id: connection for connection in connections}
        sources = [
            self._chunk_messages(chunk, channels, start, stop)
            for chunk in self.chunks
            if (start is None or start <= chunk.message_end_time)
            and (stop is None or chunk.message_start_time < stop)
            and any(chunk.channel_count.get(channel, 0) for channel in channels)
        ]
        for stamp, _, connection, data in heapq.merge(*sources, key=itemgetter(0, 1)):
            if connection is not None:
                yield connection, stamp, data

    def _chunk_messages(
        self, chunk: Any, channels: dict[int, Connection], start: int | None, stop: int | None
    ) -> Iterator[tuple[int, int, Connection | None, Any]]:
        """Yield a marker, then the messages of a chunk: time, place of the chunk, topic, data.

        The markers of rosbags precede all messages of the same time, so that it unpacks all chunks with
        that time at once.
        """
        assert self.bio is not None
        first, last = chunk.message_start_time, chunk.message_end_time
        source = storage_mcap.msgsrc(
            chunk,
            channels,
            first if start is None else start,
            last + 1 if stop is None else stop,
            self.bio,
        )
        next(source)
        yield first, chunk.chunk_start_offset, None, None
        yield from source

    def meta_scan(self) -> None:
        assert self.bio is not None
        # Of a file without an index: add up the sizes that its chunks claim.
        at = self.data_end if self.chunks else self.data_start
        while at < self.data_end:
            self.bio.seek(at)
            # Times and size of a chunk take 24 bytes.
            head = self.bio.read(mcap.HEAD.size + 24)
            if len(head) < mcap.HEAD.size:
                break
            opcode, length = mcap.HEAD.unpack_from(head)
            if opcode == mcap.CHUNK:
                size = int.from_bytes(head[mcap.HEAD.size + 16 :], 'little')
                check_record(size, 'a chunk')
                self._budget.spend(size)
            at += mcap.HEAD.size + length
        super().meta_scan()


# --- SQLite

_TABLES = ('messages', 'topics', 'schema', 'metadata', 'message_definitions')
_STEPS = 100_000
"""Number of instructions after which SQLite calls the progress handler."""
_FREE_STEPS, _STEPS_PER_BYTE = 50_000_000, 100
"""Number of instructions that queries of a database may take: at least, and per byte of its file."""


class _SqliteReader(Sqlite3Reader):
    """Reads plain tables only, and values of moderate size."""

    def __init__(self, path: Path) -> None:
        # rosbags opens the URI `file:PATH`, in which `#`, `?` and `%` have a meaning.
        super().__init__(Path(quote(str(path.absolute()))))
        self.file = path

    def open(self) -> None:
        # The hook is called for every connection of the process, but this thread opens only rosbags'.
        apsw.connection_hooks.append(self._limit)
        try:
            super().open()
        except ReaderError as error:
            raise ReaderError(str(error).replace(str(self.path), str(self.file))) from error
        finally:
            apsw.connection_hooks.remove(self._limit)

    def _limit(self, connection: apsw.Connection) -> None:
        connection.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_RECORD)
        left = (_FREE_STEPS + _STEPS_PER_BYTE * self.file.stat().st_size) // _STEPS

        def count() -> bool:
            nonlocal left
            left -= 1
            if left < 0:
                raise TooLargeError('its queries take more steps than a file of its size may')
            return False

        connection.set_progress_handler(count, _STEPS)
        for _, name, kind, *_ in connection.execute('PRAGMA main.table_list').fetchall():
            if str(name).lower() not in _TABLES:
                continue
            columns = connection.execute(f'PRAGMA main.table_xinfo({name})').fetchall()
            hidden = [column[1] for column in columns if column[6]]
            if kind != 'table' or hidden:
                what = f'has the computed column {hidden[0]!r}' if hidden else f'is a {kind}'
                raise ReaderError(f'{name} must be a plain table, but {what}')


# --- Directories


class _DirectoryReader(DirectoryReader):
    """Checks metadata and compressed files before they are loaded."""

    STORAGE_PLUGINS: Mapping[str, Any] = {'mcap': _McapReader, 'sqlite3': _SqliteReader}

    def open(self) -> None:
        folder = Path(str(self.path))
        metadata = load_yaml(folder / 'metadata.yaml')
        files = _compressed_files(folder, metadata)
        budget = Budget(sum(file.stat().st_size for file in files))
        for file in files:
            unpack_file(file, None, budget)
        super().open()
        # rosbags itself would unpack messages to any size.
        self._packed = self.metadata.compression_mode == 'message'
        self.metadata = self.metadata._replace(compression_mode=None)
        self._budget = Budget(sum(file.stat().st_size for file in folder.iterdir()))

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Messages:
        for connection, stamp, data in super().messages(connections, start, stop):
            if self._packed:
                data = unpack_message(data)
                self._budget.spend(len(data))
            yield connection, stamp, data


def _compressed_files(folder: Path, metadata: Any) -> list[Path]:
    """Return the files of a bag that are compressed as a whole."""
    # rosbags reports what is missing or of another type.
    with suppress(KeyError, TypeError, AttributeError):
        information = metadata['rosbag2_bagfile_information']
        if information['compression_mode'].lower() == 'file':
            files = [folder / Path(name).name for name in information['relative_file_paths']]
            return [file for file in files if file.is_file()]
    return []


class BoundedReader(Reader):
    """rosbags' reader of directories, MCAP and SQLite files, for bags of unknown origin.

    `open` and `messages` also raise TooLargeError, and errors of YAML, Zstandard and SQLite.
    """

    STORAGE_PLUGINS: Mapping[str, Any] = {
        'dir': _DirectoryReader,
        '.mcap': _McapReader,
        '.db3': _SqliteReader,
    }
