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

"""Bags of which a part is invalid, written byte by byte."""

from __future__ import annotations

import struct
from pathlib import Path

from diffdrive_jacobian.bags.files import MCAP_MAGIC as MAGIC

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


# --- MCAP


def record(opcode: int, fields: bytes) -> bytes:
    return struct.pack('<BQ', opcode, len(fields)) + fields


def text(value: str | bytes) -> bytes:
    """Return a field with a text."""
    data = value.encode() if isinstance(value, str) else value
    return struct.pack('<I', len(data)) + data


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
) -> bytes:
    """Return an MCAP file.

    Args:
        body: Its records.
        chunks: For the index: offset in `body`, length, compression, packed size, claimed size. Without
            them the file has no summary, and readers scan it.
        message_index: Whether the index promises an index of messages behind each chunk.
        statistics: Number of messages in the statistics; None: the summary has none.
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
                struct.pack('<QQQQ', 1, 1, at, length)
                + text(struct.pack('<HQ', 1, at + length) if message_index else b'')
                + struct.pack('<Q', 31 if message_index else 0)
                + text(compression)
                + struct.pack('<QQ', packed, size),
            )
        if statistics is not None:
            head = struct.pack('<QHIIIIQQ', statistics, 1, 1, 0, 0, len(chunks), 1, 1)
            data += record(11, head + text(struct.pack('<HQ', 1, statistics)))
    return data + record(2, struct.pack('<QQI', start, 0, 0)) + MAGIC
