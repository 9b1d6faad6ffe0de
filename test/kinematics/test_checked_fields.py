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

"""Values: fields declare their checks in annotations; arrays are compared and cannot be changed."""

from __future__ import annotations

import pickle
import re
from dataclasses import KW_ONLY, FrozenInstanceError, dataclass, field, replace
from functools import partial
from typing import Annotated, ClassVar

import numpy as np
import pytest

from diffdrive_jacobian.control import Arrival, StraightLine, VelocityLimits
from diffdrive_jacobian.kinematics.mobile_manipulator import MobileManipulator
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm
from diffdrive_jacobian.numerics import checks
from diffdrive_jacobian.numerics.checks import (
    Checked,
    Count,
    Name,
    Names,
    NotNegative,
    Positive,
    Probability,
    between,
    boolean,
    instance,
    integer,
    mapping,
    one_of,
    optional,
    sequence,
)
from diffdrive_jacobian.simulation import RobotModel


@dataclass(frozen=True)
class Base(Checked):
    topic: Name
    unit: ClassVar[str] = 'm'
    node: str = field(default='', kw_only=True)


@dataclass(frozen=True)
class Several(Base):
    speed: Positive = 1.0
    _: KW_ONLY
    count: Count = 2
    goals: Names = ('a',)
    pairs: Annotated[int | None, optional(partial(integer, low=4))] = None
    limits: VelocityLimits | None = None
    share: Probability = 0.5
    exact: bool = False
    free: object = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Slotted(Checked):
    y: NotNegative = 0.0


def test_fields_are_converted():
    value = Several('odom', np.float32(0.5), count=np.int64(3), goals=['b', 'c'], pairs=4)
    assert value == Several('odom', 0.5, count=3, goals=('b', 'c'), pairs=4)
    assert [type(value.speed), type(value.count)] == [float, int]


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'topic': ''}, "topic must be a string that is not empty, got ''"),
        ({'node': None}, 'node must be a string, got None'),
        ({'speed': 0}, 'speed must be positive and finite, got 0'),
        ({'speed': '1'}, "speed must be a number, got '1'"),
        ({'speed': np.ones(1)}, r'speed must be a single number, got shape \(1,\)'),
        ({'speed': 10**5000}, 'speed must be finite, got an object of class int'),
        ({'count': 1.0}, 'count must be an integer of at least 1, got 1.0'),
        ({'count': -(10**5000)}, 'count must be an integer of at least 1, got an object of class int'),
        ({'goals': 'odom'}, "goals must be a list or tuple of names, got 'odom'"),
        ({'goals': ['odom', '']}, r"goals must be a list or tuple of names, got \['odom', ''\]"),
        ({'limits': 1.0}, 'limits must be of class VelocityLimits, got 1.0'),
        ({'exact': 1}, 'exact must be True or False, got 1'),
        ({'share': 1.5}, r'share must be in \[0, 1\], got 1.5'),
        ({'pairs': 3}, 'pairs must be an integer of at least 4, got 3'),
    ],
)
def test_invalid_fields_are_named_also_of_a_base_class_and_in_a_copy(changes, message):
    for make in (partial(Several, topic='odom'), partial(replace, Several('odom'))):
        with pytest.raises(ValueError, match=f'^{message}'):
            make(**changes)


def test_a_dataclass_with_slots_has_no_dictionary_and_can_be_pickled():
    value = Slotted(y=1)
    assert not hasattr(value, '__dict__')
    assert pickle.loads(pickle.dumps(value)) == value
    with pytest.raises(ValueError, match='y must be zero or positive and finite, got inf'):
        Slotted(y=float('inf'))


def test_a_misspelt_type_is_a_mistake():
    @dataclass(frozen=True)
    class Misspelt(Checked):
        topic: Name
        speed: Positve  # noqa: F821

    with pytest.raises(TypeError, match=r'^Misspelt\.speed must have a type of its module: .*Positve'):
        Misspelt('odom', -1.0)


@pytest.mark.parametrize(
    ('check', 'valid', 'invalid', 'allowed'),
    [
        (between(0.0, 1.0), (0, 1.0, np.float32(0.5)), (-0.1, np.nan), 'in [0, 1]'),
        (between(0.0, 1.0), (), (True, '1'), 'a number'),
        (between(0.0, 1.0, above=0.0, unit='m'), (1e-300, 1), (0.0, 2), 'in (0, 1] m'),
        (between(0.1), (0.1, 1e300), (np.inf,), 'finite and at least 0.1'),
        (between(0, 2**63 - 1, above=3), (4,), (3,), 'in (3, 9223372036854775807]'),
        (boolean, (True, False), (1,), 'True or False'),
        (mapping, ({},), ([],), 'a map'),
        (sequence, ([],), ({},), 'a list'),
        (one_of('wheel', 'arm'), ('arm',), ('leg', 3), "one of 'wheel', 'arm'"),
        (one_of(), (), ('a',), 'one of (none)'),
        (partial(instance, wanted=int), (1,), ('a',), 'of class int'),
    ],
)
def test_checks_that_need_no_numpy(check, valid, invalid, allowed):
    for value in valid:
        assert check('x', value) == value
    for value in invalid:
        with pytest.raises(ValueError, match=f'^{re.escape(f"x must be {allowed}, got {value!r}")}$'):
            check('x', value)


def test_a_covariance_in_a_batch_is_compared_with_its_own_size():
    """Skewed by a ten thousandth, beside one that is a million times as large."""
    skewed = np.eye(3)
    skewed[0, 1] = 1e-4
    with pytest.raises(ValueError, match='symmetric and positive semidefinite, got'):
        checks.semidefinite('P', np.stack([1e6 * np.eye(3), skewed]))


# --- Values with arrays

CASES = [(VelocityLimits, 'max_v'), (Arrival, 'offset')]


@pytest.mark.parametrize(('cls', 'name'), CASES)
def test_values_with_arrays_are_equal_where_their_entries_are(cls, name):
    value = cls(**{name: [0.25, 0.0]})
    for same in (cls(**{name: (0.25, 0.0)}), cls(**{name: np.array([0.25, -0.0])})):
        assert (value, hash(value)) == (same, hash(same))
    for other in ([0.25, 0.75], [[0.25, 0.0]], [0.25], 0.25):
        assert value != cls(**{name: other})
    assert value != 0.25
    number, array = cls(**{name: 0.25}), cls(**{name: np.array(0.25)})
    assert (number, hash(number)) == (array, hash(array))


def test_the_limits_of_a_model_are_those_of_one_robot():
    with pytest.raises(ValueError, match=r'^limits must be numbers for one robot'):
        RobotModel(limits=VelocityLimits(max_v=[1.0, 2.0]))


@pytest.mark.parametrize(
    ('make', 'name'),
    [
        *CASES,
        (partial(StraightLine, end=[1.0, 0.0], speed=0.1), 'start'),
        (PlanarArm, 'lengths'),
        (partial(MobileManipulator, 0.033, 0.16, PlanarArm([0.2])), 'mount'),
    ],
)
def test_a_value_does_not_change_with_the_array_it_was_given(make, name):
    given = np.array([0.25, 0.5])
    # Its owner may write to it later.
    given.setflags(write=False)
    value = make(**{name: given})
    given.setflags(write=True)
    given[:] = 7.0
    assert getattr(value, name).tolist() == [0.25, 0.5]
    with pytest.raises(ValueError, match='read-only'):
        getattr(value, name)[0] = 7.0
    with pytest.raises(FrozenInstanceError):
        setattr(value, name, given)


def test_arrays_without_axes_are_numbers_and_durations_are_none():
    assert Slotted(y=np.array(0.5)).y == 0.5
    assert RobotModel(command_timeout=np.array(5)).command_timeout == 5
    for bad in (np.timedelta64(3, 'ns'), np.array(True), np.array('1')):
        with pytest.raises(ValueError, match='y must be a number'):
            Slotted(y=bad)
