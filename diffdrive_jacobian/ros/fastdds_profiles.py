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

"""Profiles of Fast DDS for the process of an entry point: announcements, transport and heartbeats.

Fast DDS announces a participant to others five times when it is created, and then every 3 s. An older
one answers the first announcement of a new one at once. The new one often discards this answer, because
it does not receive yet, and then hears the older one only at its next announcement. Nodes that announce
themselves every 0.15 s are discovered by any new process in that time.

Before the first message through shared memory Fast DDS checks whether the receiver is alive. Where
nothing was sent to the receiver for a while, the check often takes 0.33 s, and blocks the sender that
long. Nodes that receive through UDP are spared that. They still send through shared memory to those
that receive so.

A reliable writer of Fast DDS sends its readers a heartbeat every 3 s. A reader that has received all
messages acknowledges them only in reply to a heartbeat. `Publisher.wait_for_all_acked` therefore takes
up to 3 s after the messages were received, unless heartbeats are more frequent.

Messages and discovery have a port each, and a thread. So the end of a publisher may be heard before the
last message that it sent, which is then dropped. A recorder receives both through one port, in order
(`offsetd3` is that of the port for discovery).

Fast DDS reads the file that an environment variable names, when the first participant of a process is
created. A choice of the user is left as it is: a file of profiles in the environment or in the working
directory, transports without UDP over IPv4, a discovery server, or another middleware.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
"""Environment variable that names the file."""
SWITCH = 'DIFFDRIVE_JACOBIAN_FAST_DISCOVERY'
"""Environment variable that switches frequent announcements off if it is 0."""
_FOLDER = os.path.join(os.path.dirname(os.path.abspath(__file__)), 'fastdds')
_FILES = {
    os.path.join(_FOLDER, 'announcements.xml'): {'announcements'},
    os.path.join(_FOLDER, 'heartbeats.xml'): {'heartbeats'},
    os.path.join(_FOLDER, 'announcements_heartbeats.xml'): {'announcements', 'heartbeats'},
    os.path.join(_FOLDER, 'recorder.xml'): {'announcements', 'heartbeats', 'order'},
}
"""The files, and the profiles in each."""
# Other names of the variable, how Fast DDS is told to ignore files, and servers, which replace
# announcements.
_CHOICES = (
    *(VARIABLE, 'FASTDDS_DEFAULT_PROFILES_FILE', 'SKIP_DEFAULT_XML', 'SKIP_DEFAULT_XML_FILE'),
    *('ROS_DISCOVERY_SERVER', 'ROS_SUPER_CLIENT', 'ROS2_EASY_MODE'),
)
TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
"""Environment variable of Fast DDS that names its transports."""
_WITH_UDP = ('', 'DEFAULT', 'UDPv4')
_used: set[str] = set()
"""The profiles with which the first participant of this process was created."""
_DEFAULTS = ('DEFAULT_FASTRTPS_PROFILES.xml', 'DEFAULT_FASTDDS_PROFILES.xml')


def announce_frequently() -> bool:
    """Announce the participants of this process every 0.15 s, and receive messages through UDP.

    Return whether Fast DDS will do so: not if the user has chosen otherwise, or by the variable SWITCH.
    """
    return os.environ.get(SWITCH, '') != '0' and _use('announcements')


@contextmanager
def fast_heartbeats() -> Iterator[None]:
    """Set the heartbeat period of publishers to 0.1 s, in a process without participants."""
    _use('heartbeats')
    try:
        yield
    finally:
        withdraw()


def open_to_others() -> None:
    """Do what `announce_frequently` does, and send heartbeats every 0.1 s."""
    if announce_frequently():
        _use('heartbeats')


def receive_in_order() -> None:
    """Do what `open_to_others` does, and hear of the end of a publisher after its last message."""
    open_to_others()
    if _own() == {'announcements', 'heartbeats'}:
        _use('order')


def for_other_process() -> dict[str, str]:
    """Return the environment variables with which another process does what `open_to_others` does.

    To be called when this process has a participant.
    """
    open_to_others()
    try:
        return {VARIABLE: os.environ[VARIABLE]} if _own() else {}
    finally:
        withdraw()


def withdraw() -> None:
    """Remove the variable when the first participant exists: other processes must not inherit it."""
    if profiles := _own():
        _used.update(profiles)
        del os.environ[VARIABLE]


def receives_through_udp() -> bool:
    """Return whether this process receives all messages through UDP, once it has a node."""
    return 'announcements' in _used | (_own() or set())


def _use(profile: str) -> bool:
    """Add a profile to those that Fast DDS will read. Return whether it will."""
    present = _own()
    if present is None and _user_has_chosen():
        return False
    (file,) = (one for one, profiles in _FILES.items() if profiles == {profile, *(present or ())})
    if not os.access(file, os.R_OK):
        # Packed without its data files. Fast DDS would report that as an error.
        return False
    os.environ[VARIABLE] = file
    return True


def _own() -> set[str] | None:
    """Return the profiles in the file that the variable names. None: it is no file of this package."""
    return _FILES.get(os.environ.get(VARIABLE, ''))


def _user_has_chosen() -> bool:
    middleware = os.environ.get('RMW_IMPLEMENTATION', '')
    # The name of the transports may be followed by options, "UDPv4?max_msg_size=1MB".
    transports = os.environ.get(TRANSPORTS, '').partition('?')[0]
    return (
        any(os.environ.get(name) for name in _CHOICES)
        or transports not in _WITH_UDP
        or not (not middleware or middleware.startswith('rmw_fastrtps'))
        or any(os.path.exists(file) for file in _DEFAULTS)
    )
