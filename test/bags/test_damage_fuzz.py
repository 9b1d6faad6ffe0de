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

"""Random damage of bags and journals, and what is reported of it.

The oracle, whatever the damage: in bounded memory, reading and recovery end with a typed error or with
a run that can be used. The old files stay as they are. What was written before the damage is recovered,
in its order. Nothing is called complete that lacks a message. What recovery writes is complete.
"""

from __future__ import annotations

import random
import shutil
import sqlite3
from contextlib import closing, suppress

import pytest
from rosbags.rosbag2 import CompressionMode
from support.raw_bags import (
    contents,
    data_file,
    make_messages,
    names_of,
    read_bag,
    write_bag,
    write_journal,
)

from diffdrive_jacobian.bags import BagError, NotABagError, NothingToSaveError, read_run, recover
from diffdrive_jacobian.bags.files import MCAP_MAGIC
from diffdrive_jacobian.bags.recovery import Recovery, UncheckedError
from diffdrive_jacobian.bags.run import Run
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.bags.verification import verify
from diffdrive_jacobian.parameters.declaration import ParameterError

pytestmark = pytest.mark.usefixtures('quick_disk', 'bounded_memory')

TYPED = (BagError, NotABagError, NothingToSaveError, ParameterError)

# --- The oracle


def attempt(function, *arguments):
    """Return what a call returns, or its typed error. Other errors are failures."""
    try:
        return function(*arguments)
    except TYPED as error:
        return error


def check(given, new):
    """Read, use and recover what is damaged; return the run and the recovery, or errors instead."""
    run = attempt(read_run, given)
    if isinstance(run, Run):
        attempt(verify, run)
        attempt(timeline, run)
    folder = given if given.is_dir() else given.parent
    before = contents(folder)
    recovery = attempt(recover, given, new)
    assert contents(folder) == before
    if isinstance(recovery, Recovery):
        assert len(read_bag(new)) == recovery.summary.messages
    return run, recovery


def is_subset(some, messages):
    """Return whether some of the messages are only such, and in their order."""
    rest = iter(messages)
    return all(one in rest for one in some)


# --- Bytes

PAGE = 4096
"""Size of a page of SQLite (bytes)."""
SMALL, LARGE = make_messages(40, 400), make_messages(8, 20_000)
"""The large ones are in several pages of SQLite each."""
KINDS = {
    'mcap': ('mcap', CompressionMode.NONE, SMALL),
    'mcap, compressed chunks': ('mcap', CompressionMode.STORAGE, LARGE),
    'mcap, compressed messages': ('mcap', CompressionMode.MESSAGE, SMALL),
    'mcap with checksums': ('ours', None, SMALL),
    'journal': ('journal', None, SMALL),
    'sqlite3': ('sqlite3', CompressionMode.NONE, SMALL),
    'sqlite3, large messages': ('sqlite3', CompressionMode.NONE, LARGE),
    'sqlite3, compressed messages': ('sqlite3', CompressionMode.MESSAGE, LARGE),
}


@pytest.fixture(params=KINDS)
def whole(request, tmp_path):
    """Kind and path of a bag or journal, its messages, and whether their bytes are in the file."""
    storage, mode, messages = KINDS[request.param]
    path = tmp_path / 'whole' / 'run'
    path.parent.mkdir()
    if storage in ('mcap', 'sqlite3'):
        write_bag(path, storage, messages, mode)
    else:
        journal = write_journal(path, messages)
        path = journal if storage == 'journal' else recover(journal).bag
    return request.param, path, messages, mode in (None, CompressionMode.NONE)


def cut(data, at, chance):
    del data[at:]


def erase(data, at, chance):
    end = min(len(data), at + chance.choice((1, 30, 2048, PAGE)))
    data[at:end] = bytes(end - at)


def flip_bits(data, at, chance):
    for place in (at, *chance.sample(range(len(data)), chance.randrange(3))):
        data[place] ^= 1 << chance.randrange(8)


def overwrite(data, at, chance):
    # The first bytes describe the others.
    for place in (at, *chance.sample(range(len(data) // 4), chance.randrange(20))):
        data[place] = chance.randrange(256)


def write_length(data, at, chance):
    size, order = chance.choice((4, 8)), chance.choice(('little', 'big'))
    length = (1 << chance.choice((16, 8 * size - 1, 8 * size))) - chance.randrange(1, 3)
    data[at : at + size] = length.to_bytes(size, order)


def duplicate(data, at, chance):
    data[at:at] = data[at : at + chance.choice((100, PAGE))]


def reorder(data, at, chance):
    size = chance.choice((100, PAGE))
    one, other = (slice(place, place + size) for place in (at, chance.randrange(len(data))))
    data[one], data[other] = data[other], data[one]


DAMAGE = (cut, erase, flip_bits, overwrite, write_length, duplicate, reorder)


def left_by(data, file, messages):
    """Return messages that the damage of a file leaves; `data` was in it before."""
    if not data.startswith(MCAP_MAGIC):
        return [one for one in read_by_sqlite(file) if one in messages]
    damaged = file.read_bytes()
    pairs = enumerate(zip(data, damaged, strict=False))
    first = next((at for at, (one, other) in pairs if one != other), min(len(data), len(damaged)))
    return [one for one in messages if data.index(one[2]) + len(one[2]) <= first]


def read_by_sqlite(file):
    """Return topic, time and bytes of the messages that the library sqlite3 reads up to an error."""
    found = []
    with closing(sqlite3.connect(f'file:{file}?mode=ro', uri=True)) as database, suppress(sqlite3.Error):
        topics = dict(database.execute('SELECT id, name FROM topics'))
        for topic, stamp, content in database.execute('SELECT topic_id, timestamp, data FROM messages'):
            found.append((topics.get(topic), stamp, content))
    return found


def test_damaged_bytes(whole, tmp_path):
    kind, path, messages, plain = whole
    for number, how in enumerate(DAMAGE):
        chance = random.Random(f'{kind} {number}')
        folder = tmp_path / str(number)
        folder.mkdir()
        old = (shutil.copytree if path.is_dir() else shutil.copyfile)(path, folder / path.name)
        file = data_file(old) if old.is_dir() else old
        data = file.read_bytes()
        damaged = bytearray(data)
        how(damaged, chance.choice((0, 8, len(data) - 1, *chance.sample(range(len(data)), 5))), chance)
        file.write_bytes(damaged)
        if old.is_dir() and chance.random() < 0.5:
            (old / 'metadata.yaml').unlink()
        given = file if chance.random() < 0.3 else old
        run, recovery = check(given, folder / 'new')
        saved = isinstance(recovery, Recovery)
        found = read_bag(folder / 'new') if saved else []
        complete = 'is complete' in str(recovery)
        if how is cut:
            assert isinstance(run, BagError)
            assert is_subset(found, messages)
        if plain and not complete and not isinstance(recovery, UncheckedError):
            assert is_subset(left_by(data, file, messages), found)
        if complete:
            assert read_bag(given) == messages
        elif saved and not recovery.lost and not recovery.unchecked:
            assert found == messages


def test_undamaged_files_without_metadata(whole, tmp_path):
    _, path, messages, _ = whole
    given = tmp_path / path.name
    if path.is_dir():
        given.mkdir()
    shutil.copy(data_file(path) if path.is_dir() else path, given)
    recovery = recover(given, tmp_path / 'new')
    assert read_bag(tmp_path / 'new') == messages
    assert recovery.lost == ()
    assert recovery.unchecked
    if path.is_dir():
        assert any('there is no valid metadata.yaml' in one for one in recovery.unchecked)
        assert names_of(tmp_path / 'new') == names_of(path)
