"""Random damage of the bytes of bags and journals, and what is recovered and said of them.

The oracle: in bounded memory, whatever the damage, the old files stay as they are, what was written
before the damage is recovered, in its order, and nothing is called complete that lacks a message.
"""

from __future__ import annotations

import random
import shutil
from contextlib import suppress

import pytest
from rosbags.rosbag2 import CompressionMode
from support.raw_bags import (
    contents,
    data_file,
    make_messages,
    names_of,
    read_bag,
    recover,
    write_bag,
    write_journal,
)

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.bags import recover as write_recovered

pytestmark = pytest.mark.usefixtures('quick_disk', 'bounded_memory')

PAGE = 4096
"""Size of a page of SQLite (bytes)."""
CASES = 2
"""For each kind of file and of damage."""
SMALL, LARGE = make_messages(60, 400), make_messages(12, 20_000)
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


@pytest.fixture(scope='module', params=KINDS)
def whole(request, tmp_path_factory):
    """Path of a bag or journal, its messages, and whether their bytes are in the file as they are."""
    storage, mode, messages = KINDS[request.param]
    path = tmp_path_factory.mktemp('whole') / 'run'
    if storage in ('mcap', 'sqlite3'):
        write_bag(path, storage, messages, mode)
    else:
        journal = write_journal(path, messages)
        path = journal if storage == 'journal' else write_recovered(journal).bag
    return path, messages, mode in (None, CompressionMode.NONE)


# --- Damage at a place


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

# --- What must be left


def left_by(data, damaged, messages, how):
    """Return messages that the damage of a file leaves."""
    changed = {
        at // PAGE for at in range(0, len(data), PAGE) if data[at : at + PAGE] != damaged[at : at + PAGE]
    }
    if data.startswith(b'\x89MCAP'):
        start = min(changed, default=0) * PAGE
        blocks = zip(data[start:], damaged[start:], strict=False)
        first = start + next(
            (at for at, (one, other) in enumerate(blocks) if one != other),
            min(len(data), len(damaged)) - start,
        )
        return [one for one in messages if data.index(one[2]) + len(one[2]) <= first]
    # Where rows get new numbers, those of other pages may look like old copies.
    if how not in (cut, erase) or any(page * PAGE <= data.rindex(b'/odom') for page in changed):
        return []
    return [one for one in messages if not pages(data, one[2]) & changed]


def pages(data, content):
    """Return the pages that hold a message: parts of it are looked for in each."""
    parts = (content[at : at + 32] for at in (*range(0, len(content) - 32, 1000), len(content) - 32))
    return {data.index(part) // PAGE for part in parts if part in data}


def is_subset(some, messages):
    """Return whether some of the messages are only such, and in their order."""
    rest = iter(messages)
    return all(one in rest for one in some)


@pytest.mark.parametrize(
    'how',
    [cut, erase, flip_bits, overwrite, write_length, duplicate, reorder],
    ids=lambda one: one.__name__,
)
def test_damaged_bytes(whole, tmp_path, capsys, how):
    path, messages, plain = whole
    chance = random.Random(f'{path.suffix} {how.__name__}')
    for number in range(CASES):
        folder = tmp_path / str(number)
        folder.mkdir()
        old = (shutil.copytree if path.is_dir() else shutil.copyfile)(path, folder / path.name)
        file = data_file(old) if old.is_dir() else old
        data = file.read_bytes()
        damaged = bytearray(data)
        how(damaged, chance.choice((0, 8, len(data) - 1, *chance.sample(range(len(data)), 5))), chance)
        file.write_bytes(damaged)
        if old.is_dir() and number % 2:
            (old / 'metadata.yaml').unlink()
        given = file if chance.random() < 0.3 else old
        with pytest.raises(BagError) if how is cut else suppress(BagError):
            read_run(given)
        before = contents(file.parent)
        code, out, err = recover(capsys, given, '-o', folder / 'new')
        assert contents(file.parent) == before
        assert code in (0, 1, 3) or (code == 2 and 'is neither MCAP nor SQLite' in err)
        found = read_bag(folder / 'new') if code == 0 else []
        if code == 0:
            assert f'{len(found)} messages' in out
            assert err == ''
        if plain:
            assert (
                code == 3
                or 'is complete' in err
                or is_subset(left_by(data, damaged, messages, how), found)
            )
        if how is cut:
            assert is_subset(found, messages)
        if 'is complete' in err:
            assert read_bag(given) == messages
        elif code == 0 and 'lost: ' not in out and 'loss cannot be excluded: ' not in out:
            assert found == messages


def test_undamaged_files_without_metadata(whole, tmp_path, capsys):
    path, messages, _ = whole
    given = tmp_path / path.name
    if path.is_dir():
        given.mkdir()
        shutil.copy(data_file(path), given)
    else:
        shutil.copy(path, given)
    code, out, err = recover(capsys, given, '-o', tmp_path / 'new')
    assert (code, err) == (0, '')
    assert read_bag(tmp_path / 'new') == messages
    assert 'lost: ' not in out
    assert 'loss cannot be excluded: ' in out
    if path.is_dir():
        assert 'there is no valid metadata.yaml' in out
        assert names_of(tmp_path / 'new') == names_of(path)
