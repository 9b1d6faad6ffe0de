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

"""Whether a world does the same each time."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from itertools import zip_longest
from typing import Any

from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message

from diffdrive_jacobian.exploration.trial import MessageDigest
from diffdrive_jacobian.lockstep._errors import LockstepError
from diffdrive_jacobian.lockstep._report import brief
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.numerics.checks import integer
from diffdrive_jacobian.time_units import NANOSECONDS


class _Messages(MessageDigest):
    """Keeps each message as text, and the hash after it."""

    def __init__(self, world: Lockstep, without: Collection[str]) -> None:
        super().__init__(world, without)
        self.all: list[tuple[int, str, str, str]] = []

    def _add(self, publisher: Publisher, message: Any) -> None:
        super()._add(publisher, message)
        if isinstance(message, bytes):
            with suppress(RuntimeError):
                message = deserialize_message(message, publisher.msg_type)
        self.all.append((self._world.now, publisher.topic_name, brief(message), self.value()))


def check_repeats(
    scenario: Callable[[Lockstep], object],
    *,
    runs: int = 2,
    args: Sequence[str] = (),
    without: Collection[str] = (),
) -> None:
    """Run a scenario in worlds of their own, and compare all messages, bit for bit.

    For nodes in other processes: what they send by themselves is an error only if nothing is being
    delivered to them, and chance decides that.

    Args:
        scenario: Receives a new `Lockstep`, adds nodes and lets time pass.
        runs: Number of runs, at least 2.
        args: ROS arguments for all nodes, as of `Lockstep`.
        without: Topics that are not compared, besides `/clock`, `/rosout` and `/parameter_events`.

    Raises:
        ValueError: `runs` is less than 2, or `without` is not names of topics such as '/odom'.
        LockstepError: Two runs differ. The message names the first message that does.
    """
    integer('runs', runs, 2)
    if isinstance(without, str) or any(not str(topic).startswith('/') for topic in without):
        raise ValueError(f"without must be names of topics such as '/odom', got {without!r}")
    first: list[tuple[int, str, str, str]] | None = None
    for number in range(runs):
        with Lockstep(args) as world:
            messages = _Messages(world, without)
            with messages:
                scenario(world)
                world.finish()
        if first is None:
            first = messages.all
        pairs = zip_longest(first, messages.all)
        for index, (one, other) in enumerate(pairs):
            if one != other:
                raise LockstepError(
                    f'run {number + 1} differs from run 1, first in message {index + 1}: '
                    f'{_text(other)} instead of {_text(one)}'
                )


def _text(message: tuple[int, str, str, str] | None) -> str:
    if message is None:
        return 'none'
    time, topic, text, digest = message
    return f'{topic} at {time / NANOSECONDS:g} s: {text} (hash of all so far {digest[:8]})'
