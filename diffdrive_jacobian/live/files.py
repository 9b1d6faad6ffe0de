"""The files of the page, as they are installed with the package."""

from __future__ import annotations

from importlib.resources import files

TYPES = {
    '.html': 'text/html; charset=utf-8',
    '.css': 'text/css; charset=utf-8',
    '.js': 'text/javascript; charset=utf-8',
    '.svg': 'image/svg+xml',
}
"""Content type by the ending of a file."""


def page_files() -> dict[str, tuple[str, bytes]]:
    """Return content type and content of every file of the page, by name."""
    found = {}
    for file in files('diffdrive_jacobian.live').joinpath('page').iterdir():
        ending = file.name[file.name.rfind('.') :]
        if ending in TYPES:
            found[file.name] = TYPES[ending], file.read_bytes()
    return found
