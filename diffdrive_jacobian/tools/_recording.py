"""Where the tools record to. Apart from `_cli`, for rosbags is slow to import."""

from __future__ import annotations

from pathlib import Path

from diffdrive_jacobian.recording.recording import Recording


def begin_recording(
    prefix: str, output: str | None, storage: str, *, lossless: bool = False
) -> Recording:
    """Start to record to what the user named, or to something named after the time.

    Args:
        prefix: Begins the name, if the user gave none.
        output: What the user named.
        storage: `mcap` or `sqlite3`.
        lossless: Whether to wait for a slow disk, as in simulated time, or to drop messages.

    Raises:
        OSError: It exists already, or cannot be written; the message says which.
    """
    try:
        if output is None:
            return Recording.named_by_time(prefix, storage, lossless=lossless)
        return Recording(Path(output), storage, lossless=lossless)
    except OSError as error:
        where = output or 'this directory'
        raise OSError(f'cannot record to {where}: {(error.strerror or str(error)).lower()}') from error
