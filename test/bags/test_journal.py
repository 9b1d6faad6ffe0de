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

"""The journal: what was written comes back, and what was cut or damaged is never taken for whole."""

from __future__ import annotations

from contextlib import closing, suppress
from io import BytesIO

import pytest
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from rosbags.rosbag2.metadata import parse_qos
from support.raw_bags import LATCHED, mcap_records

from diffdrive_jacobian.bags import journal
from diffdrive_jacobian.bags.files import MCAP_MAGIC, journal_of
from diffdrive_jacobian.bags.journal import Channel, JournalWriter, Message, Text
from diffdrive_jacobian.bags.salvage import Topic, read_mcap

pytestmark = pytest.mark.usefixtures('quick_disk')


def described(number, depth=10):
    return Channel(
        id=number,
        topic=f'/t{number}',
        type_name='a_msgs/msg/A',
        definition='int32 a\n',
        type_hash='RIHS01_0',
        qos=(LATCHED._replace(depth=depth),),
    )


@pytest.fixture
def written(tmp_path):
    """A function that returns the journal of some records, and its size after each flush."""

    def write(*flushes):
        with closing(JournalWriter(journal_of(tmp_path / 'x'))) as writer:
            sizes = []
            for records in ([described(number) for number in range(3)], *flushes):
                for record in records:
                    writer.add(record)
                writer.flush()
                sizes.append(writer.size)
            assert writer.waiting == 0
        data = writer.path.read_bytes()
        assert len(data) == sizes[-1]
        return data, sizes

    return write


def read(data):
    """Return the messages, with the numbers of the topics in their names, and what is lost."""
    lost, names, messages = [], {}, []
    for found in read_mcap(BytesIO(data), lost.append, lambda doubt: None):
        if isinstance(found, Topic):
            names[found.id] = int(found.name[-1])
        elif isinstance(found, Message):
            messages.append(Message(names[found.channel], found.stamp, found.data))
    return messages, lost


def test_any_cut_and_any_changed_byte_are_noticed(written):
    messages = [Message(number % 3, number, bytes(number)) for number in range(6)]
    data, sizes = written(messages[:3], [Text('é', 'ü'), *messages[3:]])
    ends = [end for *_, end in mcap_records(data)]
    assert read(data) == (messages, [])
    for cut in range(sizes[0], len(data)):
        left, lost = read(data[:cut])
        assert left == messages[: len(left)]
        assert len(left) >= 3 * (cut >= sizes[1])
        assert lost or cut in ends
    for place in range(len(MCAP_MAGIC), len(data)):
        changed = bytearray(data)
        changed[place] ^= 1
        # The name or the number of a topic may be damaged, so that `read` does not know it.
        with suppress(LookupError, ValueError):
            left, lost = read(bytes(changed))
            # In the header of the file, and in the times of a chunk, it does not matter.
            assert lost or left == messages


def test_an_attachment_whose_checksum_is_erased_is_noticed(written):
    data, _ = written([Text('parameters of /robot', '{}')])
    ((_, end),) = [
        (start, end) for opcode, start, end in mcap_records(data) if opcode == Opcode.ATTACHMENT
    ]
    lost = []
    erased = data[: end - 4] + bytes(4) + data[end:]
    found = list(read_mcap(BytesIO(erased), lost.append, lambda doubt: None))
    assert not any(isinstance(one, Text) for one in found)
    assert 'is damaged: it is left out' in lost[0]


def test_a_chunk_that_is_missing_is_noticed(written):
    a, b, c, d = (Message(number % 3, number, bytes(number)) for number in range(1, 5))
    whole, sizes = written([a], [b, c], [d])
    assert read(whole) == ([a, b, c, d], [])
    for missing, left in ((0, [b, c, d]), (1, [a, d])):
        found, lost = read(whole[: sizes[missing]] + whole[sizes[missing + 1] :])
        assert found == left
        assert lost == [f'its messages have the numbers 1 to 4, {len(left)} were found']


def test_a_large_message_has_a_chunk_of_its_own(written, monkeypatch):
    """A reader that refuses it still reads the others."""
    monkeypatch.setattr(journal, 'BLOCK', 1000)
    messages = [Message(0, 1, bytes(size)) for size in (10, 2000, 10, 600, 600, 10)]
    data, _ = written(messages)
    assert read(data) == (messages, [])
    sizes = [
        round(end - start, -2) for opcode, start, end in mcap_records(data) if opcode == Opcode.CHUNK
    ]
    assert sizes[-4:] == [100, 2100, 1400, 100]


def test_profiles_that_are_offered_later_are_those_of_the_same_topic(written):
    data, _ = written([Message(0, 1, b'a'), described(0, depth=7), Message(0, 2, b'b')])
    found = list(read_mcap(BytesIO(data), pytest.fail, lambda doubt: None))
    topics = [one for one in found if isinstance(one, Topic) and one.name == '/t0']
    assert len({one.id for one in topics}) == len(topics) == 2
    profiles = [parse_qos(one.qos) for one in topics]
    assert profiles == [[LATCHED._replace(depth=depth)] for depth in (10, 7)]
    assert [one.channel for one in found if isinstance(one, Message)] == [one.id for one in topics]


def test_other_tools_read_it(written):
    messages = [Message(number % 3, 10**18 + number, bytes([number])) for number in range(9)]
    data, _ = written(messages[:5], [Text('parameters of /robot', '{}'), *messages[5:]])
    found = []
    read_messages = NonSeekingReader(BytesIO(data), validate_crcs=True).iter_messages
    # It has no end.
    with suppress(EndOfFile):
        for _, topic, message in read_messages(log_time_order=False):
            found.append((topic.topic, message.log_time, message.data))
    assert found == [(f'/t{one.channel}', one.stamp, one.data) for one in messages]


def test_a_journal_is_never_overwritten(tmp_path):
    path = tmp_path / 'x.journal.mcap'
    path.write_bytes(b'dear')
    with pytest.raises(FileExistsError):
        JournalWriter(path)
    assert path.read_bytes() == b'dear'
