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

"""Scenarios by name, so that other processes and test files find them; errors of the exploration."""

from __future__ import annotations

import enum
import importlib
import importlib.util
import inspect
import math
import sys
import sysconfig
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from diffdrive_jacobian.errors import DiffdriveError


class ExplorationError(DiffdriveError):
    """An exploration cannot be done; the message says why, and what to change."""


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
        match value:
            case enum.Enum():
                return f'{self._class(type(value))}.{value.name}'
            case None | bool() | str() | bytes():
                return repr(value)
            case int():
                return repr(int(value))
            case float():
                return repr(float(value)) if math.isfinite(value) else f"float('{float(value)}')"
            case tuple() if hasattr(value, '_fields'):
                named = zip(value._fields, map(self.expression, value), strict=True)
                return f'{self._class(type(value))}({", ".join(f"{name}={one}" for name, one in named)})'
            case tuple():
                return f'({", ".join(map(self.expression, value))}{"," * (len(value) == 1)})'
            case list():
                return f'[{", ".join(map(self.expression, value))}]'
            case set() | frozenset():
                parts = ', '.join(sorted(map(self.expression, value)))
                braces = f'{{{parts}}}' if value else 'set()'
                return braces if isinstance(value, set) else f'frozenset({braces})'
            case dict():
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
    """Return the package in which a name of a module of this package is public, or else the module."""
    if module.startswith('diffdrive_jacobian.'):
        for package in ('.'.join(module.split('.')[:2]), *PUBLIC):
            if name in getattr(sys.modules.get(package), '__all__', ()):
                return package
    return module


PUBLIC = tuple(f'diffdrive_jacobian.{name}' for name in ('faults', 'properties', 'relations', 'testing'))
"""Packages whose names a written test may import."""
Scenario = Callable[[Any, Any], object]
"""`scenario(world, case)` creates the nodes in a `Lockstep` and advances its time."""


@dataclass(frozen=True, kw_only=True)
class ScenarioName:
    """Where a scenario is defined."""

    module: str
    """Name of its module."""
    name: str
    """Name of the function."""
    root: str | None
    """Folder that must be on `sys.path` to import the module; None: it is installed."""

    @classmethod
    def of(cls, scenario: Scenario) -> ScenarioName:
        """Return where a function is defined.

        Raises:
            ExplorationError: It is not a function at the top level of a file.
        """
        name = getattr(scenario, '__qualname__', None)
        module = sys.modules.get(getattr(scenario, '__module__', ''))
        if not inspect.isfunction(scenario) or getattr(module, str(name), None) is not scenario:
            raise ExplorationError(
                'scenario must be a function (world, case) at the top level of a module, because other '
                f'processes import it by its name; got {name or repr(scenario)}'
            )
        count = len(inspect.signature(scenario).parameters)
        if count != 2:
            raise ExplorationError(
                f'scenario must take two arguments, (world, case); {name} takes {count}'
            )
        file = getattr(module, '__file__', None)
        if file is None:
            raise ExplorationError(
                f'scenario must be defined in a file, because other processes import it; {name} is not'
            )
        path, dotted = Path(file).resolve(), scenario.__module__
        if dotted == '__main__':
            dotted = getattr(getattr(module, '__spec__', None), 'name', None) or path.stem
        installed = {Path(sysconfig.get_path(kind)).resolve() for kind in ('purelib', 'platlib')}
        if any(path.is_relative_to(folder) for folder in installed):
            return cls(module=dotted, name=str(name), root=None)
        return cls(module=dotted, name=str(name), root=str(_root(path, dotted)))

    def load(self) -> Scenario:
        """Import the function.

        Raises:
            ExplorationError: It cannot be imported.
        """
        try:
            return getattr(self._module(), self.name)  # type: ignore[no-any-return]
        except (ImportError, AttributeError) as error:
            where = f' from {self.root}' if self.root else ''
            if self.root and _file(Path(self.root), self.module) is None:
                where += f', which has no {self.module.replace(".", "/")}.py'
            raise ExplorationError(
                f'scenario {self.name} of module {self.module} cannot be imported{where}: {error}'
            ) from error

    def _module(self) -> ModuleType:
        if self.root is None:
            return importlib.import_module(self.module)
        if self.root not in sys.path:
            sys.path.insert(0, self.root)
        file = _file(Path(self.root), self.module)
        module = importlib.import_module(self.module)
        if file is None or Path(getattr(module, '__file__', None) or '').resolve() == file:
            return module
        # Another module of this name comes first, for example one of the standard library.
        own = f'_scenario_{self.module}'
        if own in sys.modules:
            return sys.modules[own]
        spec = importlib.util.spec_from_file_location(own, file)
        if spec is None or spec.loader is None:
            raise ImportError(f'{file} is no Python module')
        module = sys.modules[own] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module


def scenario_from(root: str | Path, module: str, name: str) -> Scenario:
    """Return the function of a module that is found in a folder, which need not be on `sys.path`.

    Raises:
        ExplorationError: It cannot be imported.
    """
    return ScenarioName(module=module, name=name, root=str(Path(root).resolve())).load()


def _root(path: Path, module: str) -> Path:
    """Return the folder from which a file is imported under a dotted name."""
    depth = module.count('.') + (path.name == '__init__.py')
    return path.parents[min(depth, len(path.parents) - 1)]


def _file(root: Path, module: str) -> Path | None:
    base = root.joinpath(*module.split('.'))
    found = [path for path in (base.with_suffix('.py'), base / '__init__.py') if path.is_file()]
    return found[0].resolve() if found else None
