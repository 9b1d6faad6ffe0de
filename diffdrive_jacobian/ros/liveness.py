"""Detection of nodes in other processes that were killed or hang, within seconds.

DDS takes a participant that was killed for alive until its lease ends, 20 s with Fast DDS. A node that
serves its callbacks answers requests; every node of rclpy and rclcpp has a service for its parameters,
unless it was created without.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterable
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node

PERIOD = 0.5
"""Time between two requests (s)."""
LONGEST_STEP = 0.2
"""At most so much time counts from one look to the next (s)."""
PENDING = 20
"""Requests without an answer that are kept: a late answer counts as well."""


class Liveness:
    """Asks nodes for none of their parameters, again and again, and measures how long none answers.

    `silence` must be called several times a second while the asking node is spun.
    """

    def __init__(self, node: Node, names: Iterable[str]) -> None:
        """Create the clients.

        Args:
            node: The node that asks.
            names: Fully qualified names of the nodes that are asked.
        """
        self._clients = [node.create_client(GetParameters, f'{name}/get_parameters') for name in names]
        self._pending: deque[tuple[Any, Any]] = deque()
        self._silence = 0.0
        self._answered = False
        self._looked = time.monotonic()
        self._asked = -math.inf

    def silence(self) -> float:
        """Return the time since any of the nodes answered (s), and ask again if that is due.

        It is 0 until the first answer: nodes without the service do not count as silent. Time during
        which this process was held up itself does not count either.
        """
        now = time.monotonic()
        if self._answered:
            self._silence += min(now - self._looked, LONGEST_STEP)
        self._looked = now
        if now - self._asked >= PERIOD:
            self._asked = now
            self._ask()
        return self._silence

    def _ask(self) -> None:
        for client in self._clients:
            if client.service_is_ready():
                future = client.call_async(GetParameters.Request())
                future.add_done_callback(self._on_answer)
                self._pending.append((client, future))
        while len(self._pending) > PENDING:
            client, future = self._pending.popleft()
            client.remove_pending_request(future)

    def _on_answer(self, _: Any) -> None:
        self._answered = True
        self._silence = 0.0
