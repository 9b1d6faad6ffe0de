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

"""rosbags' reader with four corrections: of chunks that have no index of their messages, that overlap in
time or have an altered summary, and of SQLite files with special characters in their path.
"""

from __future__ import annotations

import heapq
import io
import os
import struct
import sys
from collections.abc import Collection, Generator, Iterator, Mapping
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any
from urllib.parse import quote

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, ReaderError, storage_mcap
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from diffdrive_jacobian.bags.files import MCAP_MAGIC, file_checksum
from diffdrive_jacobian.text import format_size

if sys.version_info >= (3, 14):
    from compression import zstd as zstd
else:
    from backports import zstd as zstd

FOOTER = struct.Struct('<QQI')
"""End of an MCAP file: where the summary and its offsets begin, and the checksum of the summary."""
MAX_CHUNK = 1 << 30
"""Largest size that a chunk may claim to unpack to (bytes)."""
UNPACK_ERRORS = (ValueError, RuntimeError, EOFError, zstd.ZstdError)
"""What unpacking raises on damaged data."""
Messages = Generator[tuple[Connection, int, bytes], None, None]


def unpack(compression: str, data: bytes, size: int) -> bytes:
    """Decompress a chunk of MCAP by `lz4`, `zstd` or none (''), or as much of it as there is.

    At most one byte more than `size`, which the chunk claims, is returned.

    Raises:
        ValueError: The size is larger than `MAX_CHUNK`, or the compression is unknown.
        RuntimeError, EOFError, zstd.ZstdError: The data is damaged.
    """
    if size > MAX_CHUNK:
        raise ValueError(
            f'it claims to unpack to {format_size(size)}; at most {format_size(MAX_CHUNK)} are read'
        )
    if compression == 'zstd':
        return bytes(zstd.ZstdDecompressor().decompress(data, max_length=size + 1))
    if compression == 'lz4':
        return bytes(LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    if compression:
        raise ValueError(f'unknown compression {compression!r}')
    return data


# This is the only place in which rosbags decompresses chunks.
storage_mcap.DECOMPRESSORS.update({kind: partial(unpack, kind) for kind in ('lz4', 'zstd')})


class _File(io.BufferedReader):
    """A file that allocates no more memory for a record than the file has left."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > io.DEFAULT_BUFFER_SIZE:
            size = min(size, max(0, os.fstat(self.fileno()).st_size - self.tell()))
        return super().read(size)


class _McapReader(McapReader):
    """Reads chunks without an index of their messages, and few at once if they overlap in time."""

    def _open(self) -> None:
        assert self.bio is not None
        self.bio = _File(self.bio.detach())  # type: ignore[attr-defined]
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

    def _check_summary(self) -> None:
        """Raise ReaderError if the summary, which names the topics, has a checksum and is altered."""
        assert self.bio is not None
        footer = self.bio.seek(-FOOTER.size - len(MCAP_MAGIC), io.SEEK_END)
        summary, _, checksum = FOOTER.unpack(self.bio.read(FOOTER.size))
        if checksum and file_checksum(self.bio, summary, footer + 16) != checksum:
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


class _SqliteReader(Sqlite3Reader):
    """Reads files of any name."""

    def __init__(self, path: Path) -> None:
        # rosbags opens the URI `file:PATH`, in which `#`, `?` and `%` have a meaning.
        super().__init__(Path(quote(str(path.absolute()))))
        self.file = path

    def open(self) -> None:
        try:
            super().open()
        except ReaderError as error:
            raise ReaderError(str(error).replace(str(self.path), str(self.file))) from error


class _DirectoryReader(DirectoryReader):
    STORAGE_PLUGINS: Mapping[str, Any] = {'mcap': _McapReader, 'sqlite3': _SqliteReader}


class CorrectedReader(Reader):
    """rosbags' reader of directories, MCAP and SQLite files.

    `open` and `messages` also raise errors of YAML, Zstandard and SQLite.
    """

    STORAGE_PLUGINS: Mapping[str, Any] = {
        'dir': _DirectoryReader,
        '.mcap': _McapReader,
        '.db3': _SqliteReader,
    }
