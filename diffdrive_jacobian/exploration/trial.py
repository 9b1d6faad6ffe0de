"""One world: its case and its faults, how it is run, and what comes out."""

from __future__ import annotations

import sys
import sysconfig
import traceback
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import diffdrive_jacobian
from diffdrive_jacobian.exploration.digest import MessageDigest
from diffdrive_jacobian.exploration.scenario import ScenarioName
from diffdrive_jacobian.faults import Fault
from diffdrive_jacobian.lockstep._errors import IneffectiveFaultsError, LockstepError, PropertyViolation
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.properties import Property, Watch
from diffdrive_jacobian.text import error_text, printable_lines
from diffdrive_jacobian.time_units import NANOSECONDS

QUIET = ('--disable-rosout-logs', '--disable-stdout-logs', '--disable-external-lib-logs')
"""ROS arguments of explored worlds. Logs of thousands of worlds help nobody, and take time."""
DIED = 'NoExceptionProcessDied'
"""Name of the violation of a world that ends its process."""
LONGEST_TEXT = 20_000
"""Length beyond which the text of a violation is cut (characters)."""
LONGEST_LINE = 500
"""Length beyond which the first line of an exception is cut (characters)."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What all worlds of an exploration have in common."""

    scenario: ScenarioName
    properties: tuple[Property, ...]
    args: tuple[str, ...] = ()
    """ROS arguments of all nodes."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """What distinguishes one world from the others."""

    case: Any
    faults: tuple[Fault, ...] = ()
    seed: int = 0
    """Seed of the random numbers of the faults."""


@dataclass(frozen=True, kw_only=True)
class Violation:
    """What a world violated."""

    key: str
    """The property as Python source, or the exception and where it was raised."""
    seconds: float
    """World time since the start (s)."""
    text: str
    """Description; for an exception its traceback."""
    name: str
    """Short name, a valid identifier."""
    index: int = -1
    """Index of the property; -1: an exception."""
    message: str = ''
    """Kind and first line of an exception."""

    @property
    def headline(self) -> str:
        """The description in one line."""
        return self.message or self.text.strip().partition('\n')[0]


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came out of a world."""

    violations: tuple[Violation, ...] = ()
    """In the order in which they happened."""
    checks: int = 0
    """How often a property was checked."""
    events: int = 0
    """How often faults acted."""
    seconds: float = 0.0
    """Duration in simulated time (s)."""
    complaints: tuple[str, ...] = ()
    """What faults or a property needed and did not find."""
    digest: str = ''
    """Hash of all messages, if it was asked for."""

    def of(self, key: str) -> Violation | None:
        """Return the violation with a key; None: there is none."""
        return next((one for one in self.violations if one.key == key), None)


@dataclass
class _Found:
    """Collects the violations of a world."""

    violations: list[Violation] = field(default_factory=list)
    checks: int = 0
    complaints: tuple[str, ...] = ()
    stopping: bool = False
    """Whether the world was ended because the violation that was looked for was found."""


class _Collecting:
    """Notes the first violation of a property, and lets the world go on."""

    def __init__(self, watched: Property, index: int, found: _Found, *, stop: bool) -> None:
        self.watched, self.index, self.found = watched, index, found
        self.stop = stop
        """Whether a violation ends the world."""

    def __repr__(self) -> str:
        """Return that of the property."""
        return repr(self.watched)

    def watch(self, world: Any) -> _CollectingWatch:
        """Return the watch."""
        return _CollectingWatch(self, self.watched.watch(world), world)


class _CollectingWatch:
    def __init__(self, collecting: _Collecting, watch: Watch, world: Lockstep) -> None:
        self._collecting, self._watch, self._world = collecting, watch, world
        self._open = True

    def check(self) -> str | None:
        if not self._open:
            return None
        self._collecting.found.checks += 1
        return self._note(self._watch.check())

    def finish(self) -> str | None:
        return self._note(self._watch.finish()) if self._open else None

    def _note(self, text: str | None) -> str | None:
        if text is None:
            return None
        self._open = False
        watched, found = self._collecting.watched, self._collecting.found
        found.violations.append(
            Violation(
                key=printable_lines(repr(watched)),
                name=type(watched).__name__,
                seconds=seconds(self._world),
                text=printable_lines(text)[:LONGEST_TEXT],
                index=self._collecting.index,
            )
        )
        found.stopping = self._collecting.stop
        return text if found.stopping else None


def seconds(world: Lockstep) -> float:
    """Return the world time (s)."""
    return world.world_time / NANOSECONDS


def run(
    setting: Setting,
    trial: Trial,
    *,
    only: int | None = None,
    digest: bool = False,
    during: Any = None,
) -> Outcome:
    """Run one world.

    Args:
        setting: What all worlds have in common.
        trial: The case and the faults.
        only: Index of the one property to check, whose violation ends the world; None: all of them,
            and the world goes on after a violation. -1: none, only exceptions count.
        digest: Whether to compute the hash of all messages.
        during: `during(world)` returns a context manager, in which the scenario runs.

    Raises:
        ExplorationError: The scenario cannot be imported.
        ValueError, LockstepError: A fault or a property is invalid in this world.
    """
    scenario = setting.scenario.load()
    found = _Found()
    properties = [
        _Collecting(one, index, found, stop=only is not None)
        for index, one in enumerate(setting.properties)
        if only in (None, index)
    ]
    arguments = list(setting.args) or ['--ros-args']
    with Lockstep([*arguments, '--ros-args', *QUIET]) as world, ambient(during, world):
        hashed: AbstractContextManager[MessageDigest | None] = (
            MessageDigest(world) if digest else nullcontext()
        )
        with hashed as messages:
            world.inject(*trial.faults, seed=trial.seed)
            world.require(*properties)
            _play(world, scenario, trial.case, found)
            return Outcome(
                violations=tuple(found.violations),
                checks=found.checks,
                events=len(world.fault_events),
                seconds=seconds(world),
                complaints=found.complaints,
                digest='' if messages is None else messages.value(),
            )


@contextmanager
def ambient(during: Any, world: Lockstep) -> Iterator[None]:
    """Run the body in the context that `during` gives for the world."""
    with nullcontext() if during is None else during(world):
        yield


def _play(world: Lockstep, scenario: Any, case: Any, found: _Found) -> None:
    """Run the scenario to its end or its failure."""
    try:
        scenario(world, case)
    except KeyboardInterrupt:
        raise
    except PropertyViolation:
        if not found.stopping:
            raise
        return
    except BaseException as error:
        found.violations.append(of_exception(error, world))
        return
    _finish(world, found)


def _finish(world: Lockstep, found: _Found) -> None:
    """Check the properties at the end, and that faults and properties had something to do with."""
    try:
        world.finish()
        world.check_faults()
    except PropertyViolation:
        if not found.stopping:
            raise
    except IneffectiveFaultsError as error:
        found.complaints = tuple(f'a fault had no effect: {reason}' for reason in error.reasons)
    except LockstepError as error:
        found.complaints = (str(error).partition('\n')[0],)


def of_exception(error: BaseException, world: Lockstep) -> Violation:
    """Return an exception of a node or of the scenario as a violation."""
    kind = type(error).__name__
    place = _place(error.__traceback__)
    # The last messages of all topics may follow.
    first = error_text(error).strip().partition('\n')[0]
    text = ''.join(traceback.format_exception(type(error), error, error.__traceback__))
    return Violation(
        key=printable_lines(f'{kind}{place}'),
        name=f'NoException{kind}',
        seconds=seconds(world),
        text=printable_lines(text)[-LONGEST_TEXT:],
        message=f'{kind}: {first}'[:LONGEST_LINE] if first else kind,
    )


def _place(trace: TracebackType | None) -> str:
    """Return the innermost line of the user's code, or of this package if there is none."""
    frames = traceback.extract_tb(trace)
    own = [frame for frame in frames if not _is_library(frame.filename)]
    chosen: Sequence[traceback.FrameSummary] = own or frames
    if not chosen:
        return ''
    last = chosen[-1]
    return f' in {Path(last.filename).name}:{last.lineno} ({last.name})'


_LIBRARIES = tuple(
    str(Path(folder).resolve())
    for folder in (
        sysconfig.get_path('stdlib'),
        sysconfig.get_path('purelib'),
        sysconfig.get_path('platlib'),
        sys.prefix + '/lib',
        Path(diffdrive_jacobian.__file__).parent / 'lockstep',
        Path(diffdrive_jacobian.__file__).parent / 'exploration',
    )
)


def _is_library(file: str) -> bool:
    return str(Path(file).resolve()).startswith(_LIBRARIES) or file.startswith('<')
