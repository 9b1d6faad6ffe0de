"""Bags and files that are small, and ask for far more time or memory than their size justifies."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import lz4.frame

from diffdrive_jacobian.bags.mcap import MAGIC, record, text

MIB = 1 << 20
GIB = 1 << 30
METADATA = """rosbag2_bagfile_information:
  version: 9
  storage_identifier: {storage}
  duration: {{nanoseconds: 0}}
  starting_time: {{nanoseconds_since_epoch: 1}}
  message_count: 1
  topics_with_message_count:
    - topic_metadata: {{name: /odom, type: nav_msgs/msg/Odometry, serialization_format: cdr,
        offered_qos_profiles: [], type_description_hash: ''}}
      message_count: 1
  compression_format: '{compression}'
  compression_mode: '{mode}'
  relative_file_paths: [{file}]
  files: []
{more}"""


def write_folder(
    path: Path, file: str, content: bytes = b'', *, mode='', storage='mcap', more=''
) -> Path:
    """Write a bag's directory around one file; `content` is left alone if it is empty."""
    path.mkdir(exist_ok=True)
    if content:
        (path / file).write_bytes(content)
    compression = 'zstd' if mode else ''
    (path / 'metadata.yaml').write_text(
        METADATA.format(storage=storage, file=file, mode=mode, compression=compression, more=more)
    )
    return path


# --- Compressed zeros


def zstd_zeros(size: int, *, declared: bool = True) -> bytes:
    """Return a Zstandard frame of zeros: 4 bytes for each 128 KiB, whatever the size."""
    # Frame header: content size in 8 bytes, window of 128 KiB; blocks that repeat one byte.
    frame = struct.pack('<IB', 0xFD2FB528, 0xC0 if declared else 0) + bytes([7 << 3])
    frame += struct.pack('<Q', size) if declared else b''
    count, rest = divmod(size, 1 << 17)
    for length, number in ((1 << 17, count), (rest, 1)):
        frame += (struct.pack('<I', length << 3 | 1 << 1)[:3] + b'\0') * number
    return frame + struct.pack('<I', 1)[:3]


def lz4_zeros(size: int) -> bytes:
    """Return an LZ4 frame of zeros, a whole number of 4 MiB blocks."""
    block = 4 * MIB
    options = {'block_size': lz4.frame.BLOCKSIZE_MAX4MB, 'block_linked': False, 'store_size': False}
    one = lz4.frame.compress(bytes(block), **options)
    head, end = 7, 4
    return one[:head] + one[head:-end] * (size // block) + one[-end:]


# --- MCAP


def chunk(compression: str, packed: bytes, size: int, checksum: int = 0) -> bytes:
    """Return a chunk record; `size` is what it claims to unpack to."""
    head = struct.pack('<QQQI', 1, 1, size, checksum) + text(compression)
    return record(6, head + struct.pack('<Q', len(packed)) + packed)


def topic_records(
    name='/odom', type_name='nav_msgs/msg/Odometry', qos='', definition='int32 x\n'
) -> bytes:
    schema = struct.pack('<H', 1) + text(type_name) + text('ros2msg') + text(definition)
    extra = text('offered_qos_profiles') + text(qos)
    channel = struct.pack('<HH', 1, 1) + text(name) + text('cdr') + text(extra)
    return record(3, schema) + record(4, channel)


def message(data: bytes, stamp: int = 1, channel: int = 1) -> bytes:
    return record(5, struct.pack('<HIQQ', channel, 0, stamp, stamp) + data)


def mcap(
    body: bytes,
    chunks: tuple[tuple[int, int, str, int, int], ...] = (),
    *,
    message_index: bool = True,
    statistics: int | None = None,
    end: int = 1,
) -> bytes:
    """Return an MCAP file.

    Args:
        body: Its records.
        chunks: For the index: offset in `body`, length, compression, packed size, claimed size. Without
            them the file has no summary, and readers scan it.
        message_index: Whether the index promises an index of messages behind each chunk.
        statistics: Number of messages in the statistics; None: the summary has none.
        end: Time of the last message of each chunk, for the index (ns); that of the first is 1.
    """
    head = MAGIC + record(1, text('ros2') + text('test'))
    data = head + body + record(15, bytes(4))
    start = 0
    if chunks:
        start = len(data)
        data += topic_records()
        for offset, length, compression, packed, size in chunks:
            at = len(head) + offset
            # One message of channel 1 is promised by an index of 16 bytes behind the chunk.
            data += record(
                8,
                struct.pack('<QQQQ', 1, end, at, length)
                + text(struct.pack('<HQ', 1, at + length) if message_index else b'')
                + struct.pack('<Q', 31 if message_index else 0)
                + text(compression)
                + struct.pack('<QQ', packed, size),
            )
        if statistics is not None:
            head = struct.pack('<QHIIIIQQ', statistics, 1, 1, 0, 0, len(chunks), 1, 1)
            data += record(11, head + text(struct.pack('<HQ', 1, statistics)))
    return data + record(2, struct.pack('<QQI', start, 0, 0)) + MAGIC


def chunk_bomb(
    compression: str, packed: bytes, size: int, *, indexed: bool, times: int = 1, end: int = 1
) -> bytes:
    """Return an MCAP file whose chunks unpack to zeros."""
    one = chunk(compression, packed, size)
    first = topic_records()
    entry = [
        (len(first) + number * len(one), len(one), compression, len(packed), size)
        for number in range(times)
    ]
    return mcap(first + one * times, tuple(entry) if indexed else (), end=end)


# --- SQLite

SCHEMA = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
    serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
INSERT INTO schema VALUES (3, 'jazzy');
"""
TOPIC = "INSERT INTO topics VALUES (1, '/odom', 'nav_msgs/msg/Odometry', 'cdr', '');"
MESSAGES = """CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
    timestamp INTEGER NOT NULL, data BLOB NOT NULL);"""


def write_sqlite(path: Path, *statements: str) -> Path:
    with closing(sqlite3.connect(path)) as database, database:
        database.executescript(SCHEMA + ';'.join(statements))
    return path


def varint(value: int) -> bytes:
    """Return a number as SQLite writes those of four bytes."""
    parts = [value >> 7 * place & 0x7F for place in (3, 2, 1, 0)]
    return bytes([*(part | 0x80 for part in parts[:-1]), parts[-1]])


def write_loop(path: Path, pages: int) -> Path:
    """Write a database whose message claims more pages than it has; the last page follows itself."""
    size = 1 << 21
    write_sqlite(path, TOPIC, MESSAGES, f'INSERT INTO messages VALUES (1, 1, 1, zeroblob({size}))')
    data = path.read_bytes()
    # The length of the row, with a header of 8 bytes. A page of the chain holds the number of the next
    # one and 4092 bytes.
    length = varint(size + 8)
    assert data.count(length) == 1
    data = data.replace(length, varint(size + 8 + 4092 * pages))
    last = len(data) // 4096
    path.write_bytes(data[:-4096] + struct.pack('>I', last) + data[-4092:])
    return path


GENERATED = (
    TOPIC,
    """CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
        timestamp INTEGER NOT NULL, data BLOB AS (zeroblob(900000000)))""",
    'INSERT INTO messages(id, topic_id, timestamp) VALUES (1, 1, 1)',
)
ENDLESS = (
    'DROP TABLE topics',
    """CREATE VIEW topics AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)
        SELECT id, '/odom' AS name, 'nav_msgs/msg/Odometry' AS type, 'cdr' AS serialization_format,
        '' AS offered_qos_profiles FROM n""",
    MESSAGES,
)

# --- YAML


def laughs(levels: int = 9, width: int = 9) -> str:
    """Return a mapping of lists of aliases of lists: width**levels entries."""
    lines = ['a0: &a0 [' + ', '.join(['lol'] * width) + ']']
    for level in range(1, levels):
        aliases = ', '.join([f'*a{level - 1}'] * width)
        lines.append(f'a{level}: &a{level} [{aliases}]')
    return '\n'.join(lines) + '\n'


def merging_laughs(levels: int = 25) -> str:
    """Return mappings that merge the one before twice."""
    lines = ['a0: &a0 {k: 1}']
    lines += [
        f'a{level}: &a{level} {{<<: [*a{level - 1}, *a{level - 1}]}}' for level in range(1, levels)
    ]
    return '\n'.join(lines) + '\n'


CYCLE = 'a: &a\n  b: *a\n'
