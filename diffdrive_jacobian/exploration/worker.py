"""What the executor of an exploration executes: a few worlds."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any

import rclpy

from diffdrive_jacobian.exploration.child import ChildDiedError, call_in_child, call_in_fresh_child
from diffdrive_jacobian.exploration.scenario import ExplorationError
from diffdrive_jacobian.exploration.trial import DIED, Outcome, Setting, Trial, Violation, run
from diffdrive_jacobian.text import error_text


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
            f'{type(error).__name__}: {error_text(error)}'
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
            outcomes.append(_died(error))
    return outcomes


def run_world_afresh(data: bytes) -> list[Outcome]:
    """Run one world in a new process, where no other has left anything behind.

    Args:
        data: From `packed`, with one trial.
    """
    try:
        return list(call_in_fresh_child(run_worlds_here, data))
    except ChildDiedError as error:
        return [_died(error)]


def _died(error: ChildDiedError) -> Outcome:
    died = Violation(key=str(error), seconds=0.0, text=str(error), name=DIED)
    return Outcome(violations=(died,))


def can_run_here() -> bool:
    """Return whether this thread may open a `Lockstep`."""
    return threading.current_thread() is threading.main_thread() and not rclpy.ok()


def run_worlds_here(data: bytes) -> list[Outcome]:
    """Run worlds in this thread, as `run_worlds`."""
    values: tuple[Any, ...] = pickle.loads(data)
    setting, trials, only, digest = values
    return [run(setting, trial, only=only, digest=digest) for trial in trials]


class TaskNotEnded(BaseException):
    """A task still runs. Not an Exception, which Hypothesis would take for a failure."""


def result_of(future: Future[list[Outcome]], timeout: float | None) -> list[Outcome]:
    """Return the result of a task.

    Args:
        future: The task.
        timeout: Longest wall time to wait (s); None: no limit.

    Raises:
        ExplorationError: The executor failed, or a fault or a property is invalid.
        TaskNotEnded: The task still runs after `timeout`.
    """
    try:
        return future.result(timeout)
    except ExplorationError:
        raise
    except Exception as error:
        if isinstance(error, FutureTimeoutError) and not future.done():
            raise TaskNotEnded from None
        raise ExplorationError(
            f'a world could not be run: {type(error).__name__}: {error_text(error)}'
        ) from error
