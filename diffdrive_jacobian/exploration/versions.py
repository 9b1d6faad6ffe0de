"""What the bits of a run depend on besides its inputs: versions and features of the processor."""

from __future__ import annotations

import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from diffdrive_jacobian import __version__


def versions() -> dict[str, str]:
    """Return the versions and the processor on which the last bit of a run may depend.

    Elsewhere a run may differ by rounding: NumPy and the C library choose their code by the features of
    the processor.
    """
    return {
        'diffdrive_jacobian': __version__,
        'python': platform.python_version(),
        'numpy': np.__version__,
        'rclpy': _rclpy(),
        'libc': ' '.join(platform.libc_ver()),
        'machine': platform.machine(),
        'processor features': _processor(),
    }


def differences(here: dict[str, str], there: dict[str, str]) -> list[str]:
    """Return what differs between two results of `versions`, one line for each."""
    return [
        f'{name} {here.get(name, "unknown")} here, {there.get(name, "unknown")} there'
        for name in dict.fromkeys([*here, *there])
        if here.get(name) != there.get(name)
    ]


def _rclpy() -> str:
    for name in ('ros-rclpy', 'rclpy'):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return 'unknown'


def _processor() -> str:
    """Return a hash of the features of the processor, as Linux lists them."""
    try:
        lines = Path('/proc/cpuinfo').read_text(errors='replace').splitlines()
    except OSError:
        return 'unknown'
    flags = next(
        (line.partition(':')[2] for line in lines if line.startswith(('flags', 'Features'))), ''
    )
    return hashlib.sha256(' '.join(sorted(flags.split())).encode()).hexdigest()[:16]
