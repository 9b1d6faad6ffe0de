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

"""A process whose nodes take part in a lockstep world, unchanged, each with a node that stands for it.

Each process has a ROS domain of its own (`domain`), in which the world has an endpoint for each of its
topics and services (`discovery`, `connecting`). So no process receives what another one sends directly.
Names stay, but for /clock and for topics that several nodes of a process share: those are remapped below
the name of each node. In the world stands a `StandIn` for each of its nodes, with the same name, topics
and services. What that receives is sent to the process, one message at a time (`exchange`), and the
world waits until the process is quiet (`waiting`, `quiet`). What it has sent meanwhile is published by
the stand-in. So faults, properties and recordings treat it as any other node.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from rclpy.node import Node

from diffdrive_jacobian.lockstep._clock import MAX_SECONDS
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._link import Link, Stage
from diffdrive_jacobian.lockstep._nodes import Nodes
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.lockstep._simulated_time import checked_nanoseconds
from diffdrive_jacobian.lockstep.external import relays
from diffdrive_jacobian.lockstep.external.command import Command
from diffdrive_jacobian.lockstep.external.connecting import Connecting, UnmatchedError
from diffdrive_jacobian.lockstep.external.discovery import Discovery, ForeignNodeError
from diffdrive_jacobian.lockstep.external.domain import Domain
from diffdrive_jacobian.lockstep.external.exchange import Exchange, forward
from diffdrive_jacobian.lockstep.external.presence import PERIOD, Presence
from diffdrive_jacobian.lockstep.external.process import CLOSING, ExternalProcess
from diffdrive_jacobian.lockstep.external.quiet import Allowance
from diffdrive_jacobian.lockstep.external.relays import TOPIC
from diffdrive_jacobian.lockstep.external.stand_in import StandIn
from diffdrive_jacobian.lockstep.external.waiting import Waiting, uncounted
from diffdrive_jacobian.messages.topics import CLOCK

__tracebackhide__ = True

MATCHING = 5.0
"""Time after which a process is started again if endpoints that were discovered are not matched (s)."""
END = 2.0
"""Time in which a process ends after a process of its nodes has (s)."""
WAKES = 20
"""How often a process that is to end is woken up before real time goes on in it."""
ATTEMPTS = 2
"""Number of starts, if another program comes into the domain, or endpoints are not matched."""


class NodeProcess:
    """A process with nodes in the world, as of `Lockstep.start`. It is ended with the world."""

    def __init__(
        self,
        command: Command,
        nodes: Nodes,
        scheduler: Scheduler,
        extend: Callable[[float], None],
        is_open: Callable[[], bool],
    ) -> None:
        """Start nothing yet.

        Args:
            command: How to start it.
            nodes: The nodes of the world.
            scheduler: Executes the nodes.
            extend: Receives the wall time (s) that was spent waiting for the process.
            is_open: Returns whether the world was not closed.
        """
        self._command, self._nodes, self._scheduler = command, nodes, scheduler
        self._extend, self._is_open = extend, is_open
        self._ended: list[ExternalProcess] = []
        self._names: set[str] = set()
        """Of all nodes that it has had."""
        self._apart = {CLOCK} if command.use_sim_time else set[str]()
        """Topics of which each of its nodes has its own."""
        self._wakes = 0
        self._run: _Run | None = None
        scheduler.links.add_stages(self._drop_echoes, first=True)
        nodes.on_change.append(self._on_change)
        self.child: ExternalProcess

    # --- What the test sees

    @property
    def nodes(self) -> list[Node]:
        """The nodes of the world that stand for those of the process."""
        return [] if self._run is None else list(self._run.discovery.stand_ins.values())

    @property
    def pid(self) -> int:
        """Process id."""
        return self.child.pid

    @property
    def returncode(self) -> int | None:
        """Exit code, negative if a signal ended it. None: it runs. Its children end with it."""
        return self.child.returncode

    @property
    def stdout(self) -> str:
        """What it has printed on the standard output, also before a fault has started it again."""
        return self._printed(0)

    @property
    def stderr(self) -> str:
        """What it has printed on the standard error stream, as `stdout`."""
        return self._printed(1)

    def _printed(self, number: int) -> str:
        # The last one also if it could not be started again.
        return ''.join(one.printed(number) for one in dict.fromkeys([*self._ended, self.child]))

    @property
    def command(self) -> str:
        """The command line."""
        return self.child.command

    def describe(self) -> str:
        """Return its state, and the end of what it printed."""
        return self.child.describe()

    def signal(self, number: int) -> None:
        """Send a signal to it and its children. Nothing happens if it has ended."""
        self.child.signal(number)

    def stop(self, timeout: float = CLOSING) -> int:
        """End it by SIGINT, and kill it if it does not end. Return the exit code.

        What it publishes then is received by the others, unless it ends at the same moment. A fault does
        not start it again.

        Args:
            timeout: Longest time for its end (s).
        """
        checked_nanoseconds('timeout', timeout)
        self._do_not_restart()
        code = self._stop(timeout)
        self._scheduler.forget_destroyed()
        return code

    def kill(self) -> None:
        """Kill it. Nothing that was sent to it is processed, and a fault does not start it again."""
        self._do_not_restart()
        self._kill()
        self._scheduler.forget_destroyed()

    def be_patient(self) -> None:
        """Wait for it as long as it takes: somebody debugs it."""
        self._command.patience = self._command.timeout = float(MAX_SECONDS)

    # --- Start

    def start(self) -> list[StandIn]:
        """Start the process, wait until its nodes are discovered, and return their stand-ins.

        Raises:
            LockstepError: They are not within the timeout, or cannot take part.
        """
        if hasattr(self, 'child'):
            self.child.close()
            self._ended.append(self.child)
        attempt = 0
        with uncounted(self._command, self._extend):
            while True:
                try:
                    run = self._run = self._launch()
                    run.connecting.connect(MATCHING if attempt < ATTEMPTS - 1 else math.inf)
                    # Others may have been discovered meanwhile.
                    run.discovery.learn()
                    if not run.discovery.share_topics():
                        return list(run.discovery.stand_ins.values())
                    # Again, with topics of their own.
                    self.close()
                except BaseException as error:
                    self.close()
                    attempt += 1
                    again = isinstance(error, (ForeignNodeError, UnmatchedError))
                    if not again or attempt == ATTEMPTS:
                        raise

    def _launch(self) -> _Run:
        """Start the process, in a domain of its own."""
        clocks = self._scheduler.clocks
        domain = Domain(self._command, self._apart, clocks.now, self._wake)
        self.child = domain.child
        discovery = Discovery(
            domain,
            self._scheduler,
            self._apart,
            end=self._on_destroyed,
            deliver=lambda send: exchange.deliver(send),
            respond=lambda send: exchange.respond(send),
        )
        presence = Presence(domain, discovery)
        waiting = Waiting(domain, discovery, presence, clocks, self._extend)
        connecting = Connecting(domain, discovery, presence, waiting, clocks)
        exchange = Exchange(
            domain,
            discovery,
            presence,
            waiting,
            connecting,
            self._scheduler,
            on_nodes=self._add_nodes,
            on_end=self._on_end,
        )
        return _Run(domain, discovery, waiting, connecting, exchange)

    def join(self) -> None:
        """Add the nodes to the world. They receive the time."""
        self._add_nodes()
        if self._run is not None:
            self._run.discovery.joined = True
            self._run.exchange.begin(self._command.clock_period)

    def _add_nodes(self) -> None:
        for node in self.nodes:
            name = node.get_fully_qualified_name()
            self._nodes.created(node, partial(self._restart, name))
            self._names.add(name)
            if node not in self._scheduler.nodes:
                self._nodes.check_new(node)
                self._nodes.add(node, observer=False)

    def _restart(self, name: str) -> Node:
        """Start the process again, after a fault has killed it. Return the node of a name."""
        stand_ins = self.start()
        found = next((one for one in stand_ins if one.get_fully_qualified_name() == name), None)
        if found is None:
            raise LockstepError(f'{self.child.title} was started again, and has no node {name} now')
        self.join()
        return found

    # --- In the world

    def check(self) -> bool:
        """Check that it runs, lost nothing, and has sent nothing while nothing was delivered to it.

        Returns:
            Whether it does something still: a callback waits for a response that does not come now.
        """
        run = self._run
        if run is None or not run.discovery.joined:
            return False
        if self.child.has_ended_well:
            # By itself, or by a signal of the test, since something was delivered to it.
            self._leave()
            return True
        return run.exchange.check()

    def check_lost(self) -> None:
        """Raise LockstepError if messages between the world and the process are known to be lost."""
        if self._run is not None:
            self._run.waiting.check_lost(now=True)

    def _on_change(self) -> None:
        if self._run is not None:
            self._run.discovery.services_changed = True

    def _drop_echoes(self, link: Link) -> Stage | None:
        """Return the stage that keeps from the process what it has received directly."""
        if self._run is None or link.owner not in self.nodes:
            return None
        topics = self._run.discovery.topics
        name = topics.get((link.owner, link.topic), '')
        if (TOPIC, name) not in self._run.discovery.relays:
            return None
        own = [node for (node, topic), other in topics.items() if other == name]
        return relays.without_echo(
            self._scheduler.links.observers_of_published(link.topic).append,
            lambda publisher: any(publisher in node.publishers for node in own),
        )

    # --- End

    def _stop(self, timeout: float = CLOSING) -> int:
        code = self.child.stop(timeout)
        run = self._run
        if run is not None and run.discovery.joined:
            run.waiting.wait()
            forward(run.waiting.take())
            run.waiting.check_lost(now=True)
        self._leave()
        return code

    def _kill(self) -> None:
        self._scheduler.killed.update(self.nodes)
        self.child.kill()
        self._leave()

    def _wake(self) -> None:
        """Send the time that the nodes have, for nothing but to wake them up, so that they end."""
        self._wakes += 1
        run = self._run
        if run is None:
            return
        # First it notices the signal, and then who sleeps looks whether to go on.
        if run.domain.wall_time is not None and self._wakes > WAKES:
            run.domain.wall_time.end()
        if run.discovery.joined:
            run.discovery.send_time(max(1, self._scheduler.clocks.now))

    def _do_not_restart(self) -> None:
        """Do not let a fault start it again."""
        for name in self._names:
            self._nodes.forget(name)

    def _on_destroyed(self, stand_in: StandIn) -> None:
        """End the process: a test or a fault has destroyed one of its nodes."""
        if not self._is_open() or stand_in not in self.nodes:
            return
        if stand_in in self._scheduler.killed:
            self._kill()
        else:
            self._stop()

    def _on_end(self) -> None:
        """Note that the process has ended while something was delivered to it."""
        run = self._run
        if run is None:
            return
        allowance = Allowance(run.domain.quiet, END)
        while self.child.returncode is None and not allowance.is_used_up():
            time.sleep(PERIOD)
        if self.child.has_ended_well:
            self._leave()
            return
        self.child.check_running(run.discovery.names)
        raise LockstepError(f'a process with a node has ended: {self.describe()}')

    def _leave(self) -> None:
        """Remove the nodes from the world."""
        run, self._run = self._run, None
        if run is not None:
            run.discovery.close()
            run.domain.close()
            self._wakes = 0

    def close(self) -> None:
        """Kill the process if it has not ended, and forget its nodes."""
        if hasattr(self, 'child'):
            self.child.kill()
            self.child.close()
        self._leave()


class _Run(NamedTuple):
    """The parts of one run of a process, from its start to its end."""

    domain: Domain
    discovery: Discovery
    waiting: Waiting
    connecting: Connecting
    exchange: Exchange
