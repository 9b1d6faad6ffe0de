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

"""What a relation is: how nodes under test must answer the image of what they have heard."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

from diffdrive_jacobian.faults.fault import Expression, Fault
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.messages.names import full_name
from diffdrive_jacobian.numerics.checks import Positive
from diffdrive_jacobian.relations.imaging import Imaging
from diffdrive_jacobian.relations.perturbed import Perturbed
from diffdrive_jacobian.relations.worlds import Ran

TOLERANCE = 1e-6
"""Default tolerance of numbers: absolute up to 1, relative above."""
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
        tolerance: Largest difference of numbers: absolute up to 1, relative above. Times may differ by
            1 us. What a node says twice at one time counts once.
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

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of topics that it knows, as a node of the world gives them."""
        return ()

    def fitted(self, first: Ran) -> Relation:
        """Return it as it fits to a world.

        Raises:
            LockstepError: It does not.
        """
        return self

    def nearby(self, first: Ran) -> list[Imaging]:
        """Return images that differ from a world by little more than rounding, if at all.

        Where one of them differs from the world, rounding may decide.
        """
        # The two worlds of a pair change each number by opposite amounts.
        return [Perturbed(seed, sign, self.tolerance) for seed in range(PAIRS) for sign in (1, -1)]

    def is_disturbed_by(self, fault: Fault) -> bool:
        """Return whether it need not hold with a fault. Both worlds are without it then."""
        return False

    def under_test(self, first: Ran) -> set[str]:
        """Return the full names of the nodes of a world that are under test.

        Raises:
            LockstepError: There is none.
        """
        there = f'nodes: {", ".join(first.nodes) or "none"}'
        if self.node:
            name = self.node if self.node.startswith('/') else full_name(first.namespace, self.node)
            if name not in first.nodes:
                raise LockstepError(f'{self!r}: there is no node {name}; {there}')
            return {name}
        found = self._at_topic(first)
        if not found:
            raise LockstepError(f'{self!r}: no node has the topic {first.full(self.topics[0])}; {there}')
        return found

    def _at_topic(self, first: Ran) -> set[str]:
        """Return the nodes under test if none is named."""
        raise LockstepError(f"{self!r} needs the node under test: {type(self).__name__}(node='...')")
