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

"""The ROS domain of a process: the process itself, and the node by which the world is there."""

from __future__ import annotations

import itertools
import os
import socket
import zlib
from collections.abc import Callable, Collection
from contextlib import ExitStack

from rclpy.node import Node
from rclpy.parameter import Parameter

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep.external.command import Command
from diffdrive_jacobian.lockstep.external.datagrams import Datagrams
from diffdrive_jacobian.lockstep.external.graph import rules_apart
from diffdrive_jacobian.lockstep.external.linux import DISCOVERY_PORTS, PORTS, sockets_of, threads_of
from diffdrive_jacobian.lockstep.external.process import ExternalProcess
from diffdrive_jacobian.lockstep.external.quiet import Quiet
from diffdrive_jacobian.lockstep.external.wall_time import WallTime
from diffdrive_jacobian.ros.runner import DISCOVERY, environment, ros_context

DOMAINS = range(102, 232)
"""Domains to choose from. Others do not use them: Linux gives ports of most of them to clients, too."""
PARTICIPANTS = 32
"""Number of participants of a domain whose ports are looked at. Each process has one or more."""
_numbers = itertools.count()


class Domain:
    """The domain of one run of a process, from its start to its end.

    Attributes:
        number: Number of the domain.
        node: The node of the world in it.
        child: The process.
        quiet: Tells when the process, and the threads that receive from it, have nothing to do.
        listeners: Threads of this process that receive only what nodes tell of themselves.
        datagrams: Counts what was lost between the world and the process.
        wall_time: The wall time that the world gives it; None: it has its own.
    """

    def __init__(
        self, command: Command, apart: Collection[str], now: int, wake: Callable[[], object]
    ) -> None:
        """Start the process, and create what is needed to receive from it.

        Args:
            command: How to start it.
            apart: Topics of which each of its nodes has its own.
            now: Simulated time (ns).
            wake: Wakes its nodes up, so that they notice a signal.

        Raises:
            LockstepError: It cannot be started or observed.
        """
        self.command = command
        self.number = free_domain()
        self._closing = ExitStack()
        try:
            self._create_node()
            variables = {DISCOVERY[0]: 'LOCALHOST', 'ROS_DOMAIN_ID': str(self.number)}
            self.wall_time: WallTime | None = None
            if command.wall_time == 'simulated':
                self.wall_time = WallTime(now)
                self._closing.callback(self.wall_time.close)
                variables |= self.wall_time.environment()
            self.child: ExternalProcess = command.start(variables, rules_apart(sorted(apart)))
            self.child.wake = wake
            if self.wall_time is not None:
                self.wall_time.root = self.child.root
            self.quiet = Quiet(self.child.root, self._receiving)
            self._closing.callback(self.quiet.threads.close)
            self.child.check_addresses()
            self.listeners = self.quiet.threads.listeners()
            self.datagrams = Datagrams()
            self.datagrams.watch(os.getpid(), but=self._sockets_before)
        except BaseException:
            self.end()
            raise

    def _create_node(self) -> None:
        """Create the node of the world, and note what threads and sockets it takes."""
        here = os.getpid()
        before, self._sockets_before = threads_of(here), sockets_of(here)
        domain = {DISCOVERY[0]: 'LOCALHOST', 'ROS_DOMAIN_ID': str(self.number)}
        with environment({**dict.fromkeys(DISCOVERY), **domain}):
            context = self._closing.enter_context(ros_context(['lockstep']))
        self.node = Node(
            'lockstep_of_world',
            context=context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=[Parameter('start_type_description_service', value=False)],
        )
        self._closing.callback(self.node.destroy_node)
        self._receiving = threads_of(here) - before

    @property
    def title(self) -> str:
        """The command line as errors name it."""
        return self.child.title

    def close(self) -> None:
        """Leave the domain. What the process has printed can still be read."""
        self.wall_time = None
        self._closing.close()

    def end(self) -> None:
        """Kill the process if it has not ended, and leave the domain."""
        if hasattr(self, 'child'):
            self.child.kill()
            self.child.close()
        self.close()


def free_domain() -> int:
    """Return a ROS domain that no process on this machine uses.

    Workers of pytest-xdist choose from different domains.

    Raises:
        LockstepError: There is none.
    """
    worker = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
    workers = int(os.environ.get('PYTEST_XDIST_WORKER_COUNT', '1'))
    domains = DOMAINS[worker % len(DOMAINS) :: workers]
    # Other programs on this machine begin elsewhere.
    first = zlib.crc32(str(os.getpid()).encode()) + next(_numbers)
    for number in range(len(domains)):
        domain = domains[(first + number) % len(domains)]
        if all(map(_is_free, _ports(domain))):
            return domain
    raise LockstepError(
        f'{len(domains)} ROS domains from {domains[0]} to {domains[-1]} are all in use on this machine'
    )


def _ports(domain: int) -> list[int]:
    """Return the UDP ports for discovery: multicast, and unicast of each participant.

    All of them: with discovery on the own machine only, no process may use the first, and the process
    of the first participant may have ended before the others.
    """
    multicast = DISCOVERY_PORTS + PORTS * domain
    return [multicast, *(multicast + 10 + 2 * participant for participant in range(PARTICIPANTS))]


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', port))
        except OSError:
            return False
    return True
