"""Faults of nodes: killed, frozen, slow, with timers that jitter.

The name of a node without a slash at the beginning is taken to be in the namespace of the test, which is
`/` by default.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rclpy.node import Node

from diffdrive_jacobian.faults.fault import Fault, Undo
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._injection import Injection
from diffdrive_jacobian.numerics.checks import Positive
from diffdrive_jacobian.numerics.fields import Name
from diffdrive_jacobian.time_units import nanoseconds


@dataclass(frozen=True, repr=False)
class NodeFault(Fault):
    """A fault of one node.

    Attributes:
        node: Name of the node.
    """

    node: Name

    @property
    def affected_node(self) -> str:
        """Name of the node."""
        return self.node


@dataclass(frozen=True, repr=False)
class Kill(NodeFault):
    """The node is killed, as by SIGKILL: it stops without a last message, and what waits for it is lost.

    After `duration` the factory that made it (`Lockstep.create`) makes it again, with a fresh state.
    Without a duration it stays away. Others notice by the graph, and by its silence. What it published
    last is still under way; its latched messages are gone.
    """

    def install(self, injection: Injection) -> None:
        """Destroy the node when the fault begins, and create it again when it ends."""
        world, name = injection.world, injection.gate(self.node).name
        # The faults because of which the node is not there.
        deaths = world.shared[f'deaths of {name}']

        def die() -> Undo:
            deaths.append(self)
            victim = world.find(name)
            if victim is None:
                injection.note('the node is not there')
                return rise
            if math.isfinite(self.duration) and not world.restartable(name):
                raise LockstepError(
                    f'{self!r} cannot start {name} again: create it with Lockstep.create'
                )
            world.kill(victim)
            injection.note(f'{name} is killed')
            return rise

        def rise() -> None:
            deaths.remove(self)
            # One that was created after the fault began was not killed.
            if not deaths and world.restartable(name) and world.find(name) is None:
                world.restart(name)
                injection.note(f'{name} is started again')

        injection.during(die)


@dataclass(frozen=True, repr=False)
class Hang(NodeFault):
    """The node is frozen, as between SIGSTOP and SIGCONT: none of its callbacks is executed.

    Messages and requests that arrive wait in its queues, of which a full one loses the oldest. When it
    continues, it processes what waits, in the order of arrival. A timer that expired meanwhile ticks
    once, and skips the other periods.
    """

    def install(self, injection: Injection) -> None:
        """Hold the callbacks of the node."""
        gate = injection.gate(self.node)

        def freeze() -> Undo:
            gate.hold()
            return thaw

        def thaw() -> None:
            what = [f'{len(gate.waiting)} messages and requests wait', gate.lost()]
            injection.note(', '.join(filter(None, what)))
            gate.release()

        injection.during(freeze)

    def reaction_delay(self, node: Node, since: float, now: float) -> float:
        """Return for how long the node was frozen (s)."""
        return max(self.overlap(since, now), 0.0)


@dataclass(frozen=True, repr=False)
class Slow(NodeFault):
    """Each callback of the node takes simulated time.

    What a callback publishes or responds leaves `seconds` after it began. Until then the node is busy:
    what arrives waits in its queues, of which a full one loses the oldest. Then comes whatever has
    waited longest, a message, a request or a timer. The callback reads the clock of its beginning.
    Its requests to services leave at once, and what a coroutine does after its first `await` takes no
    time. The same holds for timers on wall time.

    Attributes:
        seconds: Duration of each callback (s).
    """

    seconds: Positive

    def install(self, injection: Injection) -> None:
        """Set the duration of the callbacks."""
        gate, cost = injection.gate(self.node), nanoseconds(self.seconds)

        def slow() -> Undo:
            gate.slow(cost)
            return quicken

        def quicken() -> None:
            gate.quicken(cost)
            if lost := gate.lost():
                injection.note(lost)

        injection.during(slow)

    @property
    def longest_delay(self) -> float:
        """Duration of a callback (s)."""
        return self.seconds

    def reaction_delay(self, node: Node, since: float, now: float) -> float:
        """Return the duration of the callbacks that may come first (s).

        One that has begun, others that wait, and that of the timer, which may expire early.
        """
        longest = (3.0 + len(list(node.timers))) * self.seconds
        return longest if self.overlap(since, now) > -longest else 0.0


@dataclass(frozen=True, repr=False)
class TimerJitter(NodeFault):
    """Each tick of the node's timers comes late, by a random time between 0 and `seconds`.

    The ticks after it are not shifted. A tick that is more than a period late replaces those between.

    Attributes:
        seconds: Longest delay (s), uniformly distributed.
    """

    seconds: Positive

    def install(self, injection: Injection) -> None:
        """Delay the ticks of the timers."""
        rng, delays = injection.rng(self.node), injection.gate(self.node).timer_delays

        def draw() -> int:
            return nanoseconds(self.seconds * rng.random())

        def begin() -> Undo:
            delays.append(draw)
            return lambda: delays.remove(draw)

        injection.during(begin)

    @property
    def longest_delay(self) -> float:
        """Longest delay of a tick (s)."""
        return self.seconds

    def reaction_delay(self, node: Node, since: float, now: float) -> float:
        """Return the longest delay of a tick (s)."""
        return self.seconds if self.overlap(since, now) > -self.seconds else 0.0
