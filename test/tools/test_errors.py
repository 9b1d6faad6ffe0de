"""All errors of this package have one base class, and every name is that of one class."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

import pytest

import diffdrive_jacobian
from diffdrive_jacobian.bags.files import NotARegularFileError
from diffdrive_jacobian.errors import DiffdriveError

PACKAGE = diffdrive_jacobian.__name__
NOT_ERRORS = {'Stuck', 'StopShrinking', 'TaskNotEnded'}
"""They end the code of users or of Hypothesis, which catches Exception, and never leave the package."""


def raised(base: type[BaseException]) -> Iterator[type[BaseException]]:
    """Yield the exception classes of the package, whatever they derive from."""
    for one in base.__subclasses__():
        if one.__module__.partition('.')[0] == PACKAGE:
            yield one
        yield from raised(one)


@pytest.fixture(scope='module')
def classes() -> set[type[BaseException]]:
    for module in pkgutil.walk_packages(diffdrive_jacobian.__path__, f'{PACKAGE}.'):
        importlib.import_module(module.name)
    return set(raised(BaseException))


def test_every_error_has_the_base_class(classes):
    others = {one for one in classes if not issubclass(one, DiffdriveError)}
    assert {one.__name__ for one in others} == NOT_ERRORS
    assert not [one for one in others if issubclass(one, Exception)]
    assert len(classes - others) > 30


def test_every_name_is_that_of_one_class(classes):
    modules: dict[str, set[str]] = {}
    for one in classes:  # a module that a test imported again has its classes twice
        modules.setdefault(one.__name__, set()).add(one.__module__)
    assert not {name: where for name, where in modules.items() if len(where) > 1}


def test_every_error_has_a_docstring(classes):
    assert all(one.__dict__['__doc__'] for one in classes)


def test_a_builtin_base_keeps_its_meaning(tmp_path):
    assert issubclass(NotARegularFileError, OSError)
    error = NotARegularFileError(2, 'No such file', str(tmp_path))
    assert (error.errno, error.filename) == (2, str(tmp_path))
    with pytest.raises(OSError, match='must be'):
        raise NotARegularFileError('must be a regular file')
