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

"""`check_repeats` compares the messages of several runs, and names the first that differs."""

from __future__ import annotations

import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from diffdrive_jacobian.testing import LockstepError, check_repeats


def publishing(*runs):
    """Return a run that publishes other values on /value each time, one a second."""
    values = iter(runs)

    def run(world):
        publisher = world.node.create_publisher(Float64, 'value', 10)
        for value in next(values):
            publisher.publish(Float64(data=value))
            world.run_for(1.0)

    return run


def test_runs_that_are_equal_pass():
    check_repeats(publishing([1.0, 2.0], [1.0, 2.0], [1.0, 2.0]), runs=3)


@pytest.mark.parametrize(
    ('again', 'words'),
    [
        (
            [0.0, 2.0],
            r'run 2 differs from run 1, first in message 2: /value at 2 s: Float64\(data=2\) .*'
            r'instead of /value at 2 s: Float64\(data=1\)',
        ),
        ([0.0, 1.0, 1.0], '/value at 3 s: .* instead of none'),
    ],
)
def test_the_first_message_that_differs_is_named(again, words):
    with pytest.raises(LockstepError, match=words):
        check_repeats(publishing([0.0, 1.0], again))
    check_repeats(publishing([0.0, 1.0], again), without=['/value'])


def test_large_arrays_are_compared_to_the_last_element():
    last = iter([0, 7])

    def run(world):
        publisher = world.node.create_publisher(Image, 'image', 1)
        publisher.publish(Image(data=bytes(1_000_000) + bytes([next(last)])))

    with pytest.raises(LockstepError, match='first in message 1: /image'):
        check_repeats(run)


@pytest.mark.parametrize(
    ('wrong', 'words'),
    [
        ({'runs': 1}, 'runs must be an integer of at least 2'),
        ({'without': '/value'}, 'without must be names of topics'),
        ({'without': ['value']}, 'without must be names of topics'),
        ({'without': [1]}, 'without must be names of topics'),
    ],
)
def test_invalid_arguments_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        check_repeats(lambda world: None, **wrong)
