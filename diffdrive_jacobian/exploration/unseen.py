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

"""What an exploration has seen of its worlds, and so what it could not see."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

from rclpy.exceptions import InvalidHandle

from diffdrive_jacobian.faults import Fault, ParameterChange
from diffdrive_jacobian.lockstep._border import Endpoints, endpoints_of, topics_of
from diffdrive_jacobian.lockstep._injection import absolute_name
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.messages.topics import NOT_OF_ROBOTS

SAME = ('use_sim_time', 'start_type_description_service')
"""Parameters that are the same in each world, because lockstep sets them."""
LONGEST = 100
"""Length beyond which the value of a parameter is cut (characters)."""
NAMED = 5
"""Number of parameters of a node that are named in a line."""


@dataclass(frozen=True)
class Seen:
    """What one world has had. All names are full."""

    nodes: Mapping[str, Endpoints] = field(default_factory=dict)
    said: frozenset[str] = frozenset()
    """Topics with messages."""
    observed: frozenset[str] = frozenset()
    """Topics that a property observes."""
    faulted: frozenset[str] = frozenset()
    """Nodes and topics that a fault affects."""
    changed: frozenset[tuple[str, str]] = frozenset()
    """Parameters that a fault changes, by node and name."""
    parameters: Mapping[tuple[str, str], str] = field(default_factory=dict)
    """Value of each parameter, by node and name."""


class Watcher:
    """Notes what a world has."""

    def __init__(self, world: Lockstep) -> None:
        """Begin, before there are nodes."""
        self._world = world
        self._nodes = endpoints_of(world)

    def seen(self, faults: Iterable[Fault]) -> Seen:
        """Return what it had until now."""
        own = self._world.node
        faulted, changed = set(), set()
        for one in faults:
            if topic := getattr(one, 'topic', ''):
                faulted.add(own.resolve_topic_name(topic))
            if one.affected_node:
                node = absolute_name(one.affected_node, own)
                faulted.add(node)
                if isinstance(one, ParameterChange):
                    changed.add((node, one.name))
        said, observed = topics_of(self._world)
        return Seen(
            nodes=self._nodes,
            said=said,
            observed=observed,
            faulted=frozenset(faulted),
            changed=frozenset(changed),
            parameters=self._parameters(),
        )

    def _parameters(self) -> dict[tuple[str, str], str]:
        values = {}
        for node in self._world.nodes:
            try:
                name = node.get_fully_qualified_name()
                found = node.get_parameters_by_prefix('') if name in self._nodes else {}
            except InvalidHandle:
                continue
            for parameter, one in found.items():
                if parameter not in SAME and not parameter.startswith('qos_overrides.'):
                    values[name, parameter] = f'{one.value!r:.{LONGEST}}'
        return values


@dataclass(frozen=True)
class Unseen:
    """What no world of an exploration has touched; `print` shows it. All names are full."""

    nodes: tuple[str, ...] = ()
    """Nodes that no fault affected."""
    topics: tuple[str, ...] = ()
    """Topics that no fault affected, of those that a node is subscribed to."""
    silent: tuple[str, ...] = ()
    """Topics without a message."""
    unchecked: tuple[str, ...] = ()
    """Topics with messages that neither a property observed nor a relation compared."""
    parameters: tuple[tuple[str, str], ...] = ()
    """Parameters that had the same value in all worlds, each with its node before it."""

    def __str__(self) -> str:
        """Return a line for each kind."""
        count = Counter(node for node, _ in self.parameters)
        listed = []
        for node in count:
            names = [name for one, name in self.parameters if one == node]
            more = ', ...' if len(names) > NAMED else ''
            listed.append(f'{node} {count[node]} ({", ".join(names[:NAMED])}{more})')
        lines = {
            'nodes that no fault affected': self.nodes,
            'topics that no fault affected': self.topics,
            'topics without a message': self.silent,
            'topics that nothing checked': self.unchecked,
            'parameters with one value': listed,
        }
        return '\n'.join(f'  {what}: {", ".join(names)}' for what, names in lines.items() if names)


class Summary:
    """What all worlds together have had."""

    def __init__(self) -> None:
        """Start without worlds."""
        self._nodes: set[str] = set()
        self._published: set[str] = set()
        self._subscribed: set[str] = set()
        self._said: set[str] = set()
        self._checked: set[str] = set()
        self._faulted: set[str] = set()
        self._changed: set[tuple[str, str]] = set()
        self._values: defaultdict[tuple[str, str], set[str]] = defaultdict(set)

    def add(self, seen: Seen, compared: Collection[str]) -> None:
        """Add a world, and the topics that relations compared in it."""
        self._nodes.update(seen.nodes)
        for endpoints in seen.nodes.values():
            self._published |= endpoints.published
            self._subscribed |= endpoints.subscribed
        self._said |= {*seen.said, *compared}
        self._changed |= seen.changed
        self._checked |= {*seen.observed, *compared}
        self._faulted |= seen.faulted
        for key, value in seen.parameters.items():
            self._values[key].add(value)

    def unseen(self, worlds: int, faults: int) -> Unseen:
        """Return what they had not, with the numbers of worlds and of their faults.

        After one world all parameters have one value, and without faults nothing was affected.
        """
        known = self._published | self._subscribed
        ours = known.difference(NOT_OF_ROBOTS)
        same = [
            key for key, values in self._values.items() if len(values) == 1 and key not in self._changed
        ]
        return Unseen(
            nodes=tuple(sorted(self._nodes - self._faulted)) if faults else (),
            topics=tuple(sorted((self._subscribed & ours) - self._faulted)) if faults else (),
            silent=tuple(sorted(ours - self._said)),
            unchecked=tuple(sorted((ours & self._said) - self._checked)),
            parameters=tuple(sorted(same)) if worlds > 1 else (),
        )
