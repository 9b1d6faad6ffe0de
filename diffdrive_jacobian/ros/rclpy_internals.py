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

"""Adapter to the parts of rclpy that are not public, or whose behaviour is not documented.

No other module imports from `rclpy.impl` or `rclpy.experimental`, or accesses a private attribute of an
object of rclpy. Each function names what it relies on. A release of rclpy that differs fails first in
`test/ros/test_rclpy_internals.py`, `test/lockstep` or `test/recording/test_recorder.py`. Tried with
rclpy 7.1.6 (Jazzy).

What the EventsExecutor uses of nodes, services and clients is in `NodeView` and so on.
"""

from __future__ import annotations

import ctypes
import inspect
import os
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import redirect_stderr
from functools import cache, wraps
from types import FrameType
from typing import Any, ClassVar, NamedTuple, Protocol

import rclpy.executors
import rclpy.timer
from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.executors import Executor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.task import Future, Task
from rclpy.time import Time
from rclpy.timer import Timer

RCLError: type[Exception] = rclpy_implementation.RCLError
"""Error of rcl, for example that a name is invalid or an object was destroyed. A RuntimeError."""
UnknownROSArgsError: type[Exception] = rclpy_implementation.UnknownROSArgsError
"""Error of `rclpy.init`: an argument after `--ros-args` is unknown."""
PARAMETERS_OF_RCLPY = ('qos_overrides.', 'start_type_description_service', 'use_sim_time')
"""Beginnings of the names of the parameters that rclpy itself declares."""
SERVICES_OF_RCLPY = ('rcl_interfaces/', 'type_description_interfaces/')
"""Packages of the types of the services that rclpy itself provides."""


def reason(error: Exception) -> str:
    """Return the message of an error of rcl without the place in its source files.

    rcl writes "message, at /path/file.c:line".
    """
    return str(error).split(', at /')[0].strip()


def log_info(node: Node, text: str) -> None:
    """Log a line at level info, with the function, file and line of the caller.

    For the first lines of a process: `RcutilsLogger.info` searches all modules for the caller, which
    takes more CPU time than to create a node. It also has filters, which this has not.
    Relies on `rclpy_logging_rcutils_log`.
    """
    logger, frame = node.get_logger(), sys._getframe(1)
    if logger.is_enabled_for(LoggingSeverity.INFO):
        code = frame.f_code
        rclpy_implementation.rclpy_logging_rcutils_log(
            LoggingSeverity.INFO, logger.name, text, code.co_name, code.co_filename, frame.f_lineno
        )


# --- Parameters


def parameter_overrides(node: Node) -> Mapping[str, Parameter]:
    """Return the values that a user gave for parameters of a node, declared or not.

    Relies on `Node._parameter_overrides`. The public interface gives a value only by declaring its
    parameter.
    """
    overrides: Mapping[str, Parameter] = node._parameter_overrides
    return overrides


def declared_parameters(node: Node) -> set[str]:
    """Return the names of the declared parameters of a node.

    Relies on `Node._parameters`.
    """
    return set(node._parameters)


# --- Graph


def graph_changed(node: Node) -> bool:
    """Return whether the graph has changed since the last call for any node of the same context.

    That is, whether nodes, publishers, subscriptions, services or clients appeared or disappeared. What
    is queried after the call contains all changes that it reported.
    Relies on `WaitSet.pointer`, and on two functions of rcl that rclpy does not offer. Where they are
    not found, it returns True.
    """
    functions = _graph_functions()
    if functions is None:
        return True
    guard_condition, add_guard_condition = functions
    context = node.context.handle
    with node.handle, context:
        wait_set = rclpy_implementation.WaitSet(0, 1, 0, 0, 0, 0, context)
        wait_set.clear_entities()
        # RCL_RET_OK is 0.
        if add_guard_condition(wait_set.pointer, guard_condition(node.handle.pointer), None):
            return True
        wait_set.wait(0)
        return bool(wait_set.is_ready('guard_condition', 0))


@cache
def _graph_functions() -> tuple[Callable[..., int | None], Callable[..., int]] | None:
    """Return `rcl_node_get_graph_guard_condition` and `rcl_wait_set_add_guard_condition`.

    They are looked up in the libraries with which rclpy is linked, of which only the linkers of POSIX
    search those they depend on.
    """
    try:
        library = ctypes.CDLL(rclpy_implementation.__file__)
        guard_condition = library.rcl_node_get_graph_guard_condition
        add_guard_condition = library.rcl_wait_set_add_guard_condition
    except (AttributeError, OSError):
        return None
    guard_condition.argtypes, guard_condition.restype = [ctypes.c_void_p], ctypes.c_void_p
    add_guard_condition.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    add_guard_condition.restype = ctypes.c_int
    return guard_condition, add_guard_condition


def clients_of(node: Node, service: str) -> list[Any]:
    """Return what the graph tells of the clients of a service in the domain of a node.

    Relies on the name that rmw_fastrtps gives to the topic of the requests. rclpy tells no endpoints of
    services.
    """
    infos: list[Any] = node.get_publishers_info_by_topic(f'rq{service}Request', no_mangle=True)
    return infos


def process_number(info: Any) -> int:
    """Return the lower half of the number of the process that has an endpoint.

    Relies on the GID of Fast DDS.
    """
    return int.from_bytes(bytes(info.endpoint_gid)[4:6], 'little')


# --- Inputs that rclpy parses itself


def wrap_clock_callback(
    node: Node, wrap: Callable[[Callable[[Any], None]], Callable[[Any], None]]
) -> None:
    """Replace the function that receives /clock, now and after `use_sim_time` changes.

    Relies on `Node._time_source`, `TimeSource.clock_callback` and `TimeSource._clock_sub`.
    """
    source = node._time_source
    source.clock_callback = wrap(source.clock_callback)
    if source._clock_sub is not None:
        source._clock_sub.callback = source.clock_callback


def wrap_service_callback(
    node: Node, service_type: Any, wrap: Callable[[Callable[[Any, Any], Any]], Callable[[Any, Any], Any]]
) -> None:
    """Replace the callbacks of the services of a type, including those that rclpy provides.

    Relies on `Service.srv_type` and on `Service.callback`, which every executor reads for each request.
    """
    for service in node.services:
        if service.srv_type is service_type:
            service.callback = wrap(service.callback)


def on_response(client: Client, listen: Callable[[int], None]) -> None:
    """Call a function with the number of the request for each response, also of several servers.

    Relies on executors calling `Client.get_pending_request` of the instance for each response.
    """
    get_pending_request = client.get_pending_request

    def listening(sequence_number: int) -> Any:
        listen(sequence_number)
        return get_pending_request(sequence_number)

    client.get_pending_request = listening


# --- Time


def time_reader(clock: Clock) -> Callable[[], int]:
    """Return a function that returns the time of a clock (ns).

    Relies on `Clock.handle.get_now`, which takes a third of the time of `Clock.now`.
    """
    get_now = clock.handle.get_now

    def read() -> int:
        now: int = get_now().nanoseconds
        return now

    return read


def wrap_sleep(clock: Clock, wrap: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
    """Replace `sleep_until` of a clock, once.

    Relies on `Clock.sleep_for` calling `sleep_until` of the instance.
    """
    if 'sleep_until' not in vars(clock):
        clock.sleep_until = wrap(clock.sleep_until)


def restart_timer(timer: Timer, period: int) -> None:
    """Restart a timer, so that it expires one period (ns) from now, also if it was cancelled.

    Relies on `Timer.timer_period_ns` being settable, and on `Timer.reset`, without which the timer would
    still expire at the end of its old period.
    """
    timer.timer_period_ns = period
    timer.reset()


def change_timer_period(timer: Timer, period: int) -> None:
    """Change the period of a timer (ns). It expires next after one new period, or earlier if it would.

    Relies on `Timer.timer_period_ns` leaving the time of the next expiry as it is.
    """
    timer.timer_period_ns = period
    due = timer.time_until_next_call()
    if due is None or due > period:
        timer.reset()


class TimerHandle(Protocol):
    """The timer of rcl. Its methods take a third of the time of those of `rclpy.timer.Timer`."""

    def time_until_next_call(self) -> int | None:
        """Return the time until the timer expires (ns); None: it is cancelled."""

    def call_timer(self) -> None:
        """Start the next period."""


def timer_handle(timer: Timer) -> TimerHandle:
    """Return the handle of a timer.

    Relies on `Timer.handle`. Methods of a handle whose timer was destroyed raise RCLError.
    """
    handle: TimerHandle = timer.handle
    return handle


def clock_subscription(node: Node) -> Subscription | None:
    """Return the subscription that receives the time of a node. None: its clock shows wall time.

    Relies on `Node._time_source` and `TimeSource._clock_sub`.
    """
    subscription: Subscription | None = node._time_source._clock_sub
    return subscription


class SimulatedClocks:
    """The clocks of nodes, whose time is set directly, instead of by a message on /clock.

    Does what `TimeSource.clock_callback` does, for all at once. Relies on `Node._time_source`,
    `TimeSource._last_time_set`, `TimeSource._associated_clocks`, `ROSClock.handle`, `Time._time_handle`
    and `rcl_time_point_t`.
    """

    def __init__(self) -> None:
        """Start without clocks."""
        self._time = Time(clock_type=ClockType.ROS_TIME)
        self._overrides: list[Callable[[Any], None]] = []

    def take(self, nodes: Iterable[Node]) -> None:
        """Take the clocks of nodes instead of those before."""
        self._overrides = []
        for node in nodes:
            source = node._time_source
            # It changes with each `set`.
            source._last_time_set = self._time
            self._overrides += [one.handle.set_ros_time_override for one in source._associated_clocks]

    def set(self, now: int) -> None:
        """Set the time (ns). Callbacks for jumps are called."""
        handle = rclpy_implementation.rcl_time_point_t(now, ClockType.ROS_TIME)
        self._time._time_handle = handle
        for override in self._overrides:
            override(handle)


# --- Messages


def message_taker(
    subscription: Subscription,
) -> tuple[Callable[[type, bool], tuple[Any, dict[str, Any]] | None], Callable[[], None]]:
    """Return a function that takes a message, and one that ends its use.

    Relies on `Subscription.handle.take_message`, which returns the message and its info. Until its use
    ends, the subscription is not destroyed.
    """
    handle = subscription.handle
    handle.__enter__()
    return handle.take_message, lambda: handle.__exit__(None, None, None)


def message_receiver(subscription: Subscription) -> Callable[[tuple[Any, dict[str, Any]]], Any]:
    """Return a function that calls the callback of a subscription with what `message_taker` takes.

    The callback may be replaced. Relies on `Subscription._callback` and `Subscription._callback_type`.
    """
    with_info = Subscription.CallbackType.WithMessageInfo

    def receive(taken: tuple[Any, dict[str, Any]]) -> Any:
        if subscription._callback_type is with_info:
            return subscription._callback(*taken)
        return subscription._callback(taken[0])

    return receive


def subscription_counter(publisher: Publisher) -> Callable[[], int]:
    """Return a function that returns how many subscriptions a publisher has.

    Relies on `Publisher.handle.get_subscription_count`, which needs no lock within one thread.
    """
    count: Callable[[], int] = publisher.handle.get_subscription_count
    return count


def refuse_init(context: Context, refuse: Callable[..., None]) -> None:
    """Let `rclpy.init` of a context that is initialized call a function, which raises an error.

    Relies on `rclpy.init` calling `Context.init`.
    """
    context.init = refuse


def on_new_node(created: Callable[[Node], None]) -> Callable[[], None]:
    """Call a function with each new node, when the constructor of `Node` has returned.

    Return what ends that. Relies on that of subclasses calling it. A context does not know its nodes.
    """

    def wrap(init: Callable[..., None]) -> Callable[..., None]:
        @wraps(init)
        def initialize(self: Node, *args: Any, **kwargs: Any) -> None:
            init(self, *args, **kwargs)
            created(self)

        return initialize

    return replaced(wrap, (Node, '__init__'))


def wrap_calls(wrap: Callable[[Callable[..., Any]], Callable[..., Any]]) -> Callable[[], None]:
    """Replace the methods of all clients and services that send a request or a response.

    Return what restores them. Relies on their being looked up in the class for each one.
    """
    return replaced(wrap, (Client, 'call_async'), (Service, 'send_response'))


def wrap_waits(
    call: Callable[[Callable[..., Any]], Callable[..., Any]],
    call_async: Callable[[Callable[..., Any]], Callable[..., Any]],
    wait: Callable[[Callable[..., bool]], Callable[..., bool]],
    guard_condition: Callable[[Callable[..., Any]], Callable[..., Any]],
) -> Callable[[], None]:
    """Replace all by which a callback may wait for what comes later. Return what restores them.

    Relies on responses being waited for by these methods of clients and of their futures, rates and
    future callbacks by a `threading.Condition`, and messages by the guard condition that
    `wait_for_message` creates.

    Args:
        call: Returns what replaces `Client.call`.
        call_async: The same of `Client.call_async`.
        wait: The same of `threading.Condition.wait`, in the whole process.
        guard_condition: The same of the class of the guard condition.
    """
    # Few processes need it.
    from rclpy import wait_for_message

    restores = [
        replaced(call, (Client, 'call')),
        replaced(call_async, (Client, 'call_async')),
        replaced(wait, (threading.Condition, 'wait')),
        replaced(guard_condition, (wait_for_message, 'SignalHandlerGuardCondition')),
    ]

    def restore() -> None:
        while restores:
            restores.pop()()

    return restore


def is_of_rclpy(frame: FrameType) -> bool:
    """Return whether a frame is of rclpy, as between a callback and its wait."""
    return frame.f_code.co_filename.startswith(os.path.dirname(rclpy.__file__) + os.sep)


def is_of_executor(frame: FrameType) -> bool:
    """Return whether a frame is of an executor, which a callback spins by itself."""
    return bool(frame.f_code.co_filename == rclpy.executors.__file__)


def is_of_rate(frame: FrameType) -> bool:
    """Return whether a frame is of a rate, in whose module nothing else waits for a condition."""
    return bool(frame.f_code.co_filename == rclpy.timer.__file__)


def wrap_publish(wrap: Callable[[Callable[..., None]], Callable[..., None]]) -> Callable[[], None]:
    """Replace `publish` of all publishers. Return what restores it.

    Relies on `Publisher.publish` being looked up in the class for each message.
    """
    return replaced(wrap, (Publisher, 'publish'))


def replaced(
    wrap: Callable[[Callable[..., Any]], Callable[..., Any]], *methods: tuple[Any, str]
) -> Callable[[], None]:
    """Replace methods of classes, or functions of modules, by what `wrap` makes of them.

    Return a function that restores them.
    """
    present = [(owner, name, getattr(owner, name)) for owner, name in methods]
    for owner, name, method in present:
        setattr(owner, name, wrap(method))

    def restore() -> None:
        for owner, name, method in present:
            setattr(owner, name, method)

    return restore


class ReceivedMessage(NamedTuple):
    """A serialized message, and what the middleware knows about it."""

    data: bytes
    publisher: bytes
    """The GID of the publisher."""
    number: int | None
    """Number of the message; its publisher counts 1, 2, 3, ... None: the middleware has no numbers."""
    sent: int
    """Time at which it was sent, by the clock of its publisher (ns). 0: unknown."""
    received: int
    """Time at which it was received, by the clock of this machine (ns). 0: unknown."""


class Polled(CallbackGroup):  # type: ignore[misc]
    """Entities of this group are left to `waiting_messages`: no executor waits for them.

    Many messages per second then cost next to nothing. The EventsExecutor ignores groups.
    """

    def can_execute(self, entity: Any) -> bool:
        """Return False."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Return False."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Do nothing."""


class _MessageInfo(ctypes.Structure):
    """`rmw_message_info_t` of Jazzy."""

    _fields_: ClassVar = [
        ('source_timestamp', ctypes.c_int64),
        ('received_timestamp', ctypes.c_int64),
        ('publication_sequence_number', ctypes.c_uint64),
        ('reception_sequence_number', ctypes.c_uint64),
        ('implementation_identifier', ctypes.c_char_p),
        ('publisher_gid', ctypes.c_uint8 * 16),
        ('from_intra_process', ctypes.c_bool),
    ]


class _Allocator(ctypes.Structure):
    """`rcutils_allocator_t`."""

    _fields_: ClassVar = [
        (name, ctypes.c_void_p)
        for name in ('allocate', 'deallocate', 'reallocate', 'zero_allocate', 'state')
    ]


class _SerializedMessage(ctypes.Structure):
    """`rcutils_uint8_array_t`, which rcl enlarges as needed."""

    _fields_: ClassVar = [
        ('buffer', ctypes.c_void_p),
        ('buffer_length', ctypes.c_size_t),
        ('buffer_capacity', ctypes.c_size_t),
        ('allocator', _Allocator),
    ]


_UNSUPPORTED = 2**64 - 1
"""`RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED`."""


@cache
def _take_functions() -> tuple[Callable[..., int], Callable[..., int], _Allocator]:
    """Return functions that take and free a serialized message, and the allocator of its buffer."""
    library = ctypes.CDLL(rclpy_implementation.__file__)
    library.rcutils_get_default_allocator.restype = _Allocator
    take, free = library.rcl_take_serialized_message, library.rcutils_uint8_array_fini
    take.argtypes, take.restype = [ctypes.c_void_p] * 4, ctypes.c_int
    free.argtypes, free.restype = [ctypes.c_void_p], ctypes.c_int
    return take, free, library.rcutils_get_default_allocator()


def waiting_messages(subscription: Subscription) -> Iterator[ReceivedMessage]:
    """Yield the messages that wait in a subscription.

    Executors take one message for each call of their own, and rclpy does not say from which publisher.
    Relies on `Subscription.handle.pointer`, and on `rcl_take_serialized_message` of the libraries with
    which rclpy is linked.
    """
    take, free, allocator = _take_functions()
    message, info = _SerializedMessage(allocator=allocator), _MessageInfo()
    into = ctypes.byref(message), ctypes.byref(info), None
    handle = subscription.handle
    try:
        with handle:
            # RCL_RET_OK is 0.
            while not take(handle.pointer, *into):
                number = info.publication_sequence_number
                yield ReceivedMessage(
                    ctypes.string_at(message.buffer, message.buffer_length),
                    bytes(info.publisher_gid),
                    None if number == _UNSUPPORTED else number,
                    info.source_timestamp,
                    info.received_timestamp,
                )
    finally:
        free(ctypes.byref(message))


def lost_messages(subscription: Subscription) -> int:
    """Return how many messages the middleware has reported as lost.

    The subscription belongs to the group `Polled` and has a callback `message_lost` at most. Without
    one this returns 0.
    Relies on `EventHandler.take_data` and on `_ready_to_take_data`, which an executor sets.
    """
    count = 0
    for handler in subscription.event_handlers:
        handler._ready_to_take_data = True
        count += handler.take_data().total_count
    return count


def request_message_info(callback: Callable[..., None]) -> None:
    """Let a callback of a subscription receive the message and its info.

    The SingleThreadedExecutor passes them as two arguments, the EventsExecutor of Jazzy as one tuple:
    the callback must accept both. The times in the info are right on the SingleThreadedExecutor only.
    Relies on `Subscription.callback` deciding by the signature whether the info is passed.
    """
    kind = inspect.Parameter.POSITIONAL_ONLY
    parameters = [inspect.Parameter(name, kind) for name in ('data', 'info')]
    vars(callback)['__signature__'] = inspect.Signature(parameters)
    vars(callback)['any_executor'] = True


# --- Executors


class NodeView:
    """A node as the EventsExecutor sees it: without timers, subscriptions and guard conditions.

    Relies on the EventsExecutor using these attributes of nodes only, by their names, and not their
    type. So does what follows.
    """

    timers = subscriptions = guards = ()

    def __init__(self, node: Node) -> None:
        """Show a node without its services and clients."""
        self.node = node
        self.executor: Any = None
        self.services: list[ServiceView] = []
        self.clients: list[ClientView] = []

    @property
    def waitables(self) -> Any:
        """The waitables of the node."""
        return self.node.waitables

    def get_logger(self) -> Any:
        """Return the logger of the node."""
        return self.node.get_logger()


class ServiceView(ABC):
    """A service as the EventsExecutor sees it."""

    def __init__(self, service: Service) -> None:
        """Show a service."""
        self.service = service

    @property
    def handle(self) -> Any:
        """The service of rcl."""
        return self.service.handle

    @property
    def srv_type(self) -> Any:
        """Type of the service."""
        return self.service.srv_type

    @property
    @abstractmethod
    def callback(self) -> Callable[[Any, Any], Any]:
        """Function that returns the response of a request.

        The EventsExecutor holds a borrowed reference only: an object that is created here would be freed
        before it is called.
        """

    @abstractmethod
    def send_response(self, response: Any, header: Any) -> None:
        """Send the result of the callback."""


class ClientView(ABC):
    """A client as the EventsExecutor sees it."""

    def __init__(self, client: Client) -> None:
        """Show a client."""
        self.client = client

    @property
    def handle(self) -> Any:
        """The client of rcl."""
        return self.client.handle

    @property
    def srv_type(self) -> Any:
        """Type of the service."""
        return self.client.srv_type

    @abstractmethod
    def get_pending_request(self, sequence_number: int) -> Any:
        """Return the future of a request, or a `ResponseView`."""


class ResponseView(ABC):
    """The future of a request as the EventsExecutor sees it."""

    def __init__(self, future: Future) -> None:
        """Show a future."""
        self.future = future

    def _set_executor(self, executor: Any) -> None:
        """Let an executor call what waits for the response."""
        self.future._set_executor(executor)

    @abstractmethod
    def set_result(self, result: Any) -> None:
        """Set the response."""


def events_executor(context: Context) -> Executor | None:
    """Return a new EventsExecutor. None: this rclpy has none.

    Relies on `rclpy.experimental.events_executor.EventsExecutor`. Its `spin_once` handles one event. A
    task that is created with `create_task` runs after all events that were queued before. `shutdown`
    releases the nodes at once, and afterwards it can be used again.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        return None
    # It enables the faulthandler, for which sys.stderr must be a file. In some tests it is not.
    with redirect_stderr(sys.__stderr__):
        return EventsExecutor(context=context)


def requires_wait_set(node: Node) -> bool:
    """Return whether a node has callbacks that the EventsExecutor of Jazzy does not support.

    It passes a message and its info as one argument, which only those of `request_message_info` accept,
    does not await coroutines of subscriptions and services, and raises an exception for guard
    conditions.
    Relies on `Subscription._callback_type`.
    """
    with_info = any(
        subscription._callback_type is not Subscription.CallbackType.MessageOnly
        and not hasattr(subscription.callback, 'any_executor')
        for subscription in node.subscriptions
    )
    entities = (*node.subscriptions, *node.services)
    coroutines = any(inspect.iscoroutinefunction(entity.callback) for entity in entities)
    return with_info or coroutines or any(True for _ in node.guards)


def new_task(function: Any, arguments: tuple[Any, ...], keywords: dict[str, Any], executor: Any) -> Task:
    """Return a task, which runs when it is called.

    A function, or a coroutine, which runs to its next `await` at each call.
    Relies on the constructor of `rclpy.task.Task`, which is meant for executors.
    """
    return Task(function, arguments, keywords, executor=executor)


# --- Endpoints without an executor


def raw_sender(publisher: Publisher) -> Callable[[bytes], None]:
    """Return a function that publishes serialized messages, which nobody who wraps `publish` notices.

    Relies on `Publisher.handle.publish_raw`.
    """
    send: Callable[[bytes], None] = publisher.handle.publish_raw
    return send


def take_request(service: Service) -> tuple[Any, Any] | None:
    """Take a request and its id from the queue of a service that is in no executor.

    Relies on `Service.handle.service_take_request`. None: there is none.
    """
    request, header = service.handle.service_take_request(service.srv_type.Request)
    return None if header is None else (request, header.request_id)


def send_response(service: Service, response: Any, request_id: Any) -> None:
    """Send a response, which nobody who wraps `Service.send_response` notices.

    Relies on `Service.handle.service_send_response`.
    """
    service.handle.service_send_response(response, request_id)


def send_request(client: Client, request: Any) -> int:
    """Send a request, which nobody who wraps `call_async` notices. Return its number.

    Relies on `Client.handle.send_request`.
    """
    number: int = client.handle.send_request(request)
    return number


def take_response(client: Client) -> tuple[int, Any] | None:
    """Take a response and the number of its request from the queue of a client that is in no executor.

    Relies on `Client.handle.take_response`. None: there is none.
    """
    header, response = client.handle.take_response(client.srv_type.Response)
    return None if header is None else (header.request_id.sequence_number, response)
