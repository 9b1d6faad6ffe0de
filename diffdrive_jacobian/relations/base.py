"""What a relation is: how nodes under test must answer the image of what they have heard."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from diffdrive_jacobian.faults.fault import Expression, Fault
from diffdrive_jacobian.lockstep._border import Endpoints, Message
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.messages.names import full_name
from diffdrive_jacobian.numerics.checks import Positive
from diffdrive_jacobian.relations.imaging import Imaging
from diffdrive_jacobian.relations.perturbed import Perturbed

TOLERANCE = 1e-6
"""Default tolerance of numbers, relative to those above 1."""
PAIRS = 2
"""Number of pairs of worlds that show whether rounding decides."""


@dataclass(frozen=True, repr=False)
class Relation(Imaging, Expression, ABC):
    """What nodes say must be the image of what they said, if they hear the image of what they heard.

    The nodes under test are run again in the same world. They hear the images of the same messages, and
    what they say is compared, topic by topic. All others hear what was said in the first world.
    Subclasses are decorated with `@dataclass(frozen=True, repr=False)`, and define `image`.

    Attributes:
        node: Name of the node under test, resolved as by `Lockstep.find`. Relations that find their
            nodes by a topic need none.
        tolerance: Largest difference of numbers; above 1 relative to their size. Times may differ by
            1 us.
    """

    node: str = field(default='', kw_only=True)
    tolerance: Positive = field(default=TOLERANCE, kw_only=True)

    @abstractmethod
    def image(self, topic: str, message: Any) -> Any:
        """Return the image of a message, which may be changed in place.

        Args:
            topic: Full name of its topic.
            message: A message that a node under test hears, or has said.
        """

    def heard(self, topic: str, message: Any) -> list[tuple[float, Any]]:
        """Return what a node under test hears instead of a message: messages with their delays (s)."""
        return [(0.0, self.image(topic, message))]

    def said(self, topic: str, message: Any) -> Any:
        """Return what a node under test must say instead of a message."""
        return self.image(topic, message)

    def nearby(self) -> list[Imaging]:
        """Return images of the world that differ by little more than rounding, if at all.

        Where one of them differs from the world, rounding may decide.
        """
        # In one of a pair each number grows by what it shrinks by in the other.
        return [Perturbed(seed, sign, self.tolerance) for seed in range(PAIRS) for sign in (1, -1)]

    def check(self, messages: Sequence[Message], namespace: str) -> None:
        """Check that it can be compared with what was said in a world of a namespace.

        Raises:
            LockstepError: It cannot.
        """

    def is_disturbed_by(self, fault: Fault) -> bool:
        """Return whether it need not hold with a fault. Both worlds are without it then."""
        return False

    def under_test(self, nodes: Mapping[str, Endpoints], namespace: str) -> set[str]:
        """Return the full names of the nodes under test.

        Args:
            nodes: All nodes of the world by their full names, without those of the test.
            namespace: Namespace of the world.

        Raises:
            LockstepError: There is none.
        """
        if not self.node:
            raise LockstepError(f"{self!r} needs the node under test: {type(self).__name__}(node='...')")
        name = self.node if self.node.startswith('/') else full_name(namespace, self.node)
        if name not in nodes:
            raise LockstepError(f'{self!r}: there is no node {name}; nodes: {_listed(nodes)}')
        return {name}

    def _with_topic(
        self, nodes: Mapping[str, Endpoints], namespace: str, topic: str, side: str
    ) -> set[str]:
        """Return the nodes that have `published` or `subscribed` to a topic, or that which is named."""
        if self.node:
            return Relation.under_test(self, nodes, namespace)
        name = topic if topic.startswith('/') else full_name(namespace, topic)
        found = {one for one, endpoints in nodes.items() if name in getattr(endpoints, side)}
        if not found:
            verb = 'publishes' if side == 'published' else 'is subscribed to'
            raise LockstepError(f'{self!r}: no node {verb} {name}; nodes: {_listed(nodes)}')
        return found


def _listed(nodes: Mapping[str, Endpoints]) -> str:
    return ', '.join(nodes) or 'none'
