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

"""Files that a tool writes: completely or not at all, and in the place of another one only if asked."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import count
from pathlib import Path

from diffdrive_jacobian.errors import NotDoneError, UserError

FORMATS = ('png', 'svg', 'pdf')
"""File name extensions of figures."""
FILM_FORMATS = ('gif', 'mp4')
"""File name extensions of films."""
NOT_OVERWRITTEN = 'it is not overwritten (--force overwrites files)'


def create(path: Path, data: bytes, *, replace: bool = False) -> None:
    """Write a new file, which appears only when it is complete.

    Raises:
        FileExistsError: It exists, and is not to be replaced.
        OSError: It cannot be written.
    """
    if os.path.lexists(path) and not replace:
        raise FileExistsError(f'{path} exists already')
    scratch = path.with_name(f'.{path.name[:100]}.{secrets.token_hex(4)}')
    try:
        _write(scratch, data)
        if replace:
            os.replace(scratch, path)
            return
        try:
            # Renaming would replace a file that was created meanwhile.
            os.link(scratch, path)
        except FileExistsError:
            raise
        except OSError:
            # Some file systems have no hard links.
            _write(path, data)
    finally:
        scratch.unlink(missing_ok=True)


def _write(path: Path, data: bytes) -> None:
    with open(path, 'xb') as file:
        try:
            file.write(data)
            file.flush()
        except BaseException:
            with suppress(OSError):
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


def new_file(name: str, formats: Sequence[str], what: str, *, replace: bool = False) -> Path:
    """Check, before a long calculation, that a new file can be written, and return its path.

    `formats` are the allowed file name extensions, `what` is the content for the error message.

    Raises:
        UserError: The file name has another extension, or the file exists.
        NotDoneError: It cannot be written.
    """
    path = Path(name)
    if extension(path) not in formats:
        raise UserError(f'the {what} must end in .{", .".join(formats)}, got {name!r}')
    try:
        try:
            # Also of a link to nothing. `lexists` hides other errors: a name that is too long.
            path.lstat()
            exists = True
        except FileNotFoundError:
            exists = False
            check_directory(path.parent)
    except OSError as error:
        raise cannot_write(path, error) from error
    if exists and not (replace and path.is_file()):
        raise UserError(f'{path} exists already; {NOT_OVERWRITTEN}')
    return path


def cannot_write(path: object, error: OSError, result: str = '') -> NotDoneError:
    """Return the error for a path that cannot be written, and what was written instead."""
    return NotDoneError(f'{path} cannot be written: {error.strerror or error}{result}')


def check_directory(path: Path) -> None:
    """Raise OSError if files cannot be created in a directory."""
    if not stat.S_ISDIR(os.stat(path).st_mode):
        raise OSError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
    if not os.access(path, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, os.strerror(errno.EACCES))
