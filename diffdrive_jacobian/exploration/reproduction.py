"""Tests that reproduce a finding."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from diffdrive_jacobian.exploration.digest import MessageDigest
from diffdrive_jacobian.exploration.result import described_replay
from diffdrive_jacobian.exploration.trial import of_exception, seconds
from diffdrive_jacobian.exploration.versions import differences, versions
from diffdrive_jacobian.lockstep._errors import PropertyViolation
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.text import printable_lines


@contextmanager
def reproducing(world: Lockstep, case: Path) -> Iterator[None]:
    """Add to an exception that the body raises how it compares with what `explore` found.

    It is the same bit for bit with the same versions and the same features of the processor. Elsewhere
    the verdict is the same, but numbers may be rounded otherwise.

    Args:
        world: The world in which the body runs the case.
        case: The file counterexample.json.
    """
    found = json.loads(case.read_text(encoding='utf-8'))
    with MessageDigest(world) as messages:
        try:
            yield
        except (Exception, SystemExit) as error:
            if isinstance(error, PropertyViolation):
                key, time = printable_lines(repr(error.property)), seconds(world)
            else:
                violation = of_exception(error, world)
                key, time = violation.key, violation.seconds
            verdict = key == found['violation']
            same = verdict and time == found['seconds'] and messages.value() == found['digest']
            text = described_replay(verdict, same, differences(versions(), found['versions']))
            # As add_note of Python 3.11.
            error.__notes__ = [*getattr(error, '__notes__', []), text]  # type: ignore[union-attr]
            raise
