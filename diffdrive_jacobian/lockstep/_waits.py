"""Waits of callbacks in the process of the test that nothing can end, and that would end in silence.

A response or a message cannot arrive before the callback returns. With a timeout rclpy would give up,
and the callback would go on without it, though in other executors it gets it. What is raised is `Stuck`,
which `except Exception` does not catch.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import Any

import rclpy.wait_for_message
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future

from diffdrive_jacobian.lockstep._guard import Stuck

__tracebackhide__ = True

POLLS = 3
"""Number of times that a callback may find a response missing, at one time."""


def refuse_waits(node: Node, now: Callable[[], int]) -> None:
    """Make the clients of a node raise `Stuck` where a callback waits for a response.

    Args:
        node: The node. Clients that were refused before are left alone.
        now: Returns the time of the world (ns).
    """
    for client in node.clients:
        if 'call' not in vars(client):
            service = node.resolve_service_name(client.srv_name)
            where = f'node {node.get_fully_qualified_name()} waits for a response of {service}'
            _refuse(client, where, now)


def _refuse(client: Client, where: str, now: Callable[[], int]) -> None:
    thread, call, call_async = threading.get_ident(), client.call, client.call_async

    def calls(*args: Any, **kwargs: Any) -> Any:
        if threading.get_ident() == thread:
            raise _stuck(f'{where} (client.call)')
        return call(*args, **kwargs)

    def calls_async(*args: Any, **kwargs: Any) -> Future:
        future = call_async(*args, **kwargs)
        done, polls = future.done, (0, 0, 0)

        def is_done() -> bool:
            nonlocal polls
            if done():
                return True
            if threading.get_ident() == thread:
                # The same call of the same function, at the same time.
                caller, time, count = id(sys._getframe(1)), now(), polls[2]
                polls = caller, time, count + 1 if polls[:2] == (caller, time) else 1
                if polls[2] > POLLS:
                    raise _stuck(f'{where} (future.done)')
            return False

        future.done = is_done
        return future

    client.call, client.call_async = calls, calls_async


def refuse_wait_for_message() -> Callable[[], None]:
    """Make `wait_for_message` raise `Stuck` in this thread. Return a function that restores it.

    Relies on it creating a `SignalHandlerGuardCondition`, which it finds in its module.
    """
    module: Any = rclpy.wait_for_message
    thread, present = threading.get_ident(), module.SignalHandlerGuardCondition

    def refuse(*args: Any, **kwargs: Any) -> Any:
        if threading.get_ident() == thread:
            raise _stuck('wait_for_message waits for a message')
        return present(*args, **kwargs)

    module.SignalHandlerGuardCondition = refuse

    def restore() -> None:
        module.SignalHandlerGuardCondition = present

    return restore


def _stuck(what: str) -> Stuck:
    place = sys._getframe(2)
    while place.f_code.co_filename == rclpy.wait_for_message.__file__ and place.f_back is not None:
        place = place.f_back
    code = place.f_code
    return Stuck(
        f'{what}, in {code.co_name} ({code.co_filename}:{place.f_lineno}): it cannot arrive before the '
        'callback returns. Await call_async, or subscribe; a test calls services by lockstep.call'
    )
