"""The journal: what was written comes back, and what was cut or damaged is never taken for whole."""

from __future__ import annotations

import tempfile
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.raw_bags import LATCHED, mcap_records

from diffdrive_jacobian.bags import journal, mcap
from diffdrive_jacobian.bags.bounded_reader import parse_bounded_qos
from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import Channel, JournalWriter, Message, Text
from diffdrive_jacobian.bags.salvage import Topic, read_mcap

pytestmark = pytest.mark.usefixtures('quick_disk')

CHANNELS = range(3)
MESSAGES = st.builds(
    Message, st.sampled_from(CHANNELS), st.integers(0, 2**63 - 1), st.binary(max_size=60)
)
TEXTS = st.builds(Text, st.text(), st.text())


def described(number, depth=10):
    return Channel(
        id=number,
        topic=f'/topic_{number}',
        type_name='a_msgs/msg/A',
        definition='int32 a\n',
        type_hash='RIHS01_0',
        qos=(LATCHED._replace(depth=depth),),
    )


NEW_PROFILES = st.builds(described, st.sampled_from(CHANNELS), st.integers(0, 1000))
FLUSHES = st.lists(st.lists(MESSAGES | TEXTS | NEW_PROFILES, max_size=6), max_size=4)
quickly = settings(deadline=None, max_examples=20)


def written(flushes):
    """Return the journal of these records, flushed after each list, and its size after each flush."""
    with tempfile.TemporaryDirectory() as folder:
        with closing(JournalWriter(journal_of(Path(folder, 'x')))) as writer:
            sizes = []
            for records in ([described(number) for number in CHANNELS], *flushes):
                for record in records:
                    writer.add(record)
                writer.flush()
                sizes.append(writer.size)
            assert writer.waiting == 0
        data = writer.path.read_bytes()
        assert len(data) == sizes[-1]
        return data, sizes


def read(data):
    """Return its records, with the numbers of channels that it was written with, and what is lost."""
    lost, names, records = [], {}, []
    for found in read_mcap(BytesIO(data), lost.append, lambda doubt: None):
        if isinstance(found, Topic):
            names[found.id] = int(found.name[-1])
        elif isinstance(found, Message):
            records.append(Message(names[found.channel], found.stamp, found.data))
        else:
            records.append(found)
    return records, lost


def expected(flushes):
    """Return what is read of these records: custom data come before the messages of their flush."""
    found = []
    for records in flushes:
        found += [one for one in records if isinstance(one, Text)]
        found += [one for one in records if isinstance(one, Message)]
    return found


@quickly
@given(FLUSHES, st.data())
def test_a_cut_at_any_byte_leaves_the_records_before_it(flushes, data):
    whole, sizes = written(flushes)
    assert read(whole) == (expected(flushes), [])
    before = data.draw(st.integers(0, len(flushes)))
    cut = data.draw(st.integers(sizes[before], len(whole)))
    left, lost = read(whole[:cut])
    assert left == expected(flushes)[: len(left)]
    assert len(left) >= len(expected(flushes[:before]))
    assert lost or left == expected(flushes) or cut in [end for *_, end in mcap_records(whole)]


@settings(deadline=None, max_examples=40)
@given(FLUSHES, st.data())
def test_a_flipped_bit_is_noticed(flushes, data):
    damaged = bytearray(written(flushes)[0])
    place = data.draw(st.integers(len(mcap.MAGIC), len(damaged) - 1))
    damaged[place] ^= 1 << data.draw(st.integers(0, 7))
    # The name or the number of a topic may be damaged, so that `read` does not know it.
    with suppress(KeyError, ValueError):
        left, lost = read(bytes(damaged))
        # In the header of the file, and in the times of a chunk, it does not matter.
        assert lost or left == expected(flushes)


@quickly
@given(st.lists(st.lists(MESSAGES, min_size=1, max_size=4), min_size=2, max_size=5), st.data())
def test_a_chunk_that_is_missing_is_noticed(flushes, data):
    whole, sizes = written(flushes)
    missing = data.draw(st.integers(0, len(flushes) - 2))
    left, lost = read(whole[: sizes[missing]] + whole[sizes[missing + 1] :])
    assert left == expected(flushes[:missing] + flushes[missing + 1 :])
    count = sum(map(len, flushes))
    assert lost == [f'its messages have the numbers 1 to {count}, {len(left)} were found']


def test_a_length_beyond_the_end_asks_for_no_memory():
    data, _ = written([])
    for length in (2**40, 2**64 - 1):
        left, lost = read(data + mcap.HEAD.pack(mcap.CHUNK, length) + b'xyz')
        assert left == []
        assert f'it is cut off: the last 12 of its {len(data) + 12} bytes' in lost[-1]


def test_a_large_message_has_a_chunk_of_its_own(monkeypatch):
    """A reader that refuses it still reads the others."""
    monkeypatch.setattr(journal, 'BLOCK', 1000)
    messages = [Message(0, 1, bytes(size)) for size in (10, 2000, 10, 600, 600, 10)]
    data, _ = written([[*messages[:2], described(0, depth=7), *messages[2:]]])
    assert read(data) == (messages, [])
    sizes = [round(end - start, -2) for opcode, start, end in mcap_records(data) if opcode == mcap.CHUNK]
    assert sizes[1:] == [100, 2100, 1200, 700]


def test_profiles_that_are_offered_later_are_those_of_the_same_topic():
    data, _ = written([[Message(0, 1, b'a'), described(0, depth=7), Message(0, 2, b'b')]])
    found = list(read_mcap(BytesIO(data), pytest.fail, lambda doubt: None))
    topics = [one for one in found if isinstance(one, Topic) and one.name == '/topic_0']
    assert len({one.id for one in topics}) == len(topics) == 2
    profiles = [parse_bounded_qos(one.qos) for one in topics]
    assert profiles == [[LATCHED._replace(depth=depth)] for depth in (10, 7)]
    assert [one.channel for one in found if isinstance(one, Message)] == [one.id for one in topics]


def test_other_tools_read_it():
    reader = pytest.importorskip('mcap.reader')
    from mcap.exceptions import EndOfFile

    texts = [Text('parameters of /robot', '{"kp": 3.0}')]
    messages = [Message(number % 3, 10**18 + number, bytes([number])) for number in range(9)]
    data, _ = written([messages[:5], [*texts, *messages[5:]]])
    found = []
    read_messages = reader.NonSeekingReader(BytesIO(data), validate_crcs=True).iter_messages
    # It has no end.
    with suppress(EndOfFile):
        for schema, channel, message in read_messages(log_time_order=False):
            found.append((schema.name, channel.topic, message.log_time, message.data))
    assert found == [('a_msgs/msg/A', f'/topic_{one.channel}', one.stamp, one.data) for one in messages]


def test_a_journal_is_never_overwritten(tmp_path):
    path = tmp_path / 'x.journal.mcap'
    path.write_bytes(b'dear')
    with pytest.raises(FileExistsError):
        JournalWriter(path)
    assert path.read_bytes() == b'dear'
