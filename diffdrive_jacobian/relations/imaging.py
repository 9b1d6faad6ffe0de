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

"""How a world is run again: what its nodes hear, and what they must say then."""

from __future__ import annotations

from typing import Any, ClassVar

from diffdrive_jacobian.lockstep.world import Lockstep


class Imaging:
    """What makes the image of a world. By default it is the same. Base class of relations.

    Attributes:
        tolerance: Largest difference of numbers, above 1 relative to their size.
    """

    tolerance: float

    keeps_order: ClassVar[bool] = False
    """Whether what a node hears later waits for what comes late."""
    whole_world: ClassVar[bool] = False
    """Whether all nodes run again, and hear each other."""

    def in_world(self, world: Lockstep) -> Imaging:
        """Return it with the full names that its topics have in a world."""
        return self

    def heard(self, topic: str, message: Any) -> list[tuple[float, Any]]:
        """Return what a node under test hears instead of a message: messages with their delays (s)."""
        return [(0.0, message)]

    def said(self, topic: str, message: Any) -> Any:
        """Return what a node under test must say instead of a message."""
        return message

    def renamed(self, name: str, namespace: str) -> str:
        """Return the full name of a node or a topic in the image of a world in a namespace."""
        return name

    def compared(self, message: Any, namespace: str) -> Any:
        """Return what a node has said in a world of a namespace as it is compared."""
        return message

    @property
    def early(self) -> float:
        """How much earlier the image may say something (s)."""
        return 0.0

    @property
    def late(self) -> float:
        """How much later the image may say something (s)."""
        return 0.0

    @property
    def longest_move(self) -> float:
        """How far an event may be moved (s). What comes after it is not compared."""
        return 0.0

    @property
    def start(self) -> float:
        """How much later the clock of the nodes shows at the start (s)."""
        return 0.0

    @property
    def args(self) -> tuple[str, ...]:
        """ROS arguments of all nodes, before those of the world."""
        return ()
