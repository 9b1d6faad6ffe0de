"""The hidden directory in which a bag is written, until it is complete and gets its name."""

from __future__ import annotations

import fcntl
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

REPLACED = 'replaced'
"""Name of the bag that is replaced, while the new one takes its place."""


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
    descriptor = os.open(scratch, os.O_RDONLY)
    try:
        # The lock ends with the process, also if that is killed. Some file systems have no locks.
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        os.close(descriptor)


def _remove_remains(target: Path) -> None:
    """Remove the directories of processes that do not run any more.

    Those that contain the bag that was being replaced are kept.
    """
    for path in target.parent.glob(f'{glob.escape(scratch_prefix(target))}*'):
        # Without the bag it may be about to be locked.
        if path.is_symlink() or not (path / target.name).is_dir() or (path / REPLACED).exists():
            continue
        # It may belong to another user, or its process may just remove it.
        with suppress(OSError):
            descriptor = os.open(path, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(descriptor)
