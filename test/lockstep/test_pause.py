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

"""Stopping a world in a debugger, and taking one's time there."""

from __future__ import annotations

import bdb
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
from std_msgs.msg import Float64
from users_nodes import Blinker

from diffdrive_jacobian.lockstep import _guard
from diffdrive_jacobian.properties import FieldWithin
from diffdrive_jacobian.relations import Repeated, check_relation
from diffdrive_jacobian.testing import Lockstep, LockstepError, PropertyViolation

pytestmark = pytest.mark.slow


@pytest.fixture
def stops(monkeypatch):
    """Return the stops in a debugger that does what its `act` says."""

    class Stops(list):
        act = staticmethod(lambda world: None)

    found = Stops()

    def hook(header=''):
        world = sys._getframe(1).f_locals['world']
        found.append((world.world_seconds, header))
        found.act(world)

    monkeypatch.setattr(sys, 'breakpointhook', hook)
    return found


def test_a_world_stops_before_anything_happens_at_a_time(lockstep, stops):
    node = lockstep.create(lambda: Blinker(rate=10.0))
    lockstep.pause_at(0.3)
    lockstep.pause_at(0.55)
    stops.act = lambda world: ticks.append(len(node.ticks))
    ticks = []
    lockstep.run_until(lambda: lockstep.world_seconds >= 1.0, 2.0)
    assert [seconds for seconds, _ in stops] == pytest.approx([0.2, 0.5])
    assert stops[1][1].startswith('the world is paused at 0.5 s, before 0.6 s: world.step() goes on')
    assert ticks == [3, 6]
    assert len(node.ticks) == 11


def test_who_stops_may_step_publish_and_pass_the_end(lockstep, stops):
    node = lockstep.create(lambda: Blinker(rate=10.0))

    def act(world):
        world.step()
        assert len(node.ticks) == 4
        world.run_for(1.0)

    stops.act = act
    lockstep.pause_at(0.3)
    lockstep.run_for(0.5)
    assert lockstep.world_seconds == 1.3
    assert len(node.ticks) == 14


def test_a_violation_at_the_prompt_is_raised_there_and_afterwards(lockstep, stops):
    lockstep.create(lambda: Blinker(rate=10.0))
    lockstep.require(FieldWithin('blink', 'nanosec', 0.0, 2.5e8))

    def act(world):
        with pytest.raises(PropertyViolation):
            world.step()

    stops.act = act
    lockstep.pause_at(0.3)
    with pytest.raises(PropertyViolation, match='is violated at'):
        lockstep.run_for(1.0)
    assert len(stops) == 1


def test_debuggers_without_a_text_stop_too(lockstep, monkeypatch):
    calls = []

    def hook():
        calls.append(lockstep.world_seconds)

    monkeypatch.setattr(sys, 'breakpointhook', hook)
    lockstep.create(lambda: Blinker(rate=10.0))
    lockstep.pause_at(0.0)
    lockstep.run_for(0.5)
    assert calls == [0.0]


@pytest.mark.parametrize('seconds', [-1.0, float('nan'), 'soon', 0.1])
def test_a_pause_is_in_the_future(lockstep, seconds):
    lockstep.create(lambda: Blinker(rate=10.0))
    lockstep.run_for(0.2)
    with pytest.raises(ValueError, match='seconds must'):
        lockstep.pause_at(seconds)


def test_a_pause_that_never_came_is_told():
    world = Lockstep()
    world.pause_at(2.0)
    world.create(Blinker)
    world.run_for(0.5)
    with pytest.warns(UserWarning, match=r'pause_at\(2\): the world has ended at 0.5 s'):
        world.close()


def test_each_world_of_a_relation_stops(stops):
    def blinking(world, case):
        world.create(lambda: Blinker(rate=10.0))
        world.create(lambda: Blinker('other', rate=10.0))
        world.find('other').create_subscription(type(world.last('blink')), 'blink', lambda _: None, 10)
        world.run_for(0.5)

    with pytest.raises(LockstepError, match='no node has the topic /nothing'):
        check_relation(blinking, Repeated('nothing'), pause_at=0.2)
    check_relation(blinking, Repeated('blink'), pause_at=0.2)
    assert [header.partition(' is')[0] for _, header in stops] == [
        *('the first world', 'the first world'),
        "the image of Repeated('blink')",
    ]


class Sleeper(Blinker):
    """Takes its time in a callback."""

    def on_tick(self):
        super().on_tick()
        if len(self.ticks) == 3:
            time.sleep(1.2)


@pytest.mark.parametrize('how', ['not', 'paused before', 'in a debugger'])
def test_callbacks_have_a_limit_of_time_only_without_a_debugger(how, stops, monkeypatch):
    monkeypatch.setattr(_guard, 'debugger_is_active', lambda: how == 'in a debugger')
    with Lockstep(patience=0.5) as world:
        world.create(lambda: Sleeper(rate=10.0))
        if how == 'paused before':
            world.pause_at(0.1)
        if how == 'not':
            with pytest.raises(LockstepError, match='has not returned for'):
                world.run_for(0.5)
        else:
            world.run_for(0.5)


def test_a_debugger_is_noticed_while_it_follows(monkeypatch):
    """That pytest shows the prompt of pdb is shown by doc/debugging.md."""
    assert not _guard.debugger_is_active()
    monkeypatch.setattr(sys, 'gettrace', lambda: bdb.Bdb().trace_dispatch)
    assert _guard.debugger_is_active()


@pytest.mark.process
def test_a_process_may_take_its_time(lockstep, stops):
    """As one that a debugger stops. Without a pause that is an error."""
    program = [sys.executable, str(Path(__file__).with_name('external_nodes.py')), 'echo']
    lockstep.pause_at(0.1)
    process = lockstep.start(program, patience=1.0)
    process.signal(signal.SIGSTOP)
    goes_on = threading.Timer(2.5, process.signal, [signal.SIGCONT])
    goes_on.start()
    lockstep.publish('echo/in', Float64(data=2.0))
    goes_on.join()
    assert lockstep.last('echo/out').frame_id == '2'
    lockstep.run_for(0.2)
    assert f'pid {process.pid}: ' in stops[0][1]
