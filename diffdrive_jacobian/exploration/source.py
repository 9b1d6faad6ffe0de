"""Values as Python source, for the tests that reproduce a counterexample."""

from __future__ import annotations

import enum
import math
import sys
from collections.abc import Iterable
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

from diffdrive_jacobian.exploration.errors import ExplorationError


class Source:
    """Writes values as expressions, and collects the imports that these need."""

    def __init__(self) -> None:
        """Start without imports."""
        self.imports: set[tuple[str, str]] = set()
        """Module and name of each class."""

    def expression(self, value: Any) -> str:
        """Return an expression that evaluates to an equal value.

        Raises:
            ExplorationError: The value contains an object that is neither a number, text, a container
                nor an instance of a dataclass.
        """
        if isinstance(value, enum.Enum):
            return f'{self._class(type(value))}.{value.name}'
        if value is None or isinstance(value, (bool, str, bytes)):
            return repr(value)
        if isinstance(value, int):
            return repr(int(value))
        if isinstance(value, float):
            return repr(float(value)) if math.isfinite(value) else f"float('{float(value)}')"
        if isinstance(value, tuple) and hasattr(value, '_fields'):
            return self._call(value, value._fields)
        if isinstance(value, tuple):
            return f'({", ".join(map(self.expression, value))}{"," * (len(value) == 1)})'
        if isinstance(value, list):
            return f'[{", ".join(map(self.expression, value))}]'
        if isinstance(value, (set, frozenset)):
            parts = ', '.join(sorted(map(self.expression, value)))
            braces = f'{{{parts}}}' if value else 'set()'
            return braces if isinstance(value, set) else f'frozenset({braces})'
        if isinstance(value, dict):
            pairs = (f'{self.expression(key)}: {self.expression(one)}' for key, one in value.items())
            return f'{{{", ".join(pairs)}}}'
        if is_dataclass(value) and not isinstance(value, type):
            return self._dataclass(value)
        raise ExplorationError(
            'a case must consist of None, bool, int, float, str, bytes, tuples, lists, sets, dicts, '
            'enums and dataclasses, so that a test can contain it; '
            f'got {type(value).__qualname__}: {value!r:.80}'
        )

    def _dataclass(self, value: Any) -> str:
        """Return a call with the arguments that differ from their defaults."""
        parts = []
        # Fields of a base class come first, also those that are given by name.
        for one in sorted(fields(value), key=lambda one: bool(one.kw_only)):
            given = getattr(value, one.name)
            if not one.init or given == one.default:
                continue
            required = one.default is MISSING and one.default_factory is MISSING
            label = '' if required and not one.kw_only else f'{one.name}='
            parts.append(label + self.expression(given))
        return f'{self._class(type(value))}({", ".join(parts)})'

    def _call(self, value: Any, names: Iterable[str]) -> str:
        parts = (f'{name}={self.expression(getattr(value, name))}' for name in names)
        return f'{self._class(type(value))}({", ".join(parts)})'

    def _class(self, kind: type) -> str:
        outer = kind.__qualname__.split('.')[0]
        if kind.__module__ == '__main__' or '<locals>' in kind.__qualname__:
            raise ExplorationError(
                f'the class {kind.__qualname__} must be at the top level of a module that other '
                'processes can import, not of the program itself'
            )
        self.imports.add((_public(kind.__module__, outer), outer))
        return kind.__qualname__


def _public(module: str, name: str) -> str:
    """Return the package of a module of this package if the name is public there."""
    package = '.'.join(module.split('.')[:2])
    if module.startswith('diffdrive_jacobian.') and name in getattr(
        sys.modules.get(package), '__all__', ()
    ):
        return package
    return module
