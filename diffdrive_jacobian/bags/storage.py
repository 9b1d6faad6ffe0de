"""rosbags' reader and writer for bags at any path.

rosbags opens SQLite files as `file:PATH`, a URI in which `#`, `?` and `%` have a meaning, so that it
would write and read a file of another name.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from rosbags.rosbag2 import CompressionMode, ReaderError, StoragePlugin, Writer
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader, McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader, Sqlite3Writer

if TYPE_CHECKING:
    from rosbags.rosbag2.reader import ReaderProtocol
    from rosbags.rosbag2.writer import StorageWriter

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}


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
        StoragePlugin.MCAP: McapWriter,
        StoragePlugin.SQLITE3: PathSqlite3Writer,
    }


class BagReader(DirectoryReader):
    """Reads a bag's directory at any path."""

    STORAGE_PLUGINS: Mapping[str, type[ReaderProtocol]] = {
        'mcap': McapReader,
        'sqlite3': PathSqlite3Reader,
    }
