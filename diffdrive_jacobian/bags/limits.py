"""Limits on the memory and time that a bag of unknown origin may take, and decompression within them.

The limits are per message, per chunk and relative to the size of a file. A bag may have any size, but a
small file must not unpack to a huge one.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import BinaryIO

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

from diffdrive_jacobian.bounded_yaml import TooLargeError
from diffdrive_jacobian.text import format_size

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_RECORD = 1 << 27
"""Size of the largest message, chunk or other record that is read (bytes, unpacked)."""
MAX_MESSAGE = MAX_RECORD - (1 << 24)
"""Size of the largest message that is written (bytes). What is before it in its chunk has the rest."""
MAX_OVERLAP = 1 << 29
"""Unpacked size of all chunks that are open at the same time (bytes)."""
FREE = 1 << 28
"""Unpacked size that is allowed for any file (bytes)."""
MAX_RATIO = 1000
"""Largest ratio of unpacked to packed size of a larger file."""
UNPACK_ERRORS = (ValueError, RuntimeError, EOFError, zstd.ZstdError)
"""What unpacking raises on damaged or too large data."""
_BLOCK = 1 << 20
_MAX_FRAMES = 1000


def check_record(size: int, what: str) -> None:
    """Check the size of a message, chunk or other record before it is read or unpacked.

    Raises:
        TooLargeError: It is larger than `MAX_RECORD`.
    """
    if size > MAX_RECORD:
        raise TooLargeError(
            f'{what} unpacks to {format_size(size)}; at most {format_size(MAX_RECORD)} are read'
        )


class Budget:
    """Total size that one file, or the files of one bag, may unpack to, in proportion to their size."""

    def __init__(self, packed: int, ratio: int = MAX_RATIO) -> None:
        """Allow a multiple of the size of the file or files, and at least `FREE`.

        Args:
            packed: Their size (bytes).
            ratio: The multiple.
        """
        self.limit = max(FREE, ratio * packed)
        self._used = 0

    def spend(self, size: int) -> None:
        """Count unpacked bytes.

        Raises:
            TooLargeError: More than the limit was unpacked.
        """
        self._used += size
        if self._used > self.limit:
            raise TooLargeError(
                f'it unpacks to more than {format_size(self.limit)}, the most that is read of a file '
                'of its size'
            )


def unpack(compression: str, data: bytes, size: int) -> bytes:
    """Decompress a chunk of MCAP, or as much of it as there is.

    Args:
        compression: `lz4`, `zstd`, or empty for none.
        data: The chunk's data, which may be cut off.
        size: The size that the chunk declares (bytes). At most one byte more is returned.

    Raises:
        TooLargeError: The declared size is larger than `MAX_RECORD`.
        ValueError: The compression is unknown.
        RuntimeError, EOFError, zstd.ZstdError: The data is damaged.
    """
    check_record(size, 'a chunk')
    if compression == 'zstd':
        return _unpack_zstd(data, size + 1)
    if compression == 'lz4':
        return bytes(LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    if compression:
        raise ValueError(f'unknown compression {compression!r}')
    return data


def unpack_message(data: bytes) -> bytes:
    """Decompress a message that was compressed by itself.

    Raises:
        TooLargeError: It unpacks to more than `MAX_RECORD`.
        zstd.ZstdError, EOFError: It is not Zstandard data, or is cut off.
    """
    declared = zstd.get_frame_info(data).decompressed_size
    if declared is not None:
        check_record(declared, 'a message')
    unpacked = _unpack_zstd(data, MAX_RECORD + 1, whole=True)
    if len(unpacked) > MAX_RECORD:
        raise TooLargeError(f'a message unpacks to more than {format_size(MAX_RECORD)}')
    return unpacked


def _unpack_zstd(data: bytes, limit: int, *, whole: bool = False) -> bytes:
    parts: list[bytes] = []
    for _ in range(_MAX_FRAMES):
        decompressor = zstd.ZstdDecompressor()
        parts.append(decompressor.decompress(data, max_length=limit))
        limit -= len(parts[-1])
        if limit <= 0 or not decompressor.eof:
            break
        data = decompressor.unused_data
        if not data:
            return b''.join(parts)
    else:
        raise zstd.ZstdError(f'more than {_MAX_FRAMES} frames')
    if whole and limit > 0:
        raise EOFError('its compressed data is cut off')
    return b''.join(parts)


def unpack_file(path: Path, out: BinaryIO | None, budget: Budget | None = None) -> None:
    """Decompress a file, or as much of it as there is.

    Args:
        path: A Zstandard file.
        out: Where to write the content; None: only its size is checked.
        budget: What the files of its bag may unpack to; None: that of the file alone.

    Raises:
        TooLargeError: It unpacks to more than a file of its size may.
        OSError: It cannot be read, or `out` not be written.
        EOFError, zstd.ZstdError: It is damaged. What precedes the damage has been written.
    """
    budget = Budget(path.stat().st_size) if budget is None else budget
    with open(path, 'rb') as file:
        try:
            declared = zstd.get_frame_info(file.read(18)).decompressed_size
        except zstd.ZstdError:
            declared = None
        if declared is not None and declared > budget.limit:
            raise TooLargeError(
                f'{path.name} unpacks to {format_size(declared)}; at most {format_size(budget.limit)} '
                'are read of a file of its size'
            )
        file.seek(0)
        with zstd.open(file, 'rb') as packed:
            while block := packed.read(_BLOCK):
                try:
                    budget.spend(len(block))
                except TooLargeError as error:
                    raise TooLargeError(f'{path.name}: {error}') from None
                if out is not None:
                    out.write(block)
