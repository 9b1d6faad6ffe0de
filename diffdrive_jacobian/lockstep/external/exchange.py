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

"""What passes between the world and a process that takes part, one delivery after the other.

The process gets the time, then one message, request or response. The world waits until it is quiet, and
forwards what it has sent. While one of its callbacks waits for a response of the world, other deliveries
are held.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._gate import FREE
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.lockstep.external.connecting import Connecting, warn_of
from diffdrive_jacobian.lockstep.external.discovery import Discovery, time_message
from diffdrive_jacobian.lockstep.external.domain import Domain
from diffdrive_jacobian.lockstep.external.linux import own_run_times
from diffdrive_jacobian.lockstep.external.presence import Presence
from diffdrive_jacobian.lockstep.external.quiet import Allowance
from diffdrive_jacobian.lockstep.external.relays import Arrived
from diffdrive_jacobian.lockstep.external.stand_in import StandIn
from diffdrive_jacobian.lockstep.external.waiting import Waiting
from diffdrive_jacobian.lockstep.external.wall_clock import WallClock
from diffdrive_jacobian.ros.rclpy_internals import graph_changed, raw_sender
from diffdrive_jacobian.time_units import NANOSECONDS

__tracebackhide__ = True

UNASKED = 100
"""Largest number of deliveries after which the graph is looked at, although nothing new was told."""
STUCK = 2 * NANOSECONDS
"""World time after which a callback that waits without a timeout is an error (ns)."""


class Exchange:
    """Delivers to a process, and forwards what it sends."""

    def __init__(
        self,
        domain: Domain,
        discovery: Discovery,
        presence: Presence,
        waiting: Waiting,
        connecting: Connecting,
        scheduler: Scheduler,
        *,
        on_nodes: Callable[[], None],
        on_end: Callable[[], None],
    ) -> None:
        """Start without deliveries.

        Args:
            domain: The domain of the process.
            discovery: Its nodes.
            presence: Whether they are still there.
            waiting: Waits for it.
            connecting: Connects its nodes.
            scheduler: Executes the nodes of the world.
            on_nodes: Adds nodes that have been discovered to the world.
            on_end: Called when a process with nodes has ended by itself.
        """
        self._domain, self._discovery, self._waiting = domain, discovery, waiting
        self._presence = presence
        self._connecting, self._scheduler = connecting, scheduler
        self._on_nodes, self._on_end = on_nodes, on_end
        self._clocks, self._agenda = scheduler.clocks, scheduler.agenda
        self._held: list[Callable[[], object]] = []
        self._given = -1
        """Time that the process has (ns)."""
        self._deliveries = 0
        self._listened: list[int] = []
        self._wall_clock: WallClock | None = None
        self._stuck: int | None = None
        """World time since which a callback has not returned (ns)."""

    def begin(self, clock_period: float) -> None:
        """Begin with the nodes that have joined: they get the time now, and in each period (s)."""
        if self._domain.wall_time is not None:
            self._wall_clock = WallClock(self._domain.wall_time, self._agenda, self._go_on)
        stand_in = self._stand_in()
        stand_in.create_timer(clock_period, self._give_time)
        stand_in.executor.create_task(self._forward_lasting)

    def _stand_in(self) -> StandIn:
        """Return the first node, in whose callbacks the process is waited for."""
        return next(iter(self._discovery.stand_ins.values()))

    def _forward_lasting(self) -> None:
        """Forward what the process has sent before it took part, and give it the time."""
        self._forward_kept()
        self._give_time()

    def _forward_kept(self) -> None:
        lasting, self._connecting.lasting = self._connecting.lasting, []
        forward(lasting)

    # --- To the process

    def deliver(self, send: Callable[[], object]) -> None:
        """Give the process the time, send something to it, and forward what it sends meanwhile."""
        self._give_time()
        self._exchange(send)

    def respond(self, send: Callable[[], object]) -> None:
        """Send a response to the process, and what had to wait for that."""
        if not self._domain.quiet.waits_in_callback:
            self._give_time()
        held, self._held = self._held, []
        for one in (send, *held):
            self._exchange(one, response=one is send)

    def _give_time(self) -> object:
        """Give the process the time, unless it has it. Return FREE if it has sent nothing."""
        now, sent = self._clocks.now, 0
        if self._wall_clock is not None:
            self._wall_clock.give(now)
        if now != self._given:
            self._given = now
            data = time_message(now)
            # One after the other, so that the nodes of a process do not act at the same time.
            for publisher in self._discovery.clock_publishers.values():
                sent += self._exchange(partial(raw_sender(publisher), data))
        while (
            self._discovery.joined
            and self._wall_clock is not None
            and (go_on := self._wall_clock.due()) is not None
        ):
            sent += self._exchange(go_on)
        self._check_callbacks()
        return None if sent else FREE

    def _exchange(self, send: Callable[[], object], *, response: bool = False) -> int:
        """Send something to the process, wait until it is quiet, and forward what it has sent.

        Args:
            send: Sends it.
            response: Whether it is a response. Others are held while a callback waits for one.

        Returns:
            How many messages it has sent.
        """
        domain, discovery, waiting = self._domain, self._discovery, self._waiting
        if not self._takes_part():
            return 0
        if domain.quiet.waits_in_callback:
            waiting.check_waits()
            if not response:
                self._held.append(send)
                return 0
        with waiting.uncounted():
            if discovery.services_changed:
                self._offer_called()
            waiting.refuse(waiting.take())
            try:
                send()
            except LockstepError:
                waiting.check_lost(now=True)
                raise
            waiting.wait()
            if domain.wall_time is not None:
                domain.wall_time.check(domain.title)
            arrived = waiting.take()
            waiting.check_lost()
            for sent in discovery.sent.values():
                sent.clear()
        forward(arrived)
        if not self._takes_part():
            # Who observes what it has sent has ended it.
            return len(arrived)
        if any(map(domain.quiet.threads.has_ended, (domain.child.root, *discovery.participants))):
            self._on_end()
        elif self._may_have_changed() and graph_changed(domain.node):
            self._learn_more()
        if discovery.joined and self._wall_clock is not None:
            self._wall_clock.plan()
        return len(arrived)

    def _takes_part(self) -> bool:
        """Return whether the process is in the world, which callbacks may end."""
        return self._discovery.joined

    def _offer_called(self) -> None:
        """Offer the process the services of the world, of which it may use new ones at once."""
        known = set(self._discovery.relays)
        self._discovery.offer_called()
        if self._discovery.relays.keys() != known:
            self._connecting.confirm(Allowance(self._domain.quiet, self._domain.command.timeout))
            self._waiting.wait()

    # --- New nodes, topics and services

    def _may_have_changed(self) -> bool:
        """Return whether the process may have told something new of its nodes: to ask takes time."""
        self._deliveries += 1
        listeners = self._domain.listeners
        before, self._listened = self._listened, own_run_times(listeners)
        return before != self._listened or not listeners or self._deliveries % UNASKED == 0

    def _learn_more(self) -> None:
        """Create what is needed for topics and services that the process has created meanwhile."""
        discovery = self._discovery
        known = len(discovery.relays)
        discovery.learn()
        discovery.share_topics()
        discovery.check_order()
        self._presence.check()
        if len(discovery.relays) > known:
            self._connecting.connect()
            self._on_nodes()
            self._forward_kept()

    # --- Callbacks that do not return

    def check(self) -> bool:
        """Check that it runs, lost nothing, and has sent nothing while nothing was delivered to it.

        Returns:
            Whether it does something still: a callback waits for a response that does not come now.
        """
        self._domain.child.check_running(self._discovery.names)
        if self._domain.quiet.waits_in_callback:
            self._stand_in().executor.create_task(self._end_waits)
            return True
        self._waiting.refuse(self._waiting.take())
        self._waiting.check_lost()
        return False

    def _end_waits(self) -> None:
        """Wait until callbacks that wait for responses have waited in vain, and go on."""
        with self._waiting.uncounted():
            self._waiting.wait(lambda: False)
        held, self._held = self._held, []
        forward(self._waiting.take())
        self._waiting.check_lost()
        for send in held:
            self._exchange(send)

    def _check_callbacks(self) -> None:
        """Check that callbacks return, unless they wait for a response or, by a timeout, for time."""
        domain, discovery, now = self._domain, self._discovery, self._agenda.now
        asleep = domain.wall_time.sleeping() if domain.wall_time is not None else set[int]()
        # Threads that sleep in an idle process, too, end no callback of it: as one that writes logs.
        waits = bool(asleep - self._connecting.sleepers)
        if not discovery.joined or waits or discovery.unanswered or not domain.quiet.idle.is_stuck():
            self._stuck = None
        elif self._stuck is None:
            self._stuck = now
        elif now - self._stuck >= STUCK:
            raise LockstepError(
                f'a callback of {discovery.names} has not returned since '
                f'{self._stuck / NANOSECONDS:g} s: it waits, without a timeout, for something else than '
                f'a message of the world, as for a mutex that is locked twice\n{domain.child.describe()}'
            )
        new = domain.quiet.idle.new_thread_waits and domain.wall_time is None
        if new and discovery.joined and self._connecting.cpp_threads:
            self._connecting.cpp_threads = 0
            warn_of(domain, 'a thread that it has started meanwhile waits with a timeout, as by a Rate')

    def _go_on(self) -> None:
        """Give the process its wall time, when the time has come for which it waits."""
        if self._discovery.joined:
            self._stand_in().executor.create_task(self._give_time)


def forward(arrived: Sequence[Arrived]) -> None:
    """Send the world what has arrived from a process."""
    for one in arrived:
        one.forward()
