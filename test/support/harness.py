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

"""Real nodes in real time: served, heard, and waited for without sleeping."""

from __future__ import annotations

import time

PATIENCE = 60.0
"""How long a condition may take to come true before the test fails (s)."""


class Harness:
    """A context with its nodes, an executor that serves them, and a plain node to talk to them."""

    def __init__(self, context, executor):
        from rclpy.node import Node

        self.context = context
        self.executor = executor
        self.nodes = []
        self.peer = self.add(Node, node_name='peer')

    def add(self, node_class, *, parameters=None, **kwargs):
        """Make a node with parameter overrides and serve it."""
        from rclpy.parameter import Parameter

        overrides = [Parameter(name, value=value) for name, value in (parameters or {}).items()]
        node = node_class(context=self.context, parameter_overrides=overrides, **kwargs)
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def listen(self, message_type, topic, *, latched=False):
        """Collect the messages of a topic; returns the list that grows."""
        from rclpy.qos import DurabilityPolicy, QoSProfile

        received = []
        profile = QoSProfile(depth=1000)
        if latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        self.peer.create_subscription(message_type, topic, received.append, profile)
        return received

    def talk(self, message_type, topic):
        """Make a publisher that already has a reader."""
        publisher = self.peer.create_publisher(message_type, topic, 100)
        self.until(lambda: publisher.get_subscription_count() > 0, f'somebody reads {topic}')
        return publisher

    def until(self, condition, what='a condition', patience=PATIENCE):
        """Serve the nodes until a condition holds, and fail if it never does."""
        deadline = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < deadline, f'not within {patience} s: {what}'
            self.executor.spin_once(timeout_sec=0.01)

    def until_said(self, capfd, *words):
        """Serve the nodes until all words stand in the log; returns the log so far."""
        said = ''

        def told():
            nonlocal said
            said += capfd.readouterr().err
            return all(word in said for word in words)

        self.until(told, f'the log says {words}')
        return said

    def call(self, service_type, name):
        """Call a service without arguments; returns the response."""
        client = self.peer.create_client(service_type, name)
        self.until(client.service_is_ready, f'service {name}')
        future = client.call_async(service_type.Request())
        self.until(future.done, f'answer of {name}')
        return future.result()

    def close(self):
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
