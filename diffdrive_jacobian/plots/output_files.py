"""Files that a tool writes: whole or not at all, and never over an existing one."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Sequence
from datetime import datetime
from itertools import count
from pathlib import Path

FORMATS = ('png', 'svg', 'pdf')
"""File name extensions of pictures."""


def create(path: Path, data: bytes) -> None:
    """Write a new file, whole or not at all.

    Raises:
        FileExistsError: It exists; it stays as it is.
        OSError: It cannot be written.
    """
    with open(path, 'xb') as file:
        try:
            file.write(data)
            file.flush()
        except BaseException:
            path.unlink()
            raise


def names_by_time(prefix: str) -> Iterator[str]:
    """Yield names for new files: `PREFIX_DATE-TIME`, `PREFIX_DATE-TIME__2`, and so on."""
    stem = f'{prefix}_{datetime.now():%Y_%m_%d-%H_%M_%S}'
    yield stem
    for number in count(2):
        yield f'{stem}__{number}'


def free_stem(prefix: str, formats: Sequence[str]) -> str:
    """Return the first of `names_by_time` of which no file with one of the extensions exists."""
    return next(
        stem
        for stem in names_by_time(prefix)
        if not any(os.path.lexists(f'{stem}.{ending}') for ending in formats)
    )


def extension(path: Path) -> str:
    """Return the extension of a file name in lower case, without the dot."""
    return path.suffix.lower().removeprefix('.')


def new_file(name: str, formats: Sequence[str], what: str) -> Path:
    """Check, before a long calculation, that a new file can be written, and return its path.

    Args:
        name: Name of the file.
        formats: Allowed file name extensions.
        what: What the file contains, for the error message.

    Raises:
        ValueError: The file name has another extension.
        FileExistsError: The file exists.
        OSError: It cannot be written. `filename` is the path.
    """
    path = Path(name)
    if extension(path) not in formats:
        raise ValueError(f'the {what} must end in .{", .".join(formats)}, got {name!r}')
    try:
        exists = _is_entry(path)
        if not exists and not path.parent.is_dir():
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
        if not exists and not os.access(path.parent, os.W_OK | os.X_OK):
            raise OSError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        error.filename = str(path)
        raise
    if exists:
        raise FileExistsError(f'{path} exists already; it is not overwritten')
    return path


def _is_entry(path: Path) -> bool:
    """Return whether there is a file or a link, also one that points to nothing.

    Raises:
        OSError: That cannot be determined: a name is too long, or a parent is no directory.
    """
    try:
        path.lstat()
    except FileNotFoundError:
        return False
    return True
