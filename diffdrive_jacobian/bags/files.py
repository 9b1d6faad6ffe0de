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

"""Files of a bag: which there are, and what they are by their first bytes.

A bag is written in a hidden directory beside it, until it is complete and gets its name.
"""

from __future__ import annotations

import glob
import re
import shutil
import stat
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.locks import locked_directory

REPLACED = 'replaced'
"""Name of the bag that is replaced, while the new one takes its place."""
JOURNAL = '.journal.mcap'
"""Ends the name of a journal, after the name of the bag."""
MCAP_MAGIC = b'\x89MCAP0\r\n'
"""At the beginning and at the end of an MCAP file (mcap.dev/spec)."""
SQLITE_MAGIC = b'SQLite format 3\0'
ZSTD = '.zstd'
_BLOCK = 1 << 20
_KINDS = {'.mcap': 'mcap', '.db3': 'sqlite3'}
_MAGICS = {MCAP_MAGIC: 'mcap', SQLITE_MAGIC: 'sqlite3'}


def scratch_prefix(target: Path) -> str:
    """Return the beginning of the name of the directory in which a bag is written."""
    return f'.{target.name[:40]}.building-'


@contextmanager
def scratch_directory(target: Path) -> Iterator[Path]:
    """Create a directory beside a bag, and remove it at the end with all that is still in it.

    What a process that was killed has left of the same bag is removed first.

    Raises:
        OSError: It cannot be created.
    """
    _remove_remains(target)
    scratch = Path(tempfile.mkdtemp(prefix=scratch_prefix(target), dir=target.parent))
    with locked_directory(scratch, wait=True):
        try:
            yield scratch
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


def _remove_remains(target: Path) -> None:
    """Remove the directories of processes that do not run any more.

    Those that contain the bag that was being replaced are kept.
    """
    for path in target.parent.glob(f'{glob.escape(scratch_prefix(target))}*'):
        # Without the bag it may be about to be locked.
        if path.is_symlink() or not (path / target.name).is_dir() or (path / REPLACED).exists():
            continue
        with locked_directory(path) as ended:
            if ended:
                shutil.rmtree(path, ignore_errors=True)


class NotARegularFileError(DiffdriveError, OSError):
    """A path exists but is not a regular file."""


class NotABagError(DiffdriveError):
    """A path holds nothing of a bag."""


def journal_of(bag: Path) -> Path:
    """Return the path of a bag's journal, which exists while it is recorded and after a crash."""
    return bag.with_name(bag.name + JOURNAL)


def is_journal(path: Path) -> bool:
    """Return whether a file is a journal by its name, which begins with that of the bag."""
    return path.name.endswith(JOURNAL) and path.name != JOURNAL


def check_regular(path: Path) -> None:
    """Check that reading a file cannot block for ever, as reading a named pipe or a device can.

    Raises:
        NotARegularFileError: It is a directory, a named pipe, a device or a socket.
        OSError: It does not exist.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise NotARegularFileError(f'{path.name} is not a regular file')


def file_kind(path: Path) -> str:
    """Return what a file is by its first bytes, or, as these may be damaged, by its name.

    Returns:
        `mcap`, `sqlite3`, or empty for anything else.
    """
    with open(path, 'rb') as file:
        begin = file.read(len(SQLITE_MAGIC))
    for magic, kind in _MAGICS.items():
        if begin.startswith(magic):
            return kind
    name = path.with_suffix('') if path.suffix == ZSTD else path
    return _KINDS.get(name.suffix, '')


def file_checksum(file: BinaryIO, start: int, end: int) -> int:
    """Return the CRC-32 of a part of a file."""
    checksum = 0
    file.seek(min(start, end))
    while start < end and (block := file.read(min(end - start, _BLOCK))):
        checksum = zlib.crc32(block, checksum)
        start += len(block)
    return checksum


def bag_files(path: Path) -> list[Path]:
    """Return the data files of a bag in their order, or the one that is given.

    Args:
        path: A bag's directory, one of its files, or a journal.

    Raises:
        NotABagError: There is no such file.
        OSError: It cannot be read.
    """
    if path.is_file():
        if not file_kind(path):
            raise NotABagError(f'{path} is neither MCAP nor SQLite')
        return [path]
    if not path.is_dir():
        if path.exists():
            raise NotABagError(f'{path} is not a bag: it is not a regular file')
        raise NotABagError(f'there is no bag {path}, and no journal {journal_of(path)}')
    present = set(path.iterdir())
    # A file whose compression was interrupted exists twice.
    twice = {one for one in present if one.suffix == ZSTD and one.with_suffix('') in present}
    files = [one for one in present - twice if one.is_file()]
    # A journal beside is of another recording.
    files = [one for one in files if file_kind(one) and not is_journal(one)]
    if not files:
        what = 'holds neither .mcap nor .db3 files' if present else 'is an empty folder'
        if any(map(is_journal, present)):
            what = f'holds no files of a bag but journals (*{JOURNAL}): recover these one by one'
        raise NotABagError(f'{path} {what}: it is not a bag')
    # Files are numbered, and 10 comes after 9.
    return sorted(
        files, key=lambda one: [int(n) if n.isdigit() else n for n in re.split('([0-9]+)', one.name)]
    )


def is_recoverable(path: Path) -> bool:
    """Return whether a file or a directory may hold messages of a bag."""
    try:
        bag_files(path)
    except (NotABagError, OSError):
        return False
    return True
