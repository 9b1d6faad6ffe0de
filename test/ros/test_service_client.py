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

"""Each call of a service ends once: with a response, or with the reason why there is none."""

from __future__ import annotations

import pytest
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from diffdrive_jacobian.ros.service_client import ServiceClient

PATIENCE = 3.0


class Server(Node):
    """Answers a request, or keeps it until the test answers."""

    def __init__(self):
        super().__init__('server')
        self.answer = Future()
        self.create_service(Trigger, 'serve', self._serve)

    async def _serve(self, request, response):
        response.message = await self.answer
        return response


@pytest.fixture
def server(lockstep):
    return lockstep.add(Server())


@pytest.fixture
def client(lockstep, server):
    """A client in world time, and what became of its calls."""

    def world_time():
        return lockstep.world_time / 1e9

    found = ServiceClient(
        lockstep.node,
        Trigger,
        'serve',
        patience=PATIENCE,
        server='/server',
        monotonic=world_time,
    )
    found.ends = []

    def call():
        found.call(Trigger.Request(), lambda one: found.ends.append(one.message), found.ends.append)
        lockstep.settle()

    found.send = call
    return found


def pass_time(lockstep, client, seconds):
    lockstep.run_for(seconds)
    client.advance()


def test_a_response_in_time_ends_the_call_and_a_late_one_is_ignored(lockstep, server, client):
    client.send()
    pass_time(lockstep, client, PATIENCE - 0.1)
    assert client.ends == []
    server.answer.set_result('served')
    pass_time(lockstep, client, PATIENCE + 0.1)
    assert client.ends == ['served']
    server.answer = Future()
    client.send()
    pass_time(lockstep, client, PATIENCE + 0.1)
    assert client.ends[1:] == ['/server did not answer within 3 s']
    server.answer.set_result('late')
    pass_time(lockstep, client, 1.0)
    assert len(client.ends) == 2


def test_each_call_has_its_own_time_and_ends_with_the_client(lockstep, server, client):
    for ended in (0, 1, 2):
        client.send()
        pass_time(lockstep, client, 2.0)
        assert len(client.ends) == ended
    client.destroy()
    server.answer.set_result('served')
    lockstep.run_for(0.1)
    assert client.ends[2:] == ['/server is gone']


@pytest.mark.parametrize(
    ('end', 'why'),
    [
        (lambda future: future.cancel(), 'its answer cannot be read: canceled'),
        (
            lambda future: future.set_exception(RuntimeError('broken\x1b, at /somewhere/rcl.c:12')),
            'its answer cannot be read: broken\\x1b',
        ),
    ],
)
def test_a_response_that_cannot_be_read(lockstep, client, end, why):
    client.send()
    (future,) = client._calls
    end(future)
    lockstep.settle()
    assert client.ends == [why]


def test_it_is_ready_when_there_is_a_server(lockstep, client):
    assert client.ready
    assert not ServiceClient(lockstep.node, Trigger, 'nobody', patience=PATIENCE).ready
