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

"""A recorder that is killed while a robot drives, and what is lost of its recording."""

from __future__ import annotations

import signal
import time

from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import Message
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from support.raw_bags import read_bag, read_journal

LATCHED = 5
"""More messages than are latched."""
ALLOWED_LOSS = 1.0
"""Of a killed recorder (s)."""


class Control:
    """A robot, and a subscriber that hears its odometry beside the recorder."""

    def __init__(self, world):
        self.world, self.harness = world, world.harness
        self.heard = []
        profile = QoSProfile(depth=1000)
        self.harness.peer.create_subscription(Odometry, 'odom', self.heard.append, profile, raw=True)
        self.harness.add(VirtualRobot)
        self.harness.until(lambda: self.heard, 'the robot is heard')

    def record(self, bag):
        """Start to record; returns the recorder once messages are in its journal."""
        recorder = self.world.start('record_run', '-o', str(bag))
        # The first ones may be those that are latched.
        self.harness.until(lambda: recorded(bag) > LATCHED, 'odometry is recorded')
        return recorder

    def after(self, seconds):
        """Hear for so long."""
        end = time.monotonic() + seconds
        self.harness.until(lambda: time.monotonic() >= end)

    def lost(self, found, last):
        """Return how much is missing at the end of what was found (s), after a look at each message."""
        # What the recorder heard first comes here, too.
        self.harness.until(lambda: found[-1] in self.heard, 'the last message recorded is heard')
        place = {data: index for index, data in enumerate(self.heard)}
        numbers = [place[one] for one in found]
        assert numbers == list(range(numbers[0], numbers[0] + len(found)))
        return max(0.0, stamp(last) - stamp(found[-1]))


def recorded(bag):
    """Return the number of messages in a journal that may not be there yet."""
    path = journal_of(bag)
    found = read_journal(path) if path.exists() else ()
    return sum(isinstance(one, Message) for one in found)


def stamp(data):
    time = deserialize_message(data, Odometry).header.stamp
    return time.sec + time.nanosec * 1e-9


def odometry(bag):
    return [data for topic, _, data in read_bag(bag) if topic == '/odom']


def crash(control, bag, seconds, run):
    """Record for so long, kill the recorder and recover; return the loss (s) and how many are saved."""
    recorder = control.record(bag)
    control.after(seconds)
    recorder.signal(signal.SIGKILL)
    last = control.heard[-1]
    assert recorder.exit() == -signal.SIGKILL
    before = journal_of(bag).read_bytes()
    assert run(bag) == 0
    assert journal_of(bag).read_bytes() == before
    found = odometry(bag)
    return control.lost(found, last), len(found)
