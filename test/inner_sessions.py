"""Sessions of pytest within a test: as a user of the package has them, in a directory of their own.

They run in this process, which costs a tenth of a process. pytester removes what they import from
`sys.modules`, so what they share with the tests is imported before, and C extensions are put back: many
cannot be imported twice.
"""

from __future__ import annotations

import sys
from importlib.machinery import ExtensionFileLoader
from textwrap import dedent

import geometry_msgs.msg  # noqa: F401
import matplotlib.backends.backend_agg  # noqa: F401
import nav_msgs.msg  # noqa: F401
import rosidl_generator_py  # noqa: F401

import diffdrive_jacobian.nodes.go_to_goal
import diffdrive_jacobian.testing.golden_run
import diffdrive_jacobian.testing.robot_at  # noqa: F401

SETTING = """
    import pytest
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from diffdrive_jacobian.testing import LockstepError
"""
# Hypothesis would be imported for its report of each failure.
OPTIONS = (
    *('-p', 'no:hypothesispytest', '-p', 'no:xdist', '-p', 'no:cacheprovider'),
    *('-W', 'error', '-W', 'ignore::pytest.PytestAssertRewriteWarning'),
)


def draw_quickly(monkeypatch):
    """Replace the figure of a recorded run, which takes a second, by a file."""
    monkeypatch.setattr('diffdrive_jacobian.testing.recorded_run.read_run', lambda bag: bag)
    monkeypatch.setattr(
        'diffdrive_jacobian.testing.recorded_run.draw', lambda _, path: path.write_bytes(b'a figure')
    )


class Extensions(dict):
    """The C extensions that are loaded at the end of a session. A plugin of pytest."""

    def pytest_unconfigure(self):
        for name, module in list(sys.modules.items()):
            spec = getattr(module, '__spec__', None)
            if isinstance(getattr(spec, 'loader', None), ExtensionFileLoader):
                self[name] = module


def run_in_process(pytester, *arguments):
    """Run a session; gives the result."""
    extensions = Extensions()
    result = pytester.runpytest_inprocess(*arguments, plugins=[extensions])
    assert extensions
    for name, module in extensions.items():
        sys.modules.setdefault(name, module)
    return result


def run_inner(pytester, tests, *options, **files):
    """Run tests, without any conftest.py; gives the result."""
    name = f'test_{len(list(pytester.path.glob("test_*.py")))}'
    pytester.makepyfile(**{name: dedent(SETTING) + dedent(tests)}, **files)
    return run_in_process(pytester, *OPTIONS, *options, f'{name}.py')
