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

"""Bags of what was sent: built from messages, without nodes."""

from __future__ import annotations

import json
from pathlib import Path

from action_msgs.msg import GoalStatus
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from ruamel.yaml import YAML

from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.journal import PARAMETERS, Message, Text
from support.raw_bags import channel
from support.ros_messages import odometry, placement, stamp, twist

SECOND = 1_000_000_000
REAL = Path(__file__).parents[1] / 'bags' / 'turtlebot3_fake_sqlite'
"""A bag of another robot, written by another version of rosbag2."""


def write_bag(path, sent, *, parameters=None, storage='mcap'):
    """Write a bag of (seconds, topic, message); parameters are by node."""
    channels, data = {}, []
    for seconds, topic, message in sent:
        name = f'{type(message).__module__.split(".")[0]}/msg/{type(message).__name__}'
        if (topic, name) not in channels:
            channels[topic, name] = channel(len(channels), topic, name)
        received = round(seconds * SECOND)
        data.append(Message(channels[topic, name].id, received, serialize_message(message)))
    texts = [Text(PARAMETERS + node, json.dumps(values)) for node, values in (parameters or {}).items()]
    if storage == 'sqlite3':
        write_sqlite(channels.values(), [*texts, *data], path)
    else:
        build_bag(channels.values(), [*texts, *data], path)
    return path


def write_sqlite(channels, records, path):
    """Write a bag as SQLite, by rosbags."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    with writer:
        connections = {
            one.id: writer.add_connection(
                one.topic, one.type_name, msgdef=one.definition, rihs01=one.type_hash
            )
            for one in channels
        }
        for record in records:
            if isinstance(record, Text):
                writer.set_custom_data(record.key, record.value)
            else:
                writer.write(connections[record.channel], record.stamp, record.data)


def count_more(bag, topic, more):
    """Add to the number of messages of a topic in metadata.yaml."""
    yaml, path = YAML(typ='safe'), bag / 'metadata.yaml'
    content = yaml.load(path.read_text())
    for one in content['rosbag2_bagfile_information']['topics_with_message_count']:
        if one['topic_metadata']['name'] == topic:
            one['message_count'] += more
    with open(path, 'w') as file:
        yaml.dump(content, file)


def odom(x, y, theta, v=0.0, omega=0.0, *, seconds=0.0):
    message = odometry(x, y, theta)
    message.header.stamp = stamp(round(seconds * SECOND))
    message.twist.twist = twist(v, omega)
    return message


def status(value, seconds=0):
    message = GoalStatus(status=value)
    message.goal_info.stamp.sec = seconds
    return message


def start(x, y, theta, *, seconds):
    message = placement(x, y, theta)
    message.header.stamp = stamp(round(seconds * SECOND))
    return message


def changed(node, name, value):
    return ParameterEvent(
        node=node, changed_parameters=[Parameter(name, value=value).to_parameter_msg()]
    )
