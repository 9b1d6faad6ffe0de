"""rosbags' reader and writer for bags at any path.

rosbags opens SQLite files as `file:PATH`, a URI in which `#`, `?` and `%` have a meaning: it writes and
reads another file than the one of that name.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader, McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader, Sqlite3Writer

if TYPE_CHECKING:
    from rosbags.rosbag2.reader import ReaderProtocol
    from rosbags.rosbag2.writer import StorageWriter


class PlainSqlite3Writer(Sqlite3Writer):
    """Opens its file by the path, not by a URI."""

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
        self.conn.executescript(self.SQLITE_SCHEMA)
        self.cursor = self.conn.cursor()


class PlainSqlite3Reader(Sqlite3Reader):
    """Opens its file by a URI in which the path is quoted."""

    def __init__(self, path: Path) -> None:
        """Set up a reader of a file."""
        super().__init__(Path(quote(str(path.absolute()))))


class BagWriter(Writer):
    """Writes a bag to any path."""

    STORAGE_PLUGINS: Mapping[StoragePlugin, type[StorageWriter]] = {
        StoragePlugin.MCAP: McapWriter,
        StoragePlugin.SQLITE3: PlainSqlite3Writer,
    }


class BagReader(DirectoryReader):
    """Reads a bag's directory at any path."""

    STORAGE_PLUGINS: Mapping[str, type[ReaderProtocol]] = {
        'mcap': McapReader,
        'sqlite3': PlainSqlite3Reader,
    }
