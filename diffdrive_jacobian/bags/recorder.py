"""The node that records: it hears topics as raw CDR and hands them to a journal."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from diffdrive_jacobian.bags.definitions import UnknownTypeError, definition, message_class
from diffdrive_jacobian.bags.journal import Channel, JournalWriter, Message, Text
from diffdrive_jacobian.bags.qos import to_fields, to_hear_all
from diffdrive_jacobian.ros.parameters import ParameterError

RUN_TOPICS = (
    'cmd_vel',
    'cmd_vel_out',
    'odom',
    'start_pose',
    'initialpose',
    'goal_pose',
    'goals',
    'goal_status',
    'joint_command',
    'joint_states',
    '/tf',
    '/parameter_events',
)
"""What there is to know about a run."""
DEPTH = 4000
"""How many messages of a topic may wait: at 1,000 per second, four seconds of a disk that hesitates."""
PARAMETERS = 'parameters of '
"""Before a node's name, the key of the custom data that holds its parameters as JSON."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Selection:
    """Which topics are recorded."""

    topics: tuple[str, ...] = RUN_TOPICS
    """Names, resolved by the recorder's namespace and remappings."""
    everything: bool = False
    """Every topic that is not hidden."""
    pattern: str = ''
    """Topics whose whole name this regular expression finds something in, too."""


class Recorder(Node):  # type: ignore[misc]
    """Hears what was selected, from the moment at which somebody publishes it."""

    def __init__(
        self,
        selection: Selection,
        journal: JournalWriter,
        *,
        stamped_on_receipt: bool = True,
        **kwargs: Any,
    ) -> None:
        """Begin without topics; `look` finds them.

        Args:
            selection: Which topics.
            journal: Where the messages go; it is flushed and synced by others.
            stamped_on_receipt: Whether a message is recorded with the time at which the middleware
                received it; else with that of the node's clock when it is handled, as always with
                simulated time. The EventsExecutor of Jazzy cannot tell the former.
            kwargs: As for `rclpy.node.Node`.

        Raises:
            ParameterError: A topic cannot be called so.
        """
        super().__init__('record_run', start_parameter_services=False, **kwargs)
        self._journal = journal
        self._everything = selection.everything
        self._names = {self._resolved(topic) for topic in selection.topics}
        self._pattern = re.compile(selection.pattern) if selection.pattern else None
        self._channels: dict[str, Channel] = {}
        self._refused: set[str] = set()
        self._asking: dict[str, tuple[Client, Client]] = {}
        self._asked: set[str] = set()
        self._stamped = stamped_on_receipt and not self.get_parameter('use_sim_time').value
        self.messages = 0
        """How many came."""

    @property
    def topics(self) -> list[str]:
        """What is heard."""
        return list(self._channels)

    def look(self) -> None:
        """Look for topics, publishers and nodes that are new."""
        for topic, types in self.get_topic_names_and_types():
            if not self._wants(topic) or topic in self._refused:
                continue
            publishers = self.get_publishers_info_by_topic(topic)
            if not publishers:
                continue
            if topic not in self._channels:
                self._hear(topic, types, publishers)
            else:
                self._note_profiles(self._channels[topic], publishers)
                self._note_types(self._channels[topic], publishers)
            for publisher in publishers:
                self._ask_for_parameters(publisher.node_namespace, publisher.node_name)

    def _resolved(self, topic: str) -> str:
        try:
            return str(self.resolve_topic_name(topic))
        except (RuntimeError, NameValidationException) as error:
            self.destroy_node()
            why = str(error).split(', at /')[0]
            raise ParameterError(f'no topic can be called {topic!r}: {why}') from error

    def _wants(self, topic: str) -> bool:
        if topic in self._names:
            return True
        hidden = any(part.startswith('_') for part in topic.split('/'))
        if self._everything and not hidden:
            return True
        return self._pattern is not None and self._pattern.search(topic) is not None

    def _hear(self, topic: str, types: list[str], publishers: list[Any]) -> None:
        if len(types) > 1:
            self._refuse(topic, f'it has several types: {", ".join(types)}')
            return
        try:
            described = definition(types[0])
            message = message_class(types[0])
        except UnknownTypeError as error:
            self._refuse(topic, str(error))
            return
        channel = Channel(
            id=len(self._channels),
            topic=topic,
            type_name=types[0],
            definition=described.text,
            type_hash=described.type_hash,
            qos=_profiles(publishers),
        )
        self._channels[topic] = channel
        self._journal.add(channel)
        profile = to_hear_all((one.qos_profile for one in publishers), DEPTH)
        callback = partial(self._on_stamped if self._stamped else self._on_message, channel.id)
        try:
            self.create_subscription(message, topic, callback, profile, raw=True)
        except RuntimeError as error:
            self._refuse(topic, str(error).split(', at /')[0])

    def _refuse(self, topic: str, why: str) -> None:
        self._refused.add(topic)
        self.get_logger().error(f'{topic} is not recorded: {why}')

    def _note_profiles(self, channel: Channel, publishers: list[Any]) -> None:
        profiles = _profiles(publishers)
        new = tuple(one for one in profiles if one not in channel.qos)
        if new:
            channel = replace(channel, qos=channel.qos + new)
            self._channels[channel.topic] = channel
            self._journal.add(channel)

    def _note_types(self, channel: Channel, publishers: list[Any]) -> None:
        for other in {one.topic_type for one in publishers} - {channel.type_name}:
            if (mismatch := f'{channel.topic} of {other}') not in self._refused:
                self._refuse(mismatch, f'{channel.topic} is recorded as {channel.type_name}')

    def _on_stamped(self, channel: int, data: bytes, info: dict[str, int]) -> None:
        self._journal.add(Message(channel, info['received_timestamp'], data))
        self.messages += 1

    def _on_message(self, channel: int, data: bytes) -> None:
        self._journal.add(Message(channel, self.get_clock().now().nanoseconds, data))
        self.messages += 1

    # --- Parameters of the nodes that are recorded

    def _ask_for_parameters(self, namespace: str, name: str) -> None:
        node = f'{namespace.rstrip("/")}/{name}'
        # Names are found out later than topics; without one there is nobody to ask.
        if name.startswith('_') or node == self.get_fully_qualified_name():
            return
        if node not in self._asking:
            self._asking[node] = (
                self.create_client(ListParameters, f'{node}/list_parameters'),
                self.create_client(GetParameters, f'{node}/get_parameters'),
            )
        names, values = self._asking[node]
        if node not in self._asked and names.service_is_ready() and values.service_is_ready():
            self._asked.add(node)
            names.call_async(ListParameters.Request()).add_done_callback(partial(self._on_names, node))

    def _on_names(self, node: str, future: Any) -> None:
        names = list(future.result().result.names)
        values = self._asking[node][1].call_async(GetParameters.Request(names=names))
        values.add_done_callback(partial(self._on_values, node, names))

    def _on_values(self, node: str, names: list[str], future: Any) -> None:
        values = [parameter_value_to_python(value) for value in future.result().values]
        text = json.dumps(dict(zip(names, values, strict=True)), default=list)
        self._journal.add(Text(PARAMETERS + node, text))


def _profiles(publishers: list[Any]) -> tuple[dict[str, Any], ...]:
    """Give the profiles offered, each once."""
    profiles: list[dict[str, Any]] = []
    for publisher in publishers:
        fields = to_fields(publisher.qos_profile)
        if fields not in profiles:
            profiles.append(fields)
    return tuple(profiles)
