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

"""Controllers by name: those of this package, and those that other installed packages provide.

The controllers of this package are those of `goal_laws` and `path_laws`. Other packages provide theirs
as entry points of the groups `diffdrive_jacobian.controllers` and `diffdrive_jacobian.path_controllers`:

    entry_points={'diffdrive_jacobian.controllers': ['my_law = my_package.my_law:CONTROLLER']}

An entry point is imported when its controller is used, not before.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Generic, TypeVar

from diffdrive_jacobian.control.controller import ControlLaw, Controller, PathController
from diffdrive_jacobian.control.goal_laws import GOAL_CONTROLLERS
from diffdrive_jacobian.control.path_laws import PATH_CONTROLLERS
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.numerics.checks import choices, instance, short

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

C = TypeVar('C', bound=ControlLaw)


class ControllerError(DiffdriveError, ValueError):
    """There is no such controller, or it cannot be loaded."""


class Controllers(Collection[str], Generic[C]):
    """Names of the controllers of one kind that can be used, and the controllers by name.

    Iteration and `in` look for installed entry points, but do not import them.
    """

    def __init__(self, kind: type[C], built_in: Iterable[C], parameter: str, title: str) -> None:
        """Take the controllers of this package, the parameter of go_to_goal that chooses one, and what
        they are, for its description.
        """
        self.kind = kind
        self.built_in = {one.name: one for one in built_in}
        self.parameter = parameter
        self.title = title
        self.group = f'diffdrive_jacobian.{parameter}s'
        # Those that were given or imported, too.
        self._known: dict[str, C] = dict(self.built_in)

    def with_controller(self, controller: C) -> Controllers[C]:
        """Return these and another one, which takes precedence over an installed one of the same name.

        One of another class, or with the name of a built-in one, raises ValueError.
        """
        instance(self.parameter, controller, self.kind)
        if self.built_in.get(controller.name, controller) != controller:
            raise ValueError(
                f'{self.parameter} must have a name of its own, got {controller.name!r}, '
                'which is built in'
            )
        more = copy.copy(self)
        more._known = {**self._known, controller.name: controller}
        return more

    def __contains__(self, name: object) -> bool:
        """Return whether there is a controller of that name, without loading it."""
        return isinstance(name, str) and (name in self._known or bool(self._entry_points(name)))

    def __iter__(self) -> Iterator[str]:
        """Return the names, sorted."""
        return iter(sorted({*self._known, *(one.name for one in self._entry_points())}))

    def __len__(self) -> int:
        """Return how many there are."""
        return len(tuple(iter(self)))

    def __bool__(self) -> bool:
        """Return True, without a search: there are always the built-in ones."""
        return True

    def find(self, name: str) -> C:
        """Return the controller of that name; an installed one is imported.

        A name that is unknown, and a controller that cannot be loaded, raise ControllerError.
        """
        if name not in self:
            others = [one for one in (CONTROLLERS, ALL_PATH_CONTROLLERS) if name in one]
            hint = f', a law of {"goals" if others[0] is CONTROLLERS else "paths"}' if others else ''
            raise ControllerError(
                f'{self.parameter} must be {choices(self)}, got {short(name, repr)}{hint}'
            )
        if name not in self._known:
            self._known[name] = self._load(name)
        return self._known[name]

    def _entry_points(self, name: str | None = None) -> list[EntryPoint]:
        """Return the installed entry points, all or those of one name."""
        # It takes tens of milliseconds to import and to search, and built-in controllers do not need it.
        from importlib.metadata import entry_points

        group = self.group
        found = entry_points(group=group) if name is None else entry_points(group=group, name=name)
        # The names of all others would only lead to errors.
        return [one for one in found if one.name not in self.built_in]

    def _load(self, name: str) -> C:
        """Import an installed controller."""
        found = self._entry_points(name)
        owners = ' and '.join(sorted(_owner(one) for one in found))
        if len(found) > 1:
            raise ControllerError(f'{self.parameter} {name!r} is provided by several packages: {owners}')
        (entry_point,) = found
        what = f'{self.parameter} {name!r} of {owners} ({short(entry_point.value)})'
        try:
            controller = entry_point.load()
        except (Exception, SystemExit) as error:
            reason = ' '.join(f'{type(error).__name__}: {error}'.split())[:200]
            raise ControllerError(f'{what} cannot be loaded: {reason}') from error
        if not isinstance(controller, self.kind):
            raise ControllerError(f'{what} must be a {self.kind.__name__}, got {short(controller)}')
        if controller.name != name:
            raise ControllerError(
                f'{what} must have the name of its entry point, {name!r}, got {controller.name!r}'
            )
        return controller


def _owner(entry_point: EntryPoint) -> str:
    """Return name and version of the package that provides an entry point."""
    owner = entry_point.dist
    return 'an unknown package' if owner is None else f'{owner.name} {owner.version}'


CONTROLLERS = Controllers(Controller, GOAL_CONTROLLERS, 'controller', 'Control law')
"""The built-in and the installed controllers of goals."""
ALL_PATH_CONTROLLERS = Controllers(
    PathController, PATH_CONTROLLERS, 'path_controller', 'Control law along a path'
)
"""The built-in and the installed controllers of paths."""


def find_controller(name: str) -> Controller:
    """Return the built-in or installed controller of that name; an installed one is imported.

    A name that is unknown, and a controller that cannot be loaded, raise ControllerError.
    """
    return CONTROLLERS.find(name)


def controller_names() -> tuple[str, ...]:
    """Return the names of the built-in and the installed controllers, sorted. Nothing is imported."""
    return tuple(CONTROLLERS)


def find_path_controller(name: str) -> PathController:
    """Return the controller of paths of that name, as `find_controller` one of goals."""
    return ALL_PATH_CONTROLLERS.find(name)


def path_controller_names() -> tuple[str, ...]:
    """Return the names of the built-in and the installed controllers of paths, sorted."""
    return tuple(ALL_PATH_CONTROLLERS)


def names_of_gains() -> set[str]:
    """Return the names of the gains of all installed controllers, of goals and of paths."""
    found: set[str] = set()
    for controllers in (CONTROLLERS, ALL_PATH_CONTROLLERS):
        for name in controllers:
            with suppress(ControllerError):
                found.update(controllers.find(name).gain_names)
    return found
