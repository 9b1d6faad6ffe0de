"""record_run while the disk is full, slow, read-only or gone, and with few descriptors or little memory.

Whatever happens, each message that was recorded is in the bag, or in a journal from which recover_run
writes it, in the order in which it was sent, without a gap. If the bag is not complete, the exit code is
1, and the last line says why and where the messages are.
"""

from __future__ import annotations

import itertools
import os
import random
import resource
import shutil
import signal
import subprocess
import tempfile
import time
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from unittest import mock

from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from support import processes

from diffdrive_jacobian.bags.bag_reader import messages, open_bag
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools.recover_run import main as recover_run
from process_faults.outcome import Outcome, unexpected
from process_faults.worlds import quiet_world

SECONDS = 1.0
"""Longest time of a recording before and after a fault (s)."""
FAILING = """
import errno, os, threading
_write, _left = os.write, [{writes}]
def write(descriptor, data):
    if threading.current_thread().name == 'journal':
        _left[0] -= 1
        if _left[0] < 0:
            raise OSError(errno.{error}, os.strerror(errno.{error}))
    return _write(descriptor, data)
os.write = write
"""
"""The journal cannot be written any more after a number of writes."""
SLOW = """
import os, time
_write, _sync = os.write, os.fsync
def write(descriptor, data):
    time.sleep({seconds})
    return _write(descriptor, data)
def fsync(descriptor):
    time.sleep({seconds})
    return _sync(descriptor)
os.write, os.fsync = write, fsync
"""
"""Each write to the disk takes long."""


_numbers = itertools.count()


class Recording:
    """A recorder in a process, and what is sent to it."""

    def __init__(self, world, folder, prefix, chance):
        self.harness, self.chance = world.harness, chance
        self.bag = folder / 'run'
        # Another topic in each world: messages for the recorder before may still be under way.
        self.topic = f'/odom{next(_numbers)}'
        self.publisher = world.harness.peer.create_publisher(Odometry, self.topic, 2000)
        with mock.patch.object(processes, 'PROGRAM', prefix + processes.PROGRAM):
            self.child = world.start('record_run', self.topic, '-o', str(self.bag))
        self.sent = []
        self.harness.until(
            lambda: self.publisher.get_subscription_count() or not self.child.running, 'it records'
        )

    def send(self, seconds, size=400):
        """Send for so long, or until the recorder ends."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and self.child.running:
            for _ in range(5):
                data = serialize_message(Odometry(child_frame_id=os.urandom(size).hex()))
                self.sent.append(data)
                self.publisher.publish(data)
            self.harness.executor.spin_once(timeout_sec=0.01)

    def end(self):
        self.child.signal(signal.SIGINT)
        return self.child.exit()


# --- The faults


def full_disk(world, folder, chance):
    small, size = folder / 'small', chance.choice((1 << 18, 1 << 19, 1 << 20))
    small.mkdir()
    mount = ['mount', '-t', 'tmpfs', '-o', f'size={size}', 'none', str(small)]
    subprocess.run(mount, check=True, capture_output=True)
    try:
        made = Recording(world, small, '', chance)
        made.send(20.0)
        code = made.end()
        shutil.copytree(small, folder / 'copy')
    finally:
        subprocess.run(['umount', '--lazy', str(small)], check=True)
    made.bag = folder / 'copy' / 'run'
    return made, code


def failing(error):
    def run(world, folder, chance):
        prefix = FAILING.format(error=error, writes=chance.randrange(2, 12))
        made = Recording(world, folder, prefix.strip() + '\n', chance)
        made.send(10.0)
        return made, made.end()

    return run


def slow_disk(world, folder, chance):
    prefix = SLOW.format(seconds=chance.choice((0.05, 0.2, 0.4)))
    made = Recording(world, folder, prefix.strip() + '\n', chance)
    made.send(2 * SECONDS)
    return made, made.end()


def renamed_folder(world, folder, chance):
    place = folder / 'place'
    place.mkdir()
    made = Recording(world, place, '', chance)
    made.send(chance.uniform(0.4, SECONDS))
    place.rename(folder / 'renamed')
    made.send(SECONDS)
    code = made.end()
    made.bag = folder / 'renamed' / 'run.journal.mcap'
    return made, code


def limited(kind, limit):
    def run(world, folder, chance):
        made = Recording(world, folder, '', chance)
        made.send(chance.uniform(0.3, SECONDS))
        pid = made.child._process.pid
        value = limit(pid, chance)
        resource.prlimit(pid, kind, (value, value))
        made.send(SECONDS)
        return made, made.end()

    return run


def few_descriptors(pid, chance):
    return len(os.listdir(f'/proc/{pid}/fd')) + chance.choice((0, 0, 1, 2, 3, 5))


def little_memory(pid, chance):
    pages = int(Path(f'/proc/{pid}/statm').read_text().split()[0])
    return pages * resource.getpagesize() + chance.choice((0, 1 << 20, 8 << 20, 32 << 20))


def short_files(pid, chance):
    return chance.choice((1 << 18, 1 << 19, 1 << 20))


FAULTS = {
    'full disk': full_disk,
    'disk that becomes read-only': failing('EROFS'),
    'disk that fails': failing('EIO'),
    'exceeded quota': failing('EDQUOT'),
    'slow disk': slow_disk,
    'folder renamed': renamed_folder,
    'limit of the file size': limited(resource.RLIMIT_FSIZE, short_files),
    'few descriptors': limited(resource.RLIMIT_NOFILE, few_descriptors),
    'little memory': limited(resource.RLIMIT_AS, little_memory),
}


def read(bag):
    with open_bag(bag) as reader:
        return [bytes(data) for _, _, data in messages(reader, reader.connections)]


def check(fault, made, code, folder):
    """Return what broke the promise."""
    stderr, violations = made.child.stderr, []
    # What C++ code does without memory is not ours. It is as a crash then.
    killed = fault == 'little memory' and code < 0
    if code not in (0, 1) and not killed:
        violations.append(f'exit code {code}: {stderr[-300:]!r}')
    if (line := unexpected(stderr)) and not killed:
        violations.append(f'printed {line!r}: {stderr[-600:]!r}')
    if code == 1 and 'record_run: error: ' not in stderr.splitlines()[-1]:
        violations.append(f'the last line is {stderr.splitlines()[-1:]!r}')
    if list(made.bag.parent.glob('.*building*')):
        violations.append('the directory in which the bag was written is left')
    bag = made.bag
    if not bag.is_dir():
        bag = folder / 'recovered'
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as said:
            recovered = recover_run([str(made.bag), '-o', str(bag)], Signals())
        if recovered != 0:
            return [*violations, f'not recovered: {said.getvalue()!r}; recorder: {stderr[-300:]!r}']
    with open_bag(bag) as reader:
        found = [bytes(data) for _, _, data in messages(reader, reader.connections)]
    if not found:
        return [*violations, 'no message was saved']
    first = made.sent.index(found[0]) if found[0] in made.sent else -1
    if first < 0 or found != made.sent[first : first + len(found)]:
        violations.append('the messages are not those that were sent, without a gap')
    if code == 0 and len(found) < len(made.sent) - first:
        violations.append(f'exit code 0, but {len(made.sent) - first - len(found)} messages are missing')
    return violations


def run(count, seed=0):
    """Record so often under each fault."""
    chance = random.Random(seed)
    violations, codes = [], {fault: set() for fault in FAULTS}
    with tempfile.TemporaryDirectory(prefix='recording_') as name, quiet_world() as world:
        for index in range(count):
            for fault, inject in FAULTS.items():
                folder = Path(name) / f'{index}_{fault.replace(" ", "_")}'
                folder.mkdir()
                made, code = inject(world, folder, chance)
                violations += [f'{fault}: {one}' for one in check(fault, made, code, folder)]
                codes[fault].add(code)
                shutil.rmtree(folder)
    measured = ', '.join(f'{fault} {sorted(found)}' for fault, found in codes.items())
    return Outcome(count * len(FAULTS), violations, f'exit codes: {measured}')
