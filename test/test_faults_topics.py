"""Faults of topics, on nodes that know nothing of them: which messages arrive, and when."""

from __future__ import annotations

import pytest
from rclpy.node import Node
from std_msgs.msg import Int64

from diffdrive_jacobian.testing import LockstepError, faults

MILLISECOND = 1_000_000


class Counter(Node):
    """Publishes 0, 1, 2, ... every 100 ms, 0 when it is added."""

    def __init__(self):
        super().__init__('counter')
        self.publisher = self.create_publisher(Int64, 'count', 10)
        self.number = 0
        self.create_timer(0.1, self.on_tick)

    def on_tick(self):
        self.publisher.publish(Int64(data=self.number))
        self.number += 1


class Listener(Node):
    """Keeps what it receives, with the time of its clock since the start (ms)."""

    def __init__(self, name='listener'):
        super().__init__(name)
        self.received = []
        self.create_subscription(Int64, 'count', self.on_message, 10)

    def on_message(self, message):
        now = self.get_clock().now().nanoseconds
        self.received.append((message.data, (now - 1_000_000_000) / MILLISECOND))


def received(world, *injected, seconds=1.0, seed=0):
    """Return what a listener receives with faults: numbers and times (ms)."""
    listener = world.create(Listener)
    world.create(Counter)
    listener.received.clear()
    world.inject(*injected, seed=seed)
    world.run_for(seconds)
    return listener.received


def test_lost_messages_do_not_arrive(lockstep):
    got = received(lockstep, faults.Loss('count', start=0.25, duration=0.3))
    assert [number for number, _ in got] == [1, 2, 6, 7, 8, 9, 10]


def test_a_fault_that_met_nothing_is_an_error(lockstep):
    lockstep.create(Listener)
    lockstep.inject(faults.Loss('cuont'), faults.Loss('count'))
    with pytest.raises(LockstepError, match=r"Loss\('cuont'\): no subscription of /cuont was seen$"):
        lockstep.check_faults()
