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

"""Locks of files. They end with the process that holds them, also if it is killed.

Windows has none, nor have some file systems: there nothing is locked, and nothing is found locked.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

fcntl: Any
try:
    import fcntl
except ImportError:
    fcntl = None


def lock(file: BinaryIO | int, *, shared: bool = False, wait: bool = False) -> bool | None:
    """Lock an open file.

    Args:
        file: The file, or its descriptor.
        shared: Whether others may lock it, too, likewise.
        wait: Whether to wait for others.

    Returns:
        Whether it is locked now. False: another process holds it. None: there are no locks.
    """
    if fcntl is None:
        return None
    how = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(file, how if wait else how | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


@contextmanager
def locked_directory(path: Path, *, wait: bool = False) -> Iterator[bool | None]:
    """Lock a directory, and release it at the end. Yields what `lock` returns."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        # It belongs to another user, or is gone, or this is Windows.
        yield None
        return
    try:
        yield lock(descriptor, wait=wait)
    finally:
        os.close(descriptor)
