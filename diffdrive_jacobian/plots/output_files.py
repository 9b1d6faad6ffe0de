"""Files that a tool writes: whole or not at all, and never over an existing one."""

from __future__ import annotations

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
