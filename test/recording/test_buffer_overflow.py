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

"""Overflow of the buffers of sockets: as the kernel counts it, or by the volume of what came at once."""

from __future__ import annotations

import os
import socket
import sys

import pytest

from diffdrive_jacobian.recording import overflow
from diffdrive_jacobian.recording.overflow import Overflow

MILLISECOND = 10**6


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(('127.0.0.1', 0))
        yield one


def flood(receiver, count=2000):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(count):
            sender.sendto(bytes(500), receiver.getsockname())


@pytest.mark.skipif(not sys.platform.startswith('linux'), reason='only Linux counts them')
def test_the_kernel_counts_what_it_drops(receiver):
    watched = Overflow(counted=True)
    flood(receiver, 10)
    watched.look()
    assert watched.last == 0
    begun = overflow.time.time_ns()
    flood(receiver)
    watched.received(10**9, begun)
    assert watched.dropped(begun, begun + 10**10)
    assert not watched.dropped(watched.last + 1, watched.last + 10**10)
    assert not watched.dropped(begun - 10**10, begun)
    opened = len(os.listdir('/proc/self/fd'))
    watched.close()
    assert len(os.listdir('/proc/self/fd')) < opened
    watched.look()
    assert watched.last < overflow.time.time_ns()


def test_a_burst_that_nobody_counts_is_an_overflow(receiver):
    watched = Overflow(counted=False)
    flood(receiver)
    watched.look()
    size = overflow.BURST_VOLUME // 4
    for number in range(8):
        watched.received(size, 20 * MILLISECOND * number)
    assert watched.last == 0
    for number in range(4):
        watched.received(size, 1000 * MILLISECOND + number)
    assert watched.last == 1000 * MILLISECOND + 3


def test_a_process_that_was_held_may_have_missed_something(monkeypatch):
    now = 10**18
    monkeypatch.setattr(overflow.time, 'time_ns', lambda: now)
    watched = Overflow(counted=False)
    for step in (1, 200, 300):
        now += step * MILLISECOND
        watched.look()
    assert not watched.held(0, now)
    before = now
    now += 400 * MILLISECOND
    watched.look()
    assert watched.held(before, before)
    assert watched.held(now, now)
    assert not watched.held(now + 1, now + 10**10)
    assert watched.last == 0


def test_the_history_is_ascending_and_bounded_in_its_rate():
    times = overflow._Times()
    for stamp in (1000, 1004, 990, 10**9, 10**9 - 5):
        times.add(stamp * MILLISECOND)
    assert [*times.times] == sorted(times.times)
    assert times.within(10**9 * MILLISECOND, 10**9 * MILLISECOND)
    assert not times.within(980 * MILLISECOND, 995 * MILLISECOND)
    watched = Overflow(counted=False)
    for number in range(1000):
        watched.received(2 * overflow.BURST_VOLUME, number * MILLISECOND // 100)
    assert len(watched._drops.times) <= 21
