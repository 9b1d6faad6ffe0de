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

"""Faults of the clock, of services and of publishers, and faults as values."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError, dataclass, fields, replace
from inspect import isabstract
from typing import get_origin

import numpy as np
import pytest
from faults_nodes import Relay, Sink, Source, whats
from std_srvs.srv import Trigger

from diffdrive_jacobian import faults
from diffdrive_jacobian.properties import end_of_faults
from diffdrive_jacobian.robot_testing.stopping import delays
from diffdrive_jacobian.testing import LockstepError

INF = float('inf')


# --- Clock


def test_the_clock_jumps_there_and_back_while_world_time_goes_on(lockstep):
    source, sink = lockstep.create(Source), lockstep.create(Sink)
    sink.received.clear()
    lockstep.inject(
        faults.TimeJump(5.0, start=0.35, duration=0.3), faults.ClockPause(start=0.8, duration=0.1)
    )
    lockstep.run_for(1.0)
    assert (lockstep.elapsed, lockstep.world_time, lockstep.now) == (0.9, 10**9, 1_900_000_000)
    assert sink.received[:4] == [(1, 100.0), (2, 200.0), (3, 300.0), (4, 5350.0)]
    assert sink.received[4:7] == [(5, 5400.0), (6, 5500.0), (7, 5600.0)]
    assert source.number > 7
    assert 'the clock has jumped by 5 s' in whats(lockstep)
    assert 'the clock has jumped by -5 s' in whats(lockstep)
    with pytest.raises(LockstepError, match='not within'):
        lockstep.run_until(lambda: False, timeout=0.5)
    assert lockstep.world_time == 1_500_000_000


def test_the_clock_stays_within_what_a_stamp_can_represent(lockstep):
    lockstep.inject(
        faults.TimeJump(-9.0, start=0.5, duration=0.25),
        faults.TimeJump(2147483647, start=1.0, duration=0.25),
    )
    lockstep.run_for(0.6)
    assert lockstep.now == 100_000_001
    lockstep.run_for(0.4)
    assert lockstep.now == (2**31 - 1) * 10**9
    lockstep.run_for(0.5)
    assert lockstep.now == 2_500_000_000
    with pytest.raises(ValueError, match=r'at most 2147483647 s, got 1e\+300 at 2.5 s'):
        lockstep.jump(1e300)


def test_a_clock_that_stands_stops_timers_but_not_messages(lockstep):
    source, sink = lockstep.create(Source), lockstep.create(Sink)
    sink.received.clear()
    lockstep.inject(
        faults.Delay('count', 0.25, start=0.25, duration=0.1),
        faults.ClockPause(start=0.35, duration=0.4),
    )
    arrived = []
    lockstep.run_until(lambda: arrived.append(lockstep.world_time) or len(sink.received) == 3, 0.6)
    assert arrived[-1] == 550_000_000
    assert sink.received[-1] == (3, 350.0)
    assert source.number == 4
    lockstep.run_for(0.45)
    assert sink.received[3:] == [(4, 400.0), (5, 500.0), (6, 600.0)]
    assert lockstep.now == 1_600_000_000


def test_step_goes_to_the_next_event_of_a_fault(lockstep):
    lockstep.inject(faults.ClockPause(start=0.3, duration=0.1))
    lockstep.step()
    lockstep.step()
    assert lockstep.world_time == 400_000_000
    with pytest.raises(LockstepError, match='no timer is running'):
        lockstep.step()


# --- Services


def test_a_service_responds_late_or_never(lockstep):
    relay = lockstep.create(Relay)
    lockstep.inject(
        faults.LateService('ask', 0.3, duration=0.5),
        faults.LateService('/ask', 0.2, duration=0.5),
        faults.LateService('ask', INF, start=1.0),
    )
    lockstep.call(Trigger, 'ask')
    assert lockstep.elapsed == 0.5
    assert relay.calls == [0.0]
    lockstep.call(Trigger, 'ask')
    assert lockstep.elapsed == 0.5
    lockstep.run_for(0.5)
    with pytest.raises(LockstepError, match='not within 10 s of simulated time: a response of /ask'):
        lockstep.call(Trigger, 'ask')
    assert relay.calls == [0.0, 500.0, 1000.0]
    assert 'a response is 0.3 s late' in whats(lockstep)
    assert 'a response is never sent' in whats(lockstep)


def test_the_response_of_a_service_that_is_gone_is_lost(lockstep):
    lockstep.create(Relay)
    client = lockstep.node.create_client(Trigger, 'ask')
    lockstep.inject(faults.LateService('ask', 0.3), faults.Kill('relay', start=0.2))
    future = client.call_async(Trigger.Request())
    lockstep.run_for(1.0)
    assert not future.done()


# --- As values

EXPRESSIONS = [
    "Loss('odom', probability=0.5, start=2.0, duration=1.0)",
    "Loss('odom', probability=0.5, burst=3, node='go_to_goal')",
    "Delay('odom', 0.2, spread=0.1, growth=0.01)",
    "Reorder('odom', 0.5, 0.1)",
    "Duplicate('odom')",
    "RateLimit('odom', 10.0)",
    "Stale('odom', start=1.5)",
    "Kill('virtual_robot', start=1.0, duration=2.0)",
    "Hang('virtual_robot')",
    "Slow('virtual_robot', 0.01)",
    "TimerJitter('virtual_robot', 0.005)",
    'TimeJump(-5.0)',
    'ClockPause(duration=2.0)',
    "LateService('reset', float('inf'))",
    "ParameterChange('go_to_goal', 'kp', 2.0)",
    "ParameterChange('go_to_goal', 'names', ('a',))",
    "Corrupt('odom', 'header.frame_id', 'nan', probability=0.5, start=2.0, node='robot')",
    "Corrupt('odom', 'header.frame_id', 'set', amount='map')",
    "Corrupt('odom', 'header.frame_id', 'scale', amount=2)",
    "DeadWheel('left', start=1.0)",
    "SaturatedWheel('right', 2.0, robot='/one/virtual_robot')",
    'ActuatorLag(0.1, duration=2.0)',
    'EncoderSteps(16)',
    'Slip()',
    'WrongGeometry(left_wheel_radius_multiplier=0.5)',
    'Push(dx=0.1, dtheta=-0.5, noticed=True)',
]


PUBLIC = {name: getattr(faults, name) for name in faults.__all__}


def test_faults_are_values_whose_short_expressions_make_them_again():
    kinds = set()
    for expression in EXPRESSIONS:
        fault = eval(expression, PUBLIC)
        kinds.add(type(fault))
        assert repr(fault) == expression
        assert fault == pickle.loads(pickle.dumps(fault)) == copy.deepcopy(fault)
        assert hash(fault) == hash(eval(expression, PUBLIC))
        assert fault.start == 9.0 or fault != replace(fault, start=9.0)
        assert fault.__doc__
        for one in fields(fault):
            with pytest.raises(FrozenInstanceError):
                setattr(fault, one.name, 1)
    # Numbers of NumPy become those of Python.
    number = faults.Corrupt('odom', 'x', 'offset', np.float64(0.5))
    assert repr(number) == "Corrupt('odom', 'x', 'offset', amount=0.5)"
    # Until Python 3.10 the alias `Filter` of a type is an instance of `type`, too.
    public = {kind for kind in PUBLIC.values() if isinstance(kind, type) and not get_origin(kind)}
    assert kinds == {kind for kind in public if issubclass(kind, faults.Fault) and not isabstract(kind)}


@pytest.mark.parametrize(
    ('kind', 'arguments', 'words'),
    [
        (faults.Loss, [''], 'topic must be a string that is not empty, got'),
        (faults.Loss, ['x-y'], "topic must be a name as ROS has them, got 'x-y': "),
        (faults.LateService, ['1x', 1.0], 'service must be a name'),
        (faults.Loss, ['a', 1.5], r'probability must be in \[0, 1\], got 1.5'),
        (faults.Loss, ['a', 'x'], 'probability must be a number'),
        (faults.Loss, ['a', 1.0, True], 'burst must be an integer'),
        (faults.Delay, ['a', float('nan')], 'seconds must be zero or positive'),
        (faults.Reorder, ['a', 0.5, 0.0], 'seconds must be positive'),
        (faults.Duplicate, ['a', 1.0, 1.5], 'copies'),
        (faults.RateLimit, ['a', 0], 'rate'),
        (faults.TimeJump, [0.0], 'seconds must not be zero'),
        (faults.LateService, ['a', 0.0], 'seconds must be positive'),
        (faults.ParameterChange, ['a', 'b', None], 'value must be a bool, int, float, str, or a'),
        (faults.ParameterChange, ['a', 'b', [1, 'x']], r"value .* got \[1, 'x'\]"),
        (faults.DeadWheel, ['front'], "wheel must be one of 'left', 'right', got 'front'"),
        (faults.SaturatedWheel, ['left', 0.0], 'max_velocity'),
        (faults.EncoderSteps, [10**10], 'from 1 to 1000000000'),
        (faults.Push, [float('nan')], 'dx must be finite'),
        (faults.Push, [0.0, 0.0, 0.0, 1], 'noticed must be True or False'),
        (faults.WrongGeometry, [1.0, 1.0, 0.0], 'wheel_separation_multiplier'),
        (faults.Corrupt, ['odom', 'x', 'broken'], "change must be one of 'nan', 'inf'"),
        (faults.Corrupt, ['odom', 'x', 'offset', INF - INF], 'amount'),
        (faults.Corrupt, ['odom', 'x', 'offset', True], 'must be a finite number, got True'),
        (faults.Corrupt, ['odom', 'x', 'set', INF], r"or a str \(for others there are 'nan', 'inf'"),
        (faults.Corrupt, ['odom', 'x', 'set', None], 'a bool or a str'),
        (faults.Corrupt, ['odom', 'x', 'nan', 2.0], "must not be given with change 'nan', got 2.0"),
        (faults.Corrupt, ['odom', '', 'nan'], 'field'),
    ],
)
def test_invalid_values_are_named(kind, arguments, words):
    with pytest.raises(ValueError, match=f'^{kind.__name__}: .*{words}'):
        kind(*arguments)


def test_invalid_keywords_are_named():
    for arguments, words in (
        ({'node': 3}, 'node must be a string, got 3'),
        ({'start': -1}, 'start must be zero or positive and finite, got -1'),
        ({'duration': 0.0}, 'duration must be positive, got 0'),
    ):
        with pytest.raises(ValueError, match=words):
            faults.Loss('a', **arguments)


# --- Faults of others


@dataclass(frozen=True, repr=False)
class Starved(faults.NodeFault):
    """Each callback takes simulated time, of which properties learn by the fault itself."""

    seconds: float

    def install(self, injection):
        gate, cost = injection.gate(self.node), round(self.seconds * 1e9)

        def begin():
            gate.slow(cost)
            injection.note('the CPU is busy')
            return lambda: gate.quicken(cost)

        injection.during(begin)

    @property
    def longest_delay(self):
        return self.seconds

    def reaction_delay(self, node, since, now):
        return 10.0 * self.seconds if self.overlap(since, now) > -self.seconds else 0.0


def test_a_fault_of_ones_own_says_itself_what_it_does(lockstep):
    source, sink = lockstep.create(Source), lockstep.create(Sink)
    fault = Starved('sink', 0.03, start=0.15, duration=0.3)
    lockstep.inject(fault)
    lockstep.run_for(0.6)
    assert whats(lockstep) == ['begins', 'the CPU is busy', 'ends']
    assert [number for number, _ in sink.received] == list(range(1, 7))
    assert end_of_faults(lockstep) == fault.end + 0.03
    assert delays(lockstep, sink, 0.2) == 0.3
    assert delays(lockstep, sink, 0.5) == 0.0
    assert delays(lockstep, source, 0.2) == 0.0
