"""record_run killed, and without room: recover_run gets all but the last moment, and nothing wrong."""

from __future__ import annotations

import os
import random
import resource
import signal
import time

import pytest
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from support.raw_bags import read_bag, read_journal, recover

from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import Message
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot

pytestmark = pytest.mark.process

STORAGES = ('mcap', 'sqlite3')
LATCHED = 5
"""More messages than are latched."""
ALLOWED_LOSS = 1.0
"""Of a killed recorder (s)."""
NOTHING_TO_DO = 3
"""Exit code of recover_run where nothing is missing, as far as SQLite shows."""


# --- Killed


class Control:
    """A robot, and a subscriber that hears its odometry beside the recorder."""

    def __init__(self, world):
        self.world, self.harness = world, world.harness
        self.heard = []
        profile = QoSProfile(depth=1000)
        self.harness.peer.create_subscription(Odometry, 'odom', self.heard.append, profile, raw=True)
        self.harness.add(VirtualRobot)
        self.harness.until(lambda: self.heard, 'the robot is heard')

    def record(self, bag, storage):
        """Start to record; returns the recorder once messages are in its journal."""
        recorder = self.world.start('record_run', '-o', str(bag), '-s', storage)
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


def crash(control, bag, storage, seconds, run):
    """Record for so long, kill the recorder and recover; return the loss (s) and how many are saved."""
    recorder = control.record(bag, storage)
    control.after(seconds)
    recorder.signal(signal.SIGKILL)
    last = control.heard[-1]
    assert recorder.exit() == -signal.SIGKILL
    before = journal_of(bag).read_bytes()
    assert run(bag) == 0
    assert journal_of(bag).read_bytes() == before
    found = odometry(bag)
    return control.lost(found, last), len(found)


def test_killed_while_it_records_or_makes_the_bag(world, tmp_path, capsys):
    """`benchmark/crash.py` kills it 20 times with each storage."""
    control = Control(world)
    loss, _ = crash(control, tmp_path / 'run', 'mcap', 0.2, lambda path: recover(capsys, path)[0])
    assert loss <= ALLOWED_LOSS
    bag = tmp_path / 'complete'
    recorder = control.record(bag, 'sqlite3')
    recorder.signal(signal.SIGINT)
    control.after(random.uniform(0.0, 0.1))
    recorder.signal(signal.SIGKILL)
    recorder.exit()
    # It appears whole or not at all; then its journal is there.
    expected = NOTHING_TO_DO if bag.exists() else 0
    assert recover(capsys, bag)[0] == expected
    found = odometry(bag)
    control.lost(found, found[-1])


# --- Files may not become larger

LARGEST = 1 << 19
"""Size of the largest file (bytes)."""


def test_a_disk_that_becomes_full(world, tmp_path, capsys):
    """The recorder ends with a clear line, and its journal's messages are in the new bag."""
    bag = tmp_path / 'run'
    child = world.start('record_run', '/odom', '-o', str(bag), '-s', 'mcap')
    child.until_says('recording to')
    resource.prlimit(child._process.pid, resource.RLIMIT_FSIZE, (LARGEST, LARGEST))
    publisher = world.harness.peer.create_publisher(Odometry, 'odom', 2000)
    world.harness.until(lambda: publisher.get_subscription_count() > 0, 'the recorder listens')
    sent = []

    def over():
        for _ in range(20):
            sent.append(serialize_message(Odometry(child_frame_id=os.urandom(400).hex())))
            publisher.publish(sent[-1])
        return not child.running

    world.harness.until(over, 'the recorder ends')
    assert child.exit() == 1
    assert 'Traceback' not in child.stderr
    assert 'record_run: error: ' in child.stderr.splitlines()[-1]
    if bag.exists():
        # Without the last records, which are not complete in the journal, it may just fit.
        bag.rename(tmp_path / 'fitted')
    before = journal_of(bag).read_bytes()
    kept = [one.data for one in read_journal(journal_of(bag)) if isinstance(one, Message)]
    # There is no room for the new bag: it says so, and the journal stays.
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST // 8, limits[1]))
    try:
        code, out, err = recover(capsys, bag)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (code, out) == (1, '')
    assert err.startswith('recover_run: error: no bag was written: ')
    assert journal_of(bag).read_bytes() == before
    assert not bag.exists()
    assert recover(capsys, bag)[0] == 0
    found = odometry(bag)
    assert found == kept
    first = sent.index(found[0])
    assert found == sent[first : first + len(found)]
