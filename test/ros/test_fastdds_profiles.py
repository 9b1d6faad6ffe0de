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

"""The profiles that entry points give to Fast DDS, and what a user can choose instead."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rclpy.node import Node
from support.domains import domain_id
from support.processes import run_python

from diffdrive_jacobian.ros import fastdds_profiles
from diffdrive_jacobian.ros.fastdds_profiles import (
    SWITCH,
    TRANSPORTS,
    VARIABLE,
    announce_frequently,
    fast_heartbeats,
    receive_in_order,
    withdraw,
)
from diffdrive_jacobian.ros.runner import ros_context, running

ANNOUNCEMENTS = '<leaseAnnouncement><sec>0</sec><nanosec>150000000</nanosec>'
HEARTBEATS = '<heartbeatPeriod><sec>0</sec><nanosec>100000000</nanosec>'
ORDER = '<offsetd3>10</offsetd3>'


@pytest.fixture(autouse=True)
def environment(monkeypatch, tmp_path):
    """An environment without choices of the user, in an empty folder."""
    for name in (*fastdds_profiles._CHOICES, SWITCH, TRANSPORTS, 'RMW_IMPLEMENTATION'):
        # Set first, so that it is restored in any case.
        monkeypatch.setenv(name, '')
        monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)


def profiles():
    """Return which profiles are in the file that Fast DDS will read."""
    text = Path(os.environ[VARIABLE]).read_text(encoding='utf-8')
    return [profile for profile in (ANNOUNCEMENTS, HEARTBEATS, ORDER) if profile in text]


def test_profiles_are_added_to_one_another_and_withdrawn():
    assert announce_frequently()
    assert profiles() == [ANNOUNCEMENTS]
    with fast_heartbeats():
        assert profiles() == [ANNOUNCEMENTS, HEARTBEATS]
    assert VARIABLE not in os.environ
    with fast_heartbeats():
        assert profiles() == [HEARTBEATS]
    receive_in_order()
    assert profiles() == [ANNOUNCEMENTS, HEARTBEATS, ORDER]


@pytest.mark.parametrize(
    ('name', 'value', 'announced'),
    [
        (TRANSPORTS, 'DEFAULT', True),
        (TRANSPORTS, 'UDPv4?max_msg_size=1MB', True),
        ('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp', True),
        (SWITCH, '1', True),
        (VARIABLE, '/own.xml', False),
        ('FASTDDS_DEFAULT_PROFILES_FILE', '/own.xml', False),
        ('SKIP_DEFAULT_XML_FILE', '1', False),
        (TRANSPORTS, 'SHM', False),
        (TRANSPORTS, 'LARGE_DATA?max_msg_size=1MB', False),
        ('ROS_DISCOVERY_SERVER', '127.0.0.1:11811', False),
        ('RMW_IMPLEMENTATION', 'rmw_cyclonedds_cpp', False),
    ],
)
def test_a_choice_of_the_user_is_left_as_it_is(name, value, announced, monkeypatch):
    monkeypatch.setenv(name, value)
    before = dict(os.environ)
    assert announce_frequently() == announced
    with fast_heartbeats():
        assert (dict(os.environ) != before) == announced
    withdraw()
    assert dict(os.environ) == before


@pytest.mark.parametrize('name', ['DEFAULT_FASTRTPS_PROFILES.xml', 'DEFAULT_FASTDDS_PROFILES.xml'])
def test_profiles_in_the_working_directory_are_left_as_they_are(name, tmp_path):
    (tmp_path / name).touch()
    assert not announce_frequently()
    assert VARIABLE not in os.environ


def test_a_variable_switches_it_off(monkeypatch):
    monkeypatch.setenv(SWITCH, '0')
    assert not announce_frequently()
    receive_in_order()
    assert VARIABLE not in os.environ


def test_the_variable_is_gone_when_the_first_node_exists():
    announce_frequently()
    with ros_context(['test']) as context, running(context, isolated=True) as runner:
        assert VARIABLE in os.environ
        runner.add(lambda: Node('first', context=context))
        assert VARIABLE not in os.environ


# The shared memory through which a node receives.
RECEIVING = """
import contextlib, os, sys
from diffdrive_jacobian.ros.fastdds_profiles import announce_frequently

announce_frequently()
import rclpy
from rclpy.node import Node

rclpy.init()
node = Node('receiver')
for number in os.listdir('/proc/self/fd'):
    with contextlib.suppress(FileNotFoundError):
        print(os.path.basename(os.readlink(f'/proc/self/fd/{number}')))
"""


@pytest.mark.process
def test_messages_are_received_through_udp(monkeypatch):
    """A sender then needs no check of shared memory, which often takes 0.33 s."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id()))
    for switch, expected in (('1', False), ('0', True)):
        monkeypatch.setenv(SWITCH, switch)
        ended = run_python(RECEIVING, timeout=60)
        assert ended.returncode == 0
        found = re.search(r'^fastrtps_port\d+_el$', ended.stdout, re.MULTILINE)
        assert bool(found) == expected


# The entry point runs in an empty folder; what it would give to Fast DDS is printed.
PRINTING = f"""
import os, sys, types

module = types.ModuleType('run_node')
module.run_node = lambda *arguments: print(os.path.basename(os.environ.get({VARIABLE!r}, 'none')))
sys.modules['diffdrive_jacobian.tools.run_node'] = module
from diffdrive_jacobian.tools.entry_points import virtual_robot
virtual_robot()
"""


@pytest.mark.process
def test_entry_points_announce_themselves():
    ended = subprocess.run(
        [sys.executable, '-c', PRINTING],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert ended.stdout == 'announcements_heartbeats.xml\n'
