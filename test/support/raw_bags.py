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

"""Bags and journals of random bytes, and the tool recover_run on them."""

from __future__ import annotations

import random
import struct
from contextlib import closing
from functools import cache
from pathlib import Path

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer

from diffdrive_jacobian.bags.files import journal_of
from diffdrive_jacobian.bags.journal import Channel, JournalWriter, Message
from diffdrive_jacobian.bags.message_definitions import definition
from diffdrive_jacobian.bags.salvage import read_mcap
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools.recover_run import main as recover_run

TOPICS = {'/odom': 'nav_msgs/msg/Odometry', '/cmd_vel': 'geometry_msgs/msg/Twist'}
START = 1_795_213_077_456_505_918
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    7,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    QosTime(0, 100_000_000),
    QosTime(9223372036, 854775807),
    QosLiveliness.AUTOMATIC,
    QosTime(9223372036, 854775807),
    False,
)
PLUGINS = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
CUSTOM = {'parameters of /robot': '{"wheel_radius": 0.033}', 'é': 'ü\n'}


def make_messages(count, most):
    """Return topic, time and bytes: alike each time, random in their length and content."""
    return list(_random_messages(count, most))


@cache
def _random_messages(count, most):
    chance = random.Random(f'{count} {most}')
    return tuple(
        (
            chance.choice(list(TOPICS)),
            START + 1_000_000 * index,
            b'\0\1\0\0' + chance.randbytes(chance.randrange(most // 2, most)),
        )
        for index in range(count)
    )


def write_bag(path, storage, messages, mode=CompressionMode.NONE, told=None):
    """Write a bag by rosbags; `told` hears how many messages are in it."""
    writer = Writer(path, version=9, storage_plugin=PLUGINS[storage])
    writer.set_compression(mode, CompressionFormat.ZSTD)
    for key, value in CUSTOM.items():
        writer.set_custom_data(key, value)
    with writer:
        connections = {}
        for topic, name in TOPICS.items():
            found = definition(name)
            connections[topic] = writer.add_connection(
                topic,
                name,
                msgdef=found.text,
                rihs01=found.type_hash,
                offered_qos_profiles=[LATCHED],
            )
        for count, (topic, stamp, data) in enumerate(messages, 1):
            writer.write(connections[topic], stamp, data)
            if told:
                told(count)


def channel(number, topic, type_name, qos=()):
    """Return a topic of an installed type."""
    known = definition(type_name)
    return Channel(
        id=number,
        topic=topic,
        type_name=type_name,
        definition=known.text,
        type_hash=known.type_hash,
        qos=qos,
    )


def write_records(bag, *records):
    """Write the journal of a bag, with a chunk for every few records; return its path."""
    with closing(JournalWriter(journal_of(bag))) as writer:
        for number, record in enumerate(records, 1):
            writer.add(record)
            if number % 16 == 0:
                writer.flush()
        writer.flush()
    return writer.path


def write_journal(bag, messages):
    """Write what record_run leaves when it is killed."""
    channels = {one: channel(number, one, name) for number, (one, name) in enumerate(TOPICS.items())}
    records = (Message(channels[topic].id, stamp, data) for topic, stamp, data in messages)
    return write_records(bag, *channels.values(), *records)


def read_journal(path):
    """Give what is in a journal so far: topics, messages and custom data."""
    with open(path, 'rb') as file:
        return list(read_mcap(file, lambda loss: None, lambda doubt: None))


def read_bag(path):
    """Give topic, time and bytes of each message."""
    with Reader(path) as reader:
        return [(one.topic, stamp, bytes(data)) for one, stamp, data in reader.messages()]


def data_file(bag):
    """Return the only data file of a bag."""
    (file,) = (one for one in bag.iterdir() if one.suffix in ('.mcap', '.db3'))
    return file


def mcap_records(data, start=8):
    """Return opcode, start and end of the records of an MCAP file, or of a chunk from its start."""
    found = []
    while start + 9 <= len(data):
        opcode, length = struct.unpack_from('<BQ', data, start)
        found.append((opcode, start, start + 9 + length))
        start += 9 + length
    return found


def edit(file, change):
    """Change the bytes of a file, which `change` gets as a bytearray."""
    data = bytearray(file.read_bytes())
    change(data)
    file.write_bytes(data)


def names_of(path):
    """Give all that a bag tells of its topics and of itself."""
    with Reader(path) as reader:
        topics = {
            (one.topic, one.msgtype, one.msgdef.data, one.digest, *one.ext.offered_qos_profiles)
            for one in reader.connections
        }
        return topics, dict(reader.storage.metadata.custom or {})


def contents(folder):
    """Give every file with its bytes and its time of change."""
    return {
        path.name: (path.read_bytes(), path.stat().st_mtime_ns)
        for path in sorted(Path(folder).iterdir())
        if path.is_file()
    }


def run_tool(main, capsys, *arguments):
    """Run a tool in this process; return exit code, stdout, stderr."""
    capsys.readouterr()
    try:
        code = main([str(one) for one in arguments], Signals())
    except SystemExit as end:
        code = end.code
    return code, *capsys.readouterr()


def recover(capsys, *arguments):
    """Run recover_run; return exit code, stdout, stderr."""
    return run_tool(recover_run, capsys, *arguments)
