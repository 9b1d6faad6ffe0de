"""Bags whose text would execute something, whose paths lead elsewhere, or whose lengths are absurd."""

from __future__ import annotations

import os
import resource
import shutil
import struct
from contextlib import suppress

import pytest
from hostile_bags import METADATA, MIB, mcap, message, topic_records, write_folder
from rclpy.serialization import serialize_message
from support.bags import write_bag
from support.raw_bags import recover
from support.ros_messages import odometry

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.bags.bag_reader import find_damage
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.parameters.file import robot_parameters

GOOD = mcap(topic_records() + message(serialize_message(odometry(1.0, 0.0, 0.0))))
HEADROOM = 300 * MIB
TAGS = (
    '!!python/object/apply:os.system ["touch executed"]',
    '!!python/object/new:os.system ["touch executed"]',
    '!!python/name:os.system',
    '!!python/module:os',
    '!!js/function "touch"',
    '!!binary aGVsbG8=',
    '!<tag:example.com,2026:x> {a: 1}',
)


@pytest.fixture(autouse=True)
def bounded_memory():
    """Let this process take a few hundred megabytes more, and no more."""
    with open('/proc/self/statm') as file:
        now = int(file.read().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (now + HEADROOM, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def messages_of(path):
    """Return how many messages are read. None: it is refused in printable words."""
    try:
        return len(read_run(path).odometry)
    except BagError as error:
        said = str(error)
    assert said.isprintable()
    return None


# --- YAML


@pytest.mark.parametrize('tag', TAGS)
def test_nothing_in_yaml_is_executed(tmp_path, monkeypatch, capsys, tag):
    monkeypatch.chdir(tmp_path)
    path = write_folder(tmp_path / 'run', 'x.mcap', GOOD, more=f'  custom_data: {{key: {tag}}}\n')
    assert messages_of(path) in (1, None)
    recover(capsys, path)
    (tmp_path / 'params.yaml').write_text(f'virtual_robot:\n  ros__parameters:\n    x: {tag}\n')
    with suppress(UserError, ValueError):
        robot_parameters('params.yaml')
    assert 'executed' not in os.listdir(tmp_path)


# --- Paths


@pytest.mark.parametrize('mode', ['', 'FILE'])
@pytest.mark.parametrize('kind', ['above', 'absolute', 'through a link'])
def test_files_of_a_bag_are_in_its_folder(tmp_path, capsys, mode, kind):
    """Only the names in `relative_file_paths` count, so nothing elsewhere is read or written."""
    name = 'x.mcap.zstd' if mode else 'x.mcap'
    other = tmp_path / 'other'
    other.mkdir()
    (other / name).write_bytes(GOOD)
    listed = {'above': f'../other/{name}', 'absolute': str(other / name), 'through a link': f'a/{name}'}
    path = tmp_path / 'run'
    path.mkdir()
    (path / 'a').symlink_to('../other')
    text = METADATA.format(
        storage='mcap', compression='zstd' if mode else '', mode=mode, file=listed[kind], more=''
    )
    (path / 'metadata.yaml').write_text(text)
    before = sorted(tmp_path.rglob('*'))
    with pytest.raises(BagError, match=name):
        read_run(path)
    assert recover(capsys, path)[0] in (1, 2)
    assert sorted(tmp_path.rglob('*')) == before
    assert (other / name).read_bytes() == GOOD


# --- Lengths


@pytest.mark.parametrize(
    ('form', 'values'),
    [('<Q', (2**63 - 1, 2**63, 2**64 - 1)), ('<I', (2**31, 2**32 - 1)), ('<H', (2**16 - 1,))],
)
def test_absurd_lengths_in_mcap(tmp_path, form, values):
    """At every place of a small file: an error or a run, never much memory."""
    path = tmp_path / 'x.mcap'
    size = struct.calcsize(form)
    results = set()
    for at in range(8, len(GOOD) - size, 7):
        for value in values:
            data = bytearray(GOOD)
            struct.pack_into(form, data, at, value)
            path.write_bytes(data)
            results.add(messages_of(path))
            find_damage(path)
    assert {1, None} <= results


def test_absurd_lengths_in_sqlite(tmp_path):
    whole = write_bag(tmp_path / 'whole', [(1.0, '/odom', odometry(1.0, 0.0, 0.0))], storage='sqlite3')
    bag = shutil.copytree(whole, tmp_path / 'bag')
    (file,) = bag.glob('*.db3')
    content = file.read_bytes()
    pages = [at for at in range(0, len(content), 4096) if content[at : at + 4096].strip(b'\0')]
    results = set()
    # The header of the file, and those of all pages with their first cells.
    for at in [*range(16, 100, 5), *(page + offset for page in pages for offset in range(0, 16, 5))]:
        for value in (b'\xff' * 4, b'\x7f\xff\xff\xff', b'\x80\0\0\0'):
            file.write_bytes(content[:at] + value + content[at + 4 :])
            results.add(messages_of(bag))
    assert {1, None} <= results


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_bags_cut_off_anywhere(tmp_path, capsys, storage):
    whole = write_bag(tmp_path / 'whole', [(1.0, '/odom', odometry(1.0, 0.0, 0.0))], storage=storage)
    bag = shutil.copytree(whole, tmp_path / 'bag')
    (file,) = (one for one in bag.iterdir() if one.suffix != '.yaml')
    content = file.read_bytes()
    for end in range(0, len(content), max(1, len(content) // 20)):
        file.write_bytes(content[:end])
        assert messages_of(bag) is None
    assert recover(capsys, bag)[0] in (0, 1)
