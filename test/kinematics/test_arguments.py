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

"""The contract of the public functions of kinematics, control and simulation for their arguments.

A bad argument is a ValueError that names it, for one robot and for a batch. Other arguments give finite
results, and a batch gives what its robots give alone. What the decorator of equations does for all of
them, test_formula.py shows.
"""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from public_calls import BROADCASTING, CALLS, FIXED, POSE, WHEELS

from diffdrive_jacobian import control, kinematics, simulation
from diffdrive_jacobian.control import Arrival, VelocityLimits
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics import (
    spatial,
)
from diffdrive_jacobian.simulation.closed_loop import Outcomes

OPTIONAL = {
    *('h', 'arrival', 'progress', 'commanded_at', 'seed', 'drift', 'threshold', 'q_dot_0'),
    *('weights', 'max_velocity', 'max_correction'),
}
"""Arguments that may be None."""
NOT_NUMBERS = (None, 'text', 1j, object(), [1.0, [2.0, 3.0]], 10**400)
EXTREME = (1e308, -1e200, 1e154, 1e-160, 5e-324, 0.0, -1.0, 10**30)
WRONG_SHAPES = ([], [1.0] * 5, np.zeros((2, 2)), np.zeros((0, 3)), np.zeros((7, 4, 4)))
UNLIMITED = {'max_velocity', 'max_correction', 'trans_stopped_velocity', 'rot_stopped_velocity'}
"""Limits that may be infinite: none."""
INFINITE = {iv.force_ellipsoid, iv.condition_number}
"""Functions that return infinity for a singular matrix."""
DIGITS = 16
"""Units in the last place of the largest entry: functions of NumPy may differ from those of `math`."""


def name_of(call):
    return getattr(call, '__qualname__', call)


def every(calls):
    return pytest.mark.parametrize('call', calls, ids=name_of)


def parts(result):
    return result if isinstance(result, tuple) else (result,)


def outcome(call, arguments):
    """Return the parts of the result, or the text of the error up to the value."""
    try:
        return parts(call(**arguments)), ''
    except ValueError as error:
        return (), str(error).partition(' got ')[0]


def with_bad_argument(call, values):
    """Yield each argument that is a number or array, with each of these values as its last entry."""
    for name, valid in CALLS[call].items():
        if isinstance(valid, (int, float, tuple, list, np.ndarray)) and name != 'tasks':
            for value in values:
                entries = np.array(valid, dtype=object)
                entries[(-1,) * entries.ndim] = value
                yield name, value, entries.tolist()


def names(error, *allowed):
    return re.search(rf'\b({"|".join(allowed)})\b', error)


def assert_named(call, name, bad):
    """Require an error that names the argument, also for a batch."""
    _, error = outcome(call, CALLS[call] | {name: bad})
    assert names(error, name, name.removesuffix('s')), (name, error)
    if call in BROADCASTING and name not in FIXED:
        batch = {key: arg if key in FIXED else [arg] for key, arg in CALLS[call].items()}
        assert outcome(call, batch | {name: [bad]})[1] == error, (name, bad)


def numbers(result):
    """Yield every number of a result; NaN is allowed as the time of a robot that has not arrived."""
    if isinstance(result, Outcomes):
        assert np.all(np.isnan(result.time) == ~result.arrived)
        result = result._replace(time=np.nan_to_num(result.time))
    if isinstance(result, (VelocityLimits, Arrival, simulation.Actuators)):
        return  # infinite limits mean none
    if dataclasses.is_dataclass(result):
        result = [getattr(result, field.name) for field in dataclasses.fields(result)]
    if isinstance(result, (tuple, list)):
        for entry in result:
            yield from numbers(entry)
    elif isinstance(result, (bool, int, float, np.ndarray, np.generic)):
        yield from np.ravel(result).tolist()


def assert_named_or_finite(call, name, bad):
    """Require finite results, or an error that names an argument."""
    result, error = outcome(call, CALLS[call] | {name: bad})
    if error:
        # That shapes differ is the fault of either. Some functions have a matrix J as an argument.
        assert names(error, *CALLS[call], 'J', 'q'), (name, bad, error)
    elif call not in INFINITE:
        assert all(map(np.isfinite, numbers(result))), (name, bad)


def test_every_equation_is_called_here():
    modules = [control, *(getattr(kinematics, name) for name in kinematics.__all__)]
    public = [vars(module)[name] for module in modules for name in module.__all__]
    assert {function for function in public if hasattr(function, 'formula')} <= {*CALLS}


@every(CALLS)
def test_what_is_no_finite_number_is_named(call):
    for name in {*CALLS[call]} - {'jacobian'}:
        for value in NOT_NUMBERS:
            optional = name in OPTIONAL or (call is control.saturate and name in WHEELS)
            function = callable(value) and name in ('law', 'progress')
            if not function and not (value is None and optional):
                assert_named(call, name, value)
    for name, value, bad in with_bad_argument(call, (np.nan, np.inf, -np.inf)):
        if np.isinf(value) and (call is VelocityLimits or name in UNLIMITED):
            assert_named_or_finite(call, name, bad)
        else:
            assert_named(call, name, bad)


@every(CALLS)
def test_other_shapes_and_extreme_numbers_are_named_or_give_finite_results(call):
    for name in {*CALLS[call]} - {'jacobian'}:
        for wrong in WRONG_SHAPES:
            assert_named_or_finite(call, name, wrong)
    for name, _, bad in with_bad_argument(call, EXTREME):
        assert_named_or_finite(call, name, bad)


@every(BROADCASTING)
def test_a_batch_gives_what_its_robots_give_alone(call):
    """Each argument in turn has an axis of its own."""
    fixed = {name: value for name, value in BROADCASTING[call].items() if name in FIXED}
    arrays = {name: np.array(value) for name, value in BROADCASTING[call].items() if name not in FIXED}
    rng = np.random.default_rng(13)
    for name in arrays:
        batch = {}
        for key, value in arrays.items():
            lead = (3, 2) if len(arrays) == 1 else (3, 1) if key == name else (2,)
            # Matrices are rigid motions.
            noise = 0.0 if call in (spatial.spatial_displacement, spatial.pose_vector) else 0.01
            batch[key] = value * (1.0 + noise * rng.random((*lead, *[1] * value.ndim)))
        together = parts(call(**batch, **fixed))
        for index in np.ndindex(3, 2):
            rows = {
                key: np.broadcast_to(value, (3, 2, *arrays[key].shape))[index]
                for key, value in batch.items()
            }
            for one, many in zip(parts(call(**rows, **fixed)), together, strict=True):
                assert np.shape(many) == (3, 2, *np.shape(one))
                most = DIGITS * np.spacing(np.abs(np.asarray(one, dtype=np.float64)).max())
                np.testing.assert_allclose(many[index], one, rtol=0.0, atol=most)
        if len(arrays) > 1:
            apart = {key: np.stack([array] * (2 if key == name else 3)) for key, array in arrays.items()}
            error = outcome(call, apart | fixed)[1]
            assert names(error, name), error


def test_an_argument_of_another_name_is_told_which_there_are():
    """As of the parameter kp of the node."""
    words = "go_to_goal: .*'K.'.*; it takes state, goal, Kp and Kv"
    with pytest.raises(TypeError, match=words):
        control.go_to_goal(POSE, (1.0, 2.0), kp=3.0, kv=0.5)
