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

"""A field of a message by its path, which a fault changes and a property looks at."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from diffdrive_jacobian.messages.structure import Array, FieldType, Sequence, Structure, structure

_STEP = re.compile(r'([A-Za-z]\w*)(?:\[(\d+)\])?')


class MessageField:
    """A field of a message class: a value, a structure, or all elements of an array of values."""

    def __init__(self, message_class: Any, path: str) -> None:
        """Find the field by its path, such as `poses[0].pose.position.x`.

        Without an index at its end the path of an array or a sequence means all elements.

        Raises:
            ValueError: There is no such field. The message names those that there are.
        """
        self._steps: list[tuple[str, int | None]] = []
        kind: FieldType = structure(message_class)
        for step in path.split('.'):
            matched = _STEP.fullmatch(step)
            fields = dict(kind.fields) if isinstance(kind, Structure) else {}
            if matched is None or matched[1] not in fields:
                nested = isinstance(kind, (Array, Sequence))
                there = ', '.join(fields) or ('elements [0], [1], ...' if nested else 'none')
                raise ValueError(
                    f"field '{path}' does not exist: {kind} has no {step!r}; its fields: {there}"
                )
            kind = fields[matched[1]]
            index = None if matched[2] is None else int(matched[2])
            if index is not None:
                if not isinstance(kind, (Array, Sequence)):
                    raise ValueError(f"field '{path}' does not exist: '{matched[1]}' has a single value")
                if isinstance(kind, Array) and index >= kind.count:
                    raise ValueError(
                        f"field '{path}' does not exist: '{matched[1]}' has {kind.count} elements"
                    )
                kind = kind.element
            self._steps.append((matched[1], index))
        self.path = path
        self.is_array = isinstance(kind, (Array, Sequence))
        """Whether the field is an array or a sequence with all its elements."""
        self.type = kind.element if isinstance(kind, (Array, Sequence)) else kind
        """Type of the value, or of the elements."""

    def values(self, message: Any) -> Any:
        """Return a sequence of the value in a message, or of the elements of an array; empty: none."""
        holder = self._holder(message)
        if holder is None:
            return []
        name, index = self._steps[-1]
        value = getattr(holder, name)
        if index is not None:
            return value[index : index + 1]
        return value if self.is_array else [value]

    def _holder(self, message: Any) -> Any:
        """Return the structure in which the field is; None: the message has no such element."""
        holder = message
        for step, index in self._steps[:-1]:
            holder = getattr(holder, step)
            if index is not None:
                if index >= len(holder):
                    return None
                holder = holder[index]
        return holder

    def replace(self, message: Any, change: Callable[[Any], Any]) -> bool:
        """Replace the value in a message, or each element of an array, by that which `change` returns.

        `change` may change a structure in place. Return whether there is anything else than before.
        There is not if the message has no such element.
        """
        holder = self._holder(message)
        if holder is None:
            return False
        name, last = self._steps[-1]
        if last is None and not self.is_array:
            old = getattr(holder, name)
            before = repr(old)
            setattr(holder, name, new := change(old))
            return repr(new) != before
        values = getattr(holder, name)
        changed = False
        for index in range(len(values)) if last is None else [last] * (last < len(values)):
            old = values[index].item() if hasattr(values[index], 'item') else values[index]
            before = repr(old)
            values[index] = new = change(old)
            changed |= repr(new) != before
        return changed
