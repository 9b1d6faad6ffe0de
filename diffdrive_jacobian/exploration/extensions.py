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

"""What others add to tests: installed distributions name it by entry points.

- `diffdrive_jacobian.fault_kinds`: kinds of faults that `fault_schedules` draws. The name of the entry
  point is what they affect, and the field with the name of that: `robot`. The object is a dict: each
  kind, with a function that returns strategies of its other fields, without start and duration.
- `diffdrive_jacobian.pictures`: functions `draw(bag, picture, marks)` that draw a bag into a file, and
  return why not ('': it is drawn; None: they do not know what is in the bag). `marks` are times of the
  recorder (ns), each with a text.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from diffdrive_jacobian.exploration.scenario import ExplorationError
from diffdrive_jacobian.text import error_text

FAULT_KINDS = 'diffdrive_jacobian.fault_kinds'
PICTURES = 'diffdrive_jacobian.pictures'
Mark = tuple[int, str]


def names(group: str) -> list[str]:
    """Return the names of the entry points of a group, sorted."""
    return sorted({one.name for one in entry_points(group=group)})


def load(group: str, name: str) -> Any:
    """Return what the entry point of a name stands for.

    Raises:
        ExplorationError: It cannot be imported, or there are several. The message names them.
    """
    found = {one.value: one for one in entry_points(group=group, name=name)}
    if len(found) > 1:
        raise ExplorationError(
            f'several distributions have an entry point {name} of {group}: {", ".join(sorted(found))}'
        )
    ((value, one),) = found.items()
    try:
        return one.load()
    except (Exception, SystemExit) as error:
        raise ExplorationError(
            f'the entry point {name} = {value} of {group} cannot be imported: '
            f'{type(error).__name__}: {error_text(error)}'
        ) from error


def draw(bag: Path, picture: Path, marks: Sequence[Mark] = ()) -> str | None:
    """Draw a bag by the first of the installed functions that knows what is in it.

    Returns:
        Why it is not drawn; '': it is. None: none of them knows it.
    """
    reasons = []
    for one in names(PICTURES):
        try:
            why: str | None = load(PICTURES, one)(bag, picture, marks)
        except ExplorationError as error:
            reasons.append(str(error))
        except (Exception, SystemExit) as error:
            # The bag must not be lost.
            reasons.append(f'{one} of {PICTURES}: {type(error).__name__}: {error_text(error)}')
        else:
            if why == '':
                return ''
            reasons += [] if why is None else [why]
    return '; '.join(reasons) or None
