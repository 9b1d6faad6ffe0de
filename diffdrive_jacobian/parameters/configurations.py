"""The parameter files of robots that are installed with this package."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

PACKAGE = 'diffdrive_jacobian'
SHARE = Path('share', PACKAGE, 'config')
"""Directory of the files below the prefix of an installation."""


def configurations() -> dict[str, Path]:
    """Return the parameter files by the names of the robots, sorted."""
    found: dict[str, Path] = {}
    for file in _files():
        found.setdefault(file.stem, file)
    if not found:
        for file in _listed_files():
            found.setdefault(file.stem, file)
    return dict(sorted(found.items()))


def _files() -> Iterator[Path]:
    """Yield the files of the clone, of the Python installation and of the ROS installation."""
    # An editable installation has no copy of them.
    above = Path(__file__).parents[2]
    if (above / 'setup.py').is_file():
        yield from (above / 'config').glob('*.yaml')
    # As `pip install --target` lays it out, and below a prefix, in lib/python3.X/site-packages.
    yield from (above / SHARE).glob('*.yaml')
    if len(above.parents) > 2:
        yield from (above.parents[2] / SHARE).glob('*.yaml')
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        if prefix:
            yield from (Path(prefix) / SHARE).glob('*.yaml')


def _listed_files() -> Iterator[Path]:
    """Yield the files that the installation lists, which may be anywhere."""
    # Not above: it takes 20 ms to import.
    from importlib import metadata

    try:
        files = metadata.distribution(PACKAGE).files or ()
    except metadata.PackageNotFoundError:
        return
    for file in files:
        if file.suffix == '.yaml' and file.parent.parts[-len(SHARE.parts) :] == SHARE.parts:
            path = Path(str(file.locate())).resolve()
            if path.is_file():
                yield path
