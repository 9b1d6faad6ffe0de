"""record_run killed, and without room: recover_run gets all but the last moment, and nothing wrong."""

from __future__ import annotations

import os
import random
import resource
import signal

import pytest
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from support.crashes import ALLOWED_LOSS, Control, crash, odometry
from support.raw_bags import read_journal, recover

from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import Message

pytestmark = pytest.mark.process

NOTHING_TO_DO = 1
"""Exit code of recover_run for a complete bag."""


# --- Killed


def test_killed_while_it_records_or_makes_the_bag(world, tmp_path, capsys):
    control = Control(world)
    loss, _ = crash(control, tmp_path / 'run', 0.2, lambda path: recover(capsys, path)[0])
    assert loss <= ALLOWED_LOSS
    bag = tmp_path / 'complete'
    recorder = control.record(bag)
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
    child = world.start('record_run', '/odom', '-o', str(bag))
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
