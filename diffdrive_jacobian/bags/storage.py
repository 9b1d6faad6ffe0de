"""rosbags' writer for bags at any path, with checksums in MCAP files, and its reader of SQLite files.

rosbags opens SQLite files as `file:PATH`, a URI in which `#`, `?` and `%` have a meaning, so that it
would write and read a file of another name. In MCAP files it leaves all checksums at 0, which stands for
unknown.
"""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO
from urllib.parse import quote

from rosbags.rosbag2 import CompressionMode, ReaderError, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader, Sqlite3Writer

if TYPE_CHECKING:
    from rosbags.rosbag2.writer import StorageWriter

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
_CHUNK_CHECKSUM = 9 + 3 * 8
"""Place of the checksum in the record of a chunk, after opcode, length, times and size."""
FOOTER_END = struct.Struct('<QQI8s')
"""Start of the summary and of its offsets, checksum of the summary, and the magic."""
_DATA_END = 9 + 4
"""Size of the record that ends the data section and has its checksum."""
_BLOCK = 1 << 20


class CheckedMcapWriter(McapWriter):
    """rosbags' writer, with checksums of chunks, data section and summary (mcap.dev/spec)."""

    def close_chunk(self) -> None:
        """Write the pending chunk."""
        place = self.bio.tell() + _CHUNK_CHECKSUM
        checksum = zlib.crc32(self.chunk.bio.getbuffer())
        super().close_chunk()
        end = self.bio.tell()
        self.bio.seek(place)
        self.bio.write(struct.pack('<I', checksum))
        self.bio.seek(end)

    def close(self, version: int, metadata: str) -> None:
        """Write the last chunk, the metadata and the summary, and close the file."""
        super().close(version, metadata)
        with open(self.path, 'r+b') as file:
            footer = file.seek(-FOOTER_END.size, 2)
            summary, *_ = FOOTER_END.unpack(file.read())
            self._write_checksum(file, 0, summary - _DATA_END, summary - 4)
            self._write_checksum(file, summary, footer + 16, footer + 16)

    @staticmethod
    def _write_checksum(file: BinaryIO, start: int, end: int, place: int) -> None:
        checksum = file_checksum(file, start, end)
        file.seek(place)
        file.write(struct.pack('<I', checksum))


def file_checksum(file: BinaryIO, start: int, end: int) -> int:
    """Return the CRC-32 of a part of a file."""
    checksum = 0
    file.seek(min(start, end))
    while start < end and (block := file.read(min(end - start, _BLOCK))):
        checksum = zlib.crc32(block, checksum)
        start += len(block)
    return checksum


class PathSqlite3Writer(Sqlite3Writer):
    """rosbags' writer, which opens its file by the path and not by a URI."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        """Create the file, named after the directory.

        Args:
            path: The bag's directory.
            compression: Not supported by SQLite files.
        """
        if compression == CompressionMode.STORAGE:
            raise ValueError('SQLite files cannot be compressed as a whole while they are written')
        self.path = path.absolute() / f'{path.name}.db3'
        self.conn = sqlite3.connect(self.path)
        try:
            # A bag gets its name after its files were synced. Until then it need not survive
            # a power cut.
            self.conn.execute('PRAGMA synchronous = OFF')
            self.conn.execute('PRAGMA journal_mode = MEMORY')
            self.conn.executescript(self.SQLITE_SCHEMA)
        except BaseException:
            self.conn.close()  # Nobody else can: there is no writer yet.
            raise
        self.cursor = self.conn.cursor()


class PathSqlite3Reader(Sqlite3Reader):
    """rosbags' reader, which opens its file by a URI in which the path is quoted."""

    def __init__(self, path: Path) -> None:
        """Set the file that `open` opens."""
        super().__init__(Path(quote(str(path.absolute()))))
        self.file = path

    def open(self) -> None:
        """Open the file.

        Raises:
            ReaderError: It cannot be opened; the message has its path as it was given.
        """
        try:
            super().open()
        except ReaderError as error:
            raise ReaderError(str(error).replace(str(self.path), str(self.file))) from error


class BagWriter(Writer):
    """Writes a bag to any path."""

    STORAGE_PLUGINS: Mapping[StoragePlugin, type[StorageWriter]] = {
        StoragePlugin.MCAP: CheckedMcapWriter,
        StoragePlugin.SQLITE3: PathSqlite3Writer,
    }
