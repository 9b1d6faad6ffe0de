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

"""Text for messages: lists of names, and text of unknown origin, such as a topic name in a bag."""

from __future__ import annotations

import os
import sys

PATH_LIMIT = 4096
"""Length that every path of Linux has room in: a `limit` for paths."""
_ELLIPSIS = '...'


def how_to_get_ros() -> str:
    """Return where this machine gets ROS from, in words."""
    if sys.platform == 'linux' and os.uname().machine == 'x86_64':
        return (
            'source the setup file of a ROS 2 Jazzy installation (. /opt/ros/jazzy/setup.bash), or call '
            "pip install '.[jazzy]' in a clone of diffdrive_jacobian"
        )
    return (
        'source a ROS 2 Jazzy installation (pip has ROS for Linux on x86-64 alone): of the system, in a '
        'container, from RoboStack, or on Windows in WSL, see doc/troubleshooting.md'
    )


def printable(text: object, limit: int = 80) -> str:
    r"""Return text in which a terminal finds nothing to obey, cut to a length.

    Control characters (terminal escapes, newlines), invisible and bidirectional formatting characters
    and surrogates are replaced by their Python escapes, such as ``\x1b``. All other text, non-ASCII
    letters included, stays as it is.

    Args:
        text: Any object; its `str` is used.
        limit: Maximum length of the result, at least 3. Longer text ends in ``...``.
    """
    text = str(text)
    # No character becomes shorter, so what is beyond the limit cannot be part of the result.
    escaped = [one if one.isprintable() else _escape(one) for one in text[: limit + 1]]
    if sum(map(len, escaped)) <= limit:
        return ''.join(escaped)
    room = limit - len(_ELLIPSIS)
    while sum(map(len, escaped)) > room:
        escaped.pop()
    return ''.join(escaped) + _ELLIPSIS


def printable_lines(text: str) -> str:
    """Return text of several lines, in each of which characters are replaced as by `printable`."""
    return ''.join(one if one.isprintable() or one == '\n' else _escape(one) for one in text)


def error_text(error: BaseException) -> str:
    """Return the message of an exception, which may be of a class with an `__str__` that fails."""
    try:
        return printable_lines(str(error))
    except Exception as failure:
        return f'(its __str__ raises {type(failure).__name__})'


def format_size(size: int) -> str:
    """Return a number of bytes in a readable unit, such as `12.9 GB`."""
    for power, unit in ((9, 'GB'), (6, 'MB'), (3, 'kB')):
        if size >= 10**power:
            return f'{size / 10**power:.1f} {unit}'
    return f'{size} bytes'


def _escape(character: str) -> str:
    return character.encode('unicode_escape').decode('ascii')


def listed(names: list[str]) -> str:
    """Return names in one line, sorted: `/a`, `/a and /b`, `/a, /b and /c`; repetitions as counts."""
    counts = {name: names.count(name) for name in sorted(names)}
    words = [name if count == 1 else f'{name} ({count} times)' for name, count in counts.items()]
    if len(words) < 2:
        return ''.join(words)
    return f'{", ".join(words[:-1])} and {words[-1]}'
