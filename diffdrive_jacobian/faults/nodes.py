"""Faults of nodes: killed, frozen, slow, with timers that jitter.

The name of a node without a slash at the beginning is taken to be in the namespace of the test, which is
`/` by default.
"""

from __future__ import annotations

from dataclasses import dataclass

from diffdrive_jacobian.faults.fault import Fault
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


@dataclass(frozen=True, repr=False)
class Kill(NodeFault):
    """The node is killed, as by SIGKILL: it stops without a last message, and what waits for it is lost.

    After `duration` the factory that made it (`Lockstep.create`) makes it again, with a fresh state.
    Without a duration it stays away. Others notice by the graph, and by its silence. What it published
    last is still under way; its latched messages are gone.
    """

    def install(self, injection: Injection) -> None:
        """Schedule the end of the node."""
        injection.kill(self.node)


@dataclass(frozen=True, repr=False)
class Hang(NodeFault):
    """The node is frozen, as between SIGSTOP and SIGCONT: none of its callbacks is executed.

    Messages and requests that arrive wait in its queues, of which a full one loses the oldest. When it
    continues, it processes what waits, in the order of arrival. A timer that expired meanwhile ticks
    once, and skips the other periods.
    """

    def install(self, injection: Injection) -> None:
        """Hold the callbacks of the node."""
        injection.hold(self.node)


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
        injection.slow(self.node, nanoseconds(self.seconds))


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
        rng = injection.rng(self.node)
        injection.delay_timers(self.node, lambda: nanoseconds(self.seconds * rng.random()))
