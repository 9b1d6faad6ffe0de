"""What all modules share: errors with one base class, seconds and nanoseconds."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

import diffdrive_jacobian
from diffdrive_jacobian.errors import DiffdriveError
from diffdrive_jacobian.time_units import NANOSECONDS, nanoseconds, seconds

PACKAGE = diffdrive_jacobian.__name__
NOT_ERRORS = {'Stuck', 'StopShrinking', 'TaskNotEnded'}
"""They end the code of users or of Hypothesis, which catches Exception, and never leave the package."""


def raised(base: type[BaseException]) -> Iterator[type[BaseException]]:
    """Yield the exception classes of the package, whatever they derive from."""
    for one in base.__subclasses__():
        if one.__module__.partition('.')[0] == PACKAGE:
            yield one
        yield from raised(one)


def test_every_error_has_the_base_class_a_docstring_and_a_name_of_its_own():
    for module in pkgutil.walk_packages(diffdrive_jacobian.__path__, f'{PACKAGE}.'):
        importlib.import_module(module.name)
    classes = set(raised(BaseException))
    others = {one for one in classes if not issubclass(one, DiffdriveError)}
    assert {one.__name__ for one in others} == NOT_ERRORS
    assert not [one for one in others if issubclass(one, Exception)]
    assert len(classes - others) > 30
    assert all(one.__dict__['__doc__'] for one in classes)
    modules: dict[str, set[str]] = {}
    for one in classes:  # a module that a test imported again has its classes twice
        modules.setdefault(one.__name__, set()).add(one.__module__)
    assert not {name: where for name, where in modules.items() if len(where) > 1}


# --- Time


def test_durations_are_rounded_to_nanoseconds_and_only_zero_becomes_zero():
    cases = {1.0: NANOSECONDS, 0.1 + 0.2: 300_000_000, -1.5: -1_500_000_000, 0.0: 0}
    # A timeout of 0 means that there is none.
    cases |= {1e-12: 1, -5e-324: -1, 1e300: int(1e300) * NANOSECONDS}
    for duration, expected in cases.items():
        assert nanoseconds(duration) == expected
    stamp = 1_700_000_000 * NANOSECONDS
    assert nanoseconds(seconds(stamp)) == stamp
