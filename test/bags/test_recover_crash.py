"""record_run killed, and on a full disk: recover_run gets all but the last moment, and nothing wrong."""

from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import time
from contextlib import contextmanager

import pytest
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from support.processes import open_world
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


@pytest.fixture
def world(tmp_path):
    (tmp_path / 'world').mkdir()
    with open_world(tmp_path / 'world') as made:
        yield made


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
    chance = random.Random(1)
    for storage in STORAGES:
        bag = tmp_path / storage
        seconds = chance.uniform(0.0, 0.5)
        loss, _ = crash(control, bag, storage, seconds, lambda path: recover(capsys, path)[0])
        assert loss <= ALLOWED_LOSS
        bag = tmp_path / f'{storage}_complete'
        recorder = control.record(bag, storage)
        recorder.signal(signal.SIGINT)
        control.after(chance.uniform(0.0, 0.2))
        recorder.signal(signal.SIGKILL)
        recorder.exit()
        # It appears whole or not at all; then its journal is there.
        complete = bag.exists()
        nothing_to_do = 1 if storage == 'mcap' else 3
        assert recover(capsys, bag)[0] == (nothing_to_do if complete else 0)
        found = odometry(bag)
        control.lost(found, found[-1])


# --- The disk is full


@contextmanager
def small_disk(folder, size):
    """Mount a file system of so many bytes."""
    folder.mkdir()
    command = ['mount', '-t', 'tmpfs', '-o', f'size={size}', 'none', str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip('needs the right to mount a small file system')
    try:
        yield folder
    finally:
        # sqlite3 may hold a file of it until the next collection of garbage.
        subprocess.run(['umount', '--lazy', str(folder)], check=True)


def flood(world, child):
    """Publish odometry until the child ends; return the messages."""
    publisher = world.harness.peer.create_publisher(Odometry, 'odom', 2000)
    world.harness.until(lambda: publisher.get_subscription_count() > 0, 'the recorder listens')
    sent = []

    def over():
        for _ in range(20):
            message = Odometry(child_frame_id=os.urandom(400).hex())
            sent.append(serialize_message(message))
            publisher.publish(sent[-1])
        return not child.running

    world.harness.until(over, 'the recorder ends')
    return sent


def assert_all_recovered(capsys, child, bag, target, sent):
    """It ended with a clear line, and its journal's messages are in the new bag."""
    assert child.exit() == 1
    assert 'Traceback' not in child.stderr
    assert 'record_run: error: ' in child.stderr.splitlines()[-1]
    kept = [one.data for one in read_journal(journal_of(bag)) if isinstance(one, Message)]
    assert kept
    assert recover(capsys, bag, '-o', target)[0] == 0
    found = odometry(target)
    assert found == kept
    first = sent.index(found[0])
    assert found == sent[first : first + len(found)]


def test_a_full_disk(world, tmp_path, capsys):
    with small_disk(tmp_path / 'small', 1 << 20) as folder:
        bag = folder / 'run'
        child = world.start('record_run', '/odom', '-o', str(bag), '-s', 'mcap')
        sent = flood(world, child)
        assert not bag.exists()
        assert_all_recovered(capsys, child, bag, tmp_path / 'new', sent)
        # There is no room for the new bag: it says so, and the journal stays.
        before = journal_of(bag).read_bytes()
        code, out, err = recover(capsys, bag)
        assert (code, out) == (1, '')
        assert err.startswith('recover_run: error: no bag was written: ')
        assert os.listdir(folder) == ['run.journal.mcap']
        assert journal_of(bag).read_bytes() == before


def test_a_limit_of_the_size_of_files(world, tmp_path, capsys):
    bag = tmp_path / 'run'
    child = world.start('record_run', '/odom', '-o', str(bag), '-s', 'sqlite3')
    child.until_says('recording to')
    resource.prlimit(child._process.pid, resource.RLIMIT_FSIZE, (1 << 19, 1 << 19))
    sent = flood(world, child)
    if bag.exists():
        # Without the journal's frame, the bag is smaller, and just fits.
        bag.rename(tmp_path / 'fitted')
    assert_all_recovered(capsys, child, bag, tmp_path / 'new', sent)
