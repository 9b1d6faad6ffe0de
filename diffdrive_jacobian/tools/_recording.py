"""Where the tools record to. Apart from `_cli`, for rosbags is slow to import."""

from __future__ import annotations

from pathlib import Path

from diffdrive_jacobian.bags.recording import Recording


def begin_recording(prefix: str, output: str | None, storage: str) -> Recording:
    """Begin to record to what the user named, or to something named after the time.

    Raises:
        OSError: It exists already, or cannot be written; the message says which.
    """
    try:
        if output is None:
            return Recording.named_by_time(prefix, storage)
        return Recording(Path(output), storage)
    except OSError as error:
        where = output or 'this directory'
        raise OSError(f'cannot record to {where}: {(error.strerror or str(error)).lower()}') from error
