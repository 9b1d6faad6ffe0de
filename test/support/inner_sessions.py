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

"""Sessions of pytest within a test: as a user of the package has them, in a directory of their own.

They run in this process, which costs a tenth of a process. pytester removes what they import from
`sys.modules`, so everything with C extensions, and what they share with the tests, is imported before.
Those of pybind11 cannot be imported twice.
"""

from __future__ import annotations

from textwrap import dedent

# Matplotlib imports it with the first contour.
import contourpy  # noqa: F401
import geometry_msgs.msg  # noqa: F401
import matplotlib.pyplot  # noqa: F401
import nav_msgs.msg  # noqa: F401
import rosidl_generator_py  # noqa: F401

import diffdrive_jacobian.nodes.go_to_goal
import diffdrive_jacobian.nodes.virtual_robot
import diffdrive_jacobian.testing.recorded_run  # noqa: F401

SETTING = """
    import pytest
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from diffdrive_jacobian.testing import LockstepError
"""
# Hypothesis would be imported for its report of each failure.
OPTIONS = (
    *('-p', 'no:hypothesispytest', '-p', 'no:xdist', '-p', 'no:cacheprovider'),
    *('-p', 'no:launch_testing'),
    *('-W', 'error', '-W', 'ignore::pytest.PytestAssertRewriteWarning'),
)


def draw_quickly(monkeypatch):
    """Replace the figure of a recorded run, which takes a second, by a file."""
    monkeypatch.setattr(
        'diffdrive_jacobian.testing.recorded_run.draw',
        lambda _, path: path.write_bytes(b'a figure') and '',
    )


def run_inner(pytester, tests, *options, **files):
    """Run tests, without any conftest.py; gives the result."""
    name = f'test_{len(list(pytester.path.glob("test_*.py")))}'
    pytester.makepyfile(**{name: dedent(SETTING) + dedent(tests)}, **files)
    return pytester.runpytest_inprocess(*OPTIONS, *options, f'{name}.py')
