"""Files that a tool writes: completely or not at all, and never in the place of an existing one."""

from __future__ import annotations

import os
import secrets
from contextlib import suppress
from pathlib import Path

FORMATS = ('png', 'svg', 'pdf')
"""File name extensions of figures."""


def create(path: Path, data: bytes) -> None:
    """Write a new file, which appears only when it is complete.

    Raises:
        FileExistsError: It exists, and is not changed.
        OSError: It cannot be written.
    """
    if os.path.lexists(path):
        raise FileExistsError(f'{path} exists already')
    scratch = path.with_name(f'.{path.name[:100]}.{secrets.token_hex(4)}')
    try:
        _write(scratch, data)
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
