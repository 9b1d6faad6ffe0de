"""The journal: what was written comes back, and of what was cut or damaged never anything else."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_jacobian.bags.journal import (
    MAGIC,
    Channel,
    JournalError,
    JournalWriter,
    Message,
    Text,
    read_journal,
)

NUMBERS = st.integers(-(2**63), 2**63 - 1)
RECORDS = st.one_of(
    st.builds(Message, st.integers(0, 2**16 - 1), NUMBERS, st.binary(max_size=60)),
    st.builds(Text, st.text(), st.text()),
    st.builds(
        Channel,
        id=st.integers(0, 2**16 - 1),
        topic=st.text(),
        type_name=st.text(),
        definition=st.text(),
        type_hash=st.text(),
        qos=st.lists(st.dictionaries(st.text(), NUMBERS, max_size=3), max_size=3).map(tuple),
    ),
)


def written(records):
    """Give the journal of these records."""
    with tempfile.TemporaryDirectory() as folder:
        writer = JournalWriter(Path(folder, 'x.journal'))
        for record in records:
            writer.add(record)
        writer.flush()
        assert writer.size == writer.path.stat().st_size
        writer.close()
        return writer.path.read_bytes()


def read(data):
    """Give its records, and how many bytes at its end were not read."""
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        records, reader = [], read_journal(Path(file.name))
        while True:
            try:
                records.append(next(reader))
            except StopIteration as end:
                return records, end.value


@settings(deadline=None, max_examples=60)
@given(st.lists(RECORDS, max_size=10))
def test_any_records_come_back(records):
    assert read(written(records)) == (records, 0)


@settings(deadline=None, max_examples=60)
@given(st.lists(RECORDS, max_size=6), st.data())
def test_a_cut_at_any_byte_leaves_the_records_before_it(records, data):
    whole = written(records)
    cut = data.draw(st.integers(len(MAGIC), len(whole)))
    left, unread = read(whole[:cut])
    assert left == records[: len(left)]
    assert written(left) == whole[: cut - unread]
    # The next one would not have fitted.
    assert left == records or len(written(records[: len(left) + 1])) > cut


@settings(deadline=None, max_examples=100)
@given(st.lists(RECORDS, min_size=1, max_size=6), st.data())
def test_a_flipped_bit_never_makes_a_wrong_record(records, data):
    damaged = bytearray(written(records))
    place = data.draw(st.integers(len(MAGIC), len(damaged) - 1))
    damaged[place] ^= 1 << data.draw(st.integers(0, 7))
    left, unread = read(bytes(damaged))
    assert left == records[: len(left)]
    assert unread > 0
    assert len(damaged) - unread <= place


def test_bytes_with_a_right_checksum_that_hold_no_message_end_it():
    # The checksum of nothing is the number that it began with: that of the kind.
    damage = b'M' + bytes(4) + (ord('M')).to_bytes(4, 'little')
    assert read(MAGIC + damage) == ([], len(damage))


def test_a_length_beyond_the_end_asks_for_no_memory():
    assert read(MAGIC + b'M' + b'\xff' * 8 + b'xyz') == ([], 12)


@pytest.mark.parametrize('content', [b'', MAGIC[:-1], b'\x89MCAP0\r\n' + bytes(20)])
def test_another_file_is_refused(tmp_path, content):
    path = tmp_path / 'x.journal'
    path.write_bytes(content)
    with pytest.raises(JournalError, match=r'x\.journal is not a journal of record_run'):
        list(read_journal(path))


def test_a_journal_is_never_overwritten(tmp_path):
    path = tmp_path / 'x.journal'
    path.write_bytes(b'dear')
    with pytest.raises(FileExistsError):
        JournalWriter(path)
    assert path.read_bytes() == b'dear'
