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

"""Waiting until the nodes of a process and the world have discovered each other."""

from __future__ import annotations

import math
import time
import warnings

from rcl_interfaces.srv import GetParameters

from diffdrive_jacobian.lockstep._clock import Clocks
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep.external.discovery import Discovery
from diffdrive_jacobian.lockstep.external.domain import Domain
from diffdrive_jacobian.lockstep.external.linux import domains_of
from diffdrive_jacobian.lockstep.external.presence import PERIOD, Presence
from diffdrive_jacobian.lockstep.external.quiet import Allowance, BegunLater
from diffdrive_jacobian.lockstep.external.relays import Arrived
from diffdrive_jacobian.lockstep.external.waiting import SIMULATED, Waiting
from diffdrive_jacobian.ros.rclpy_internals import graph_changed, send_request, take_response
from diffdrive_jacobian.time_units import NANOSECONDS

REPETITION = 1.0
"""Period at which a request is repeated: a response may be lost before all is discovered (s)."""
SILENCE = 0.2
"""Time for which a process that has started must not send anything by itself (s)."""
SUBSCRIBING = 3.0
"""Least time until a node must be subscribed to /clock (s): its name may be discovered before."""
STARTING = 0.3
"""Time that nodes need at most to spin, unless they sleep or wait before (s)."""
LOOP = 2.0
"""Longest time until an executor that waits with a timeout does so again (s)."""
UNCONFIRMED = 0.5
"""Time for nodes without parameter services to discover the endpoints of the world (s)."""
BEFORE = NANOSECONDS
"""For how long before it takes part a process may have the time that it waits for to start (ns)."""


class UnmatchedError(LockstepError):
    """DDS does not match endpoints that have been discovered, as happens rarely."""


class Connecting:
    """Connects the nodes of a process with the world.

    Attributes:
        lasting: What the process sent before it took part, and that counts: latched messages, requests.
        sleepers: Threads that sleep in the idle process.
        cpp_threads: Number of threads of the executors of a process in C++, until they were warned of.
    """

    def __init__(
        self,
        domain: Domain,
        discovery: Discovery,
        presence: Presence,
        waiting: Waiting,
        clocks: Clocks,
    ) -> None:
        """Start without a connection."""
        self._domain, self._discovery, self._presence = domain, discovery, presence
        self._waiting, self._clocks = waiting, clocks
        self.lasting: list[Arrived] = []
        self.sleepers: set[int] = set()
        self.cpp_threads = 0
        self._before = -BEFORE

    def connect(self, matching: float = math.inf) -> None:
        """Wait until the nodes of the process and the world have discovered each other.

        Args:
            matching: Longest time until what is discovered is matched, too (s).

        Raises:
            UnmatchedError: That has passed.
            LockstepError: They have not discovered each other, or cannot take part.
        """
        self._discover(matching)
        self._discovery.check_order()
        self._learn_how_it_waits()
        self._check_silent()
        domain, discovery = self._domain, self._discovery
        domain.quiet.idle.learn()
        for pid in discovery.participants:
            domain.datagrams.watch(pid)
        if domain.wall_time is not None:
            domain.wall_time.check(domain.title)
            domain.wall_time.check_loaded(discovery.participants)
            self.sleepers = domain.wall_time.sleeping()
        self._presence.note()
        domain.child.note_shared_memory(discovery.participants)
        self._check_known()
        self._warn()

    def _discover(self, matching: float) -> None:
        """Wait until nothing new is discovered, and all nodes receive the time."""
        domain, discovery = self._domain, self._discovery
        timeout = Allowance(domain.quiet, domain.command.timeout)
        matched_by = BegunLater(domain.quiet, matching)
        subscribed_by = BegunLater(domain.quiet, SUBSCRIBING)
        while True:
            self._match(timeout, matched_by)
            known = len(discovery.relays)
            self.confirm(timeout)
            self._wait_and_learn()
            graph_changed(domain.node)
            if not discovery.learn() or len(discovery.relays) > known:
                continue
            if not (untimed := self._presence.untimed()):
                return
            if subscribed_by.is_used_up():
                raise LockstepError(
                    f'{", ".join(untimed)} of {domain.title} is not subscribed to /clock: its '
                    'parameter use_sim_time must be true; if it needs no time: '
                    'start(..., use_sim_time=False)'
                )
            time.sleep(SILENCE)

    def _match(self, timeout: Allowance, matched_by: BegunLater) -> None:
        """Wait until there are nodes, and all that is discovered of them is matched."""
        domain, discovery = self._domain, self._discovery
        begin = time.monotonic()
        while not (discovery.learn() and discovery.is_matched()):
            domain.child.check_running()
            if timeout.is_used_up():
                raise LockstepError(self._missing())
            if discovery.stand_ins:
                if matched_by.is_used_up():
                    raise UnmatchedError(self._missing())
            elif time.monotonic() > begin + STARTING:
                self._end_sleep()
            time.sleep(PERIOD)

    def _missing(self) -> str:
        """Return what was not discovered within the timeout, for an error."""
        domain = self._domain
        waited = f'within {domain.command.timeout:g} s (timeout=)'
        missing = [name for (_, name), relay in self._discovery.relays.items() if not relay.is_matched()]
        if missing:
            return (
                f'{domain.title}: not discovered {waited}: {", ".join(missing)}\n'
                f'{domain.child.describe()}'
            )
        hint = 'it has created none, or not yet'
        if others := domains_of(domain.quiet.threads.processes()) - {domain.number}:
            hint = (
                f'it is in ROS domain {", ".join(map(str, sorted(others)))} instead of {domain.number}: '
                'it must not set ROS_DOMAIN_ID, which start() sets for it'
            )
        return f'no node of {domain.title} was discovered {waited}: {hint}\n{domain.child.describe()}'

    def _check_known(self) -> None:
        """Raise LockstepError if the process has no topic of a name that is to stay in it."""
        there = {topic for topic, _ in self._domain.node.get_topic_names_and_types()}
        if not self._discovery.joined and (unknown := sorted(set(self._domain.command.without) - there)):
            raise LockstepError(f'{self._domain.title} has no topic {", ".join(unknown)} (without=)')

    # --- Whether the nodes know the world

    def confirm(self, allowance: Allowance) -> None:
        """Wait until the nodes respond, which shows that they have discovered what the world has.

        They discover endpoints in the order of their creation, so those of new clients come last.
        """
        discovery = self._discovery
        names = [
            relay.client.service_name
            for relay in discovery.relays.values()
            if relay.client is not None and relay.client.srv_type is GetParameters
        ]
        for name in names:
            self._await_response(name, allowance)
        if len(names) < len(discovery.stand_ins):
            known = len(discovery.relays)
            time.sleep(UNCONFIRMED)
            discovery.learn()
            if len(discovery.relays) == known:
                self._wait_and_learn()

    def _await_response(self, name: str, allowance: Allowance) -> None:
        """Ask a node for a parameter until it has responded to the last request, so to all of them."""
        domain = self._domain
        client = domain.node.create_client(GetParameters, name)
        begin, periods, number, response = time.monotonic(), 0, 0, None
        while not number or response is None or response[0] != number:
            domain.child.check_running()
            if allowance.is_used_up():
                raise LockstepError(
                    f'{name} does not respond: the executor of the node does not spin, or waits for '
                    'what comes later, as a service in its constructor (a node that is spun in '
                    'callbacks only needs start_parameter_services=False); '
                    f'{domain.quiet.describe()}\n{domain.child.describe()}'
                )
            if graph_changed(domain.node):
                self._discovery.learn()
            passed = time.monotonic() - begin
            if number and passed > STARTING:
                self._end_sleep()
            if passed > periods * REPETITION and client.service_is_ready():
                periods += 1
                if response is None:
                    number = send_request(client, GetParameters.Request(names=['use_sim_time']))
                self._wait_and_learn()
                if periods > 1 and not self._spins():
                    # A loop may wait for the time, as by a Rate on the clock of the node.
                    self._before = min(self._before + BEFORE // 20, 0)
                    self._discovery.send_time(max(1, self._clocks.now + self._before))
            time.sleep(PERIOD / 10)
            response = take_response(client) or response
        domain.node.destroy_client(client)

    def _wait_and_learn(self) -> None:
        """Wait until the process is quiet, and learn what it creates meanwhile.

        Before its nodes spin, it may wait for a service of the world.
        """
        quiet = self._domain.quiet
        patience = Allowance(quiet, self._domain.command.patience)
        while not (quiet.is_quiet() or quiet.waits_in_callback or patience.is_used_up()):
            if graph_changed(self._domain.node):
                self._discovery.learn()
            time.sleep(PERIOD / 10)
        self._waiting.wait()

    def _end_sleep(self) -> None:
        """Let a process that sleeps before its nodes spin go on, in simulated wall time."""
        wall_time = self._domain.wall_time
        if wall_time is None or not self._domain.quiet.is_quiet() or self._spins():
            return
        if wall_time.end_sleep():
            self._waiting.wait()

    def _spins(self) -> bool:
        wall_time = self._domain.wall_time
        return self._domain.quiet.idle.spins() if wall_time is None else wall_time.spins

    # --- How the idle process is

    def _learn_how_it_waits(self) -> None:
        """Wait until its executors wait as they do when they are idle.

        A node may wait for something before it spins, with a timeout.
        """
        quiet = self._domain.quiet
        looping = Allowance(quiet, LOOP)
        quiet.idle.learn()
        while not (quiet.idle.loops or looping.is_used_up()):
            time.sleep(PERIOD)
            self._waiting.wait()
            quiet.idle.learn()

    def _check_silent(self) -> None:
        """Keep what counts of what was sent before, and check that nothing is sent by itself."""
        # Others than latched ones came before anybody could be subscribed.
        self.lasting = [arrived for arrived in self._waiting.take() if arrived.lasting]
        time.sleep(SILENCE)
        self._waiting.wait()
        late = self._waiting.take()
        self.lasting += [arrived for arrived in late if arrived.lasting]
        self._waiting.refuse([arrived for arrived in late if not arrived.lasting])

    def _warn(self) -> None:
        """Warn of what may differ from run to run without an error."""
        domain, discovery = self._domain, self._discovery
        asleep = domain.wall_time.sleeping() if domain.wall_time is not None else ()
        pids = discovery.participants
        threads = max((domain.quiet.idle.cpp_executor_threads(pid, asleep) for pid in pids), default=0)
        self.cpp_threads = threads
        if discovery.joined:
            return
        why = ''
        if threads > 1:
            why = 'an executor with several threads may execute callbacks at the same time'
        elif threads and len(discovery.stand_ins) > 1:
            why = 'rclcpp calls timers of one of several nodes that are due at once in any order'
        elif domain.quiet.idle.polls_files:
            why = (
                'a thread waits for files with a timeout, as an event loop of asyncio, and what it does '
                'by itself is not waited for'
            )
        if threads and domain.quiet.idle.timed_executors and domain.wall_time is None:
            warn_of(domain, 'its executor waits with a timeout, as with a timer of create_wall_timer', 6)
        if why:
            warnings.warn(f'{domain.title}: {why}; check_repeats shows it', stacklevel=5)


def warn_of(domain: Domain, what: str, stacklevel: int = 6) -> None:
    """Warn of something that goes by wall time."""
    warnings.warn(
        f'{domain.title}: {what}: that is wall time, so what it does differs from run to run; '
        f'{SIMULATED}',
        stacklevel=stacklevel,
    )
