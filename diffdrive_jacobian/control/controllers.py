"""Controllers by name: those of this package, and those that other installed packages provide.

The controllers of this package are those of `goal_laws` and `path_laws`. Other packages provide theirs
as entry points of the groups `diffdrive_jacobian.controllers` and `diffdrive_jacobian.path_controllers`:

    entry_points={'diffdrive_jacobian.controllers': ['my_law = my_package.my_law:CONTROLLER']}

An entry point is imported when its controller is used, not before.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

from diffdrive_jacobian.control.controller import ControlLaw, Controller, PathController
from diffdrive_jacobian.control.goal_laws import GOAL_CONTROLLERS
from diffdrive_jacobian.control.path_laws import PATH_CONTROLLERS
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.numerics.checks import instance, short

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

C = TypeVar('C', bound=ControlLaw)


class ControllerError(DiffdriveError, ValueError):
    """There is no such controller, or it cannot be loaded."""


BUILT_IN = {one.name: one for one in GOAL_CONTROLLERS}
"""The controllers of goals of this package, by name."""


class AnyControllers(Collection[str], Generic[C]):
    """Base class of `Controllers` and `PathControllers`."""

    kind: type[C]
    """Their class."""
    built_in: ClassVar[Mapping[str, ControlLaw]]
    """The controllers of this package, by name."""
    group: ClassVar[str]
    """Entry-point group of the controllers of other packages."""
    parameter: ClassVar[str]
    """Parameter of go_to_goal that chooses one."""
    title: ClassVar[str]
    """What it is, in the description of the parameter."""

    def __init__(self, *given: C) -> None:
        """Take further controllers, which take precedence over installed ones of the same name.

        One of another class, or with the name of a built-in one, raises ValueError.
        """
        self._given: dict[str, C] = {}
        for controller in given:
            instance(self.parameter, controller, self.kind)
            if self.built_in.get(controller.name, controller) != controller:
                raise ValueError(
                    f'{self.parameter} must have a name of its own, got {controller.name!r}, '
                    'which is built in'
                )
            self._given[controller.name] = controller

    def __contains__(self, name: object) -> bool:
        """Return whether there is a controller of that name, without loading it."""
        if not isinstance(name, str):
            return False
        known = name in self.built_in or name in self._given or (self.group, name) in _loaded
        return known or bool(self._entry_points(name))

    def __iter__(self) -> Iterator[str]:
        """Return the names, sorted."""
        installed = (one.name for one in self._entry_points())
        return iter(sorted({*self.built_in, *self._given, *installed}))

    def __len__(self) -> int:
        """Return how many there are."""
        return len(list(iter(self)))

    def __bool__(self) -> bool:
        """Return True: there are always the built-in ones."""
        return True

    def hint(self, name: str) -> str:
        """Return what a name is that is no controller of this kind. Empty: this is not known."""
        return ''

    def find(self, name: str) -> C:
        """Return the controller of that name; an installed one is imported.

        A name that is unknown, and a controller that cannot be loaded, raise ControllerError.
        """
        if isinstance(name, str) and (found := self._given.get(name) or self.built_in.get(name)):
            assert isinstance(found, self.kind)
            return found
        if name not in self:
            raise ControllerError(
                f'{self.parameter} must be one of {", ".join(map(repr, self))}, got {short(repr(name))}'
                f'{self.hint(name)}'
            )
        return self._load(name)

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
        known = _loaded.get((self.group, name))
        if isinstance(known, self.kind):
            return known
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
        _loaded[self.group, name] = controller
        return controller


class Controllers(AnyControllers[Controller]):
    """Names of the controllers of goals that can be used, and the controllers by name.

    Iteration and `in` look for installed entry points, but do not import them.
    """

    kind = Controller
    built_in = BUILT_IN
    group = 'diffdrive_jacobian.controllers'
    parameter = 'controller'
    title = 'Control law'

    def hint(self, name: str) -> str:
        """Return what a name is that is no controller of goals."""
        return ', a law of paths' if name in ALL_PATH_CONTROLLERS else ''


class PathControllers(AnyControllers[PathController]):
    """Names of the controllers of paths, as `Controllers` of those of goals."""

    kind = PathController
    built_in: ClassVar = {one.name: one for one in PATH_CONTROLLERS}
    group = 'diffdrive_jacobian.path_controllers'
    parameter = 'path_controller'
    title = 'Control law along a path'

    def hint(self, name: str) -> str:
        """Return what a name is that is no controller of paths."""
        return ', a law of goals' if name in CONTROLLERS else ''


CONTROLLERS = Controllers()
"""The built-in and the installed controllers of goals."""
ALL_PATH_CONTROLLERS = PathControllers()
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


_loaded: dict[tuple[str, str], ControlLaw] = {}
"""The installed controllers that were imported, by group and name."""


def _owner(entry_point: EntryPoint) -> str:
    """Return name and version of the package that provides an entry point."""
    distribution = entry_point.dist
    if distribution is None:
        return 'an unknown package'
    return f'{distribution.name} {distribution.version}'
