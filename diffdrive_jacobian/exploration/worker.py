"""What the executor of an exploration executes: a few worlds."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from typing import Any

import rclpy

from diffdrive_jacobian.exploration.child import ChildDiedError, call_in_child
from diffdrive_jacobian.exploration.errors import ExplorationError
from diffdrive_jacobian.exploration.trial import Outcome, Setting, Trial, Violation, run


def packed(
    setting: Setting, trials: Sequence[Trial], *, only: int | None = None, digest: bool = False
) -> bytes:
    """Return the arguments of `run_worlds` as bytes.

    Raises:
        ExplorationError: They cannot be pickled.
    """
    try:
        return pickle.dumps((setting, tuple(trials), only, digest))
    except Exception as error:
        raise ExplorationError(
            'properties, cases and faults are sent to other processes, so they must be picklable: '
            f'{type(error).__name__}: {error}'
        ) from error


def run_worlds(data: bytes) -> list[Outcome]:
    """Run worlds, in this process if it can run a `Lockstep`, else in one of its own.

    Args:
        data: From `packed`.

    Raises:
        ExplorationError: The scenario cannot be imported, or a fault or property is invalid.
    """
    if can_run_here():
        return run_worlds_here(data)
    try:
        return list(call_in_child(run_worlds_here, data))
    except ChildDiedError:
        return _one_by_one(data)


def _one_by_one(data: bytes) -> list[Outcome]:
    """Run worlds of which one ends its process."""
    setting, trials, only, digest = pickle.loads(data)
    outcomes = []
    for trial in trials:
        one = packed(setting, [trial], only=only, digest=digest)
        try:
            outcomes += call_in_child(run_worlds_here, one)
        except ChildDiedError as error:
            died = Violation(key=str(error), seconds=0.0, text=str(error), name='NoExceptionProcessDied')
            outcomes.append(Outcome(violations=(died,)))
    return outcomes


def can_run_here() -> bool:
    """Return whether this thread may open a `Lockstep`."""
    return threading.current_thread() is threading.main_thread() and not rclpy.ok()


def run_worlds_here(data: bytes) -> list[Outcome]:
    """Run worlds in this thread, as `run_worlds`."""
    values: tuple[Any, ...] = pickle.loads(data)
    setting, trials, only, digest = values
    return [run(setting, trial, only=only, digest=digest) for trial in trials]


def result_of(future: Future[list[Outcome]]) -> list[Outcome]:
    """Return the result of a task.

    Raises:
        ExplorationError: The executor failed, or a fault or a property is invalid.
    """
    try:
        return future.result()
    except ExplorationError:
        raise
    except Exception as error:
        raise ExplorationError(f'a world could not be run: {type(error).__name__}: {error}') from error
