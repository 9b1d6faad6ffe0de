"""Every parameter of every node, set to values that its declaration allows, and to all others."""

from __future__ import annotations

import math
import random
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python
from support.ros_messages import goal, odometry, twist

from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge
from diffdrive_jacobian.parameters.declaration import ParameterError, default_of, specifications
from diffdrive_jacobian.parameters.nodes import (
    GoToGoalParameters,
    VirtualRobotParameters,
    WheelBridgeParameters,
)
from process_faults.outcome import Outcome, unexpected
from process_faults.worlds import OUTPUTS, finite, quiet_world

NODES = {
    'virtual_robot': VirtualRobotParameters,
    'go_to_goal': GoToGoalParameters,
    'wheel_bridge': WheelBridgeParameters,
}
DECLARED: dict[str, dict[str, tuple[Any, Any]]] = {
    node: {
        name: (specification, default_of(parameters, field))
        for name, (field, specification) in specifications(parameters).items()
    }
    for node, parameters in NODES.items()
}
"""Specification and default of each parameter of each node."""
TEXTS = (
    *('', 'a', 'twist', 'wheels', 'pose', 'offset_point'),
    *('a' * 256, 'a' * 257, '\x1b[2J', '\n', 'ä\u202e'),
)
NUMBERS = (
    *(0.0, -0.0, 5e-324, 1e-300, 1e-9, 1.0, -1.0, 0.5, 1e6, 1e9, 1.8e308, -1.8e308),
    *(math.nan, math.inf, -math.inf, math.pi, math.tau, -math.tau),
)
INTEGERS = (0, 1, -1, 2, 2**31, 2**53 + 1, 2**63 - 1, -(2**63))
ATOMIC = 0.3
"""Share of changes of several parameters at once."""


def candidates(specification: Any, default: Any) -> Iterator[Any]:
    """Yield values from the declaration of a parameter: the limits, beside them, and what is beyond."""
    bounds = [
        one for one in (specification.low, specification.high, specification.above) if one is not None
    ]
    for bound in bounds:
        if isinstance(default, float):
            yield from (float(bound), math.nextafter(bound, math.inf), math.nextafter(bound, -math.inf))
        else:
            yield from (one for one in (bound, bound - 1, bound + 1) if abs(one) < 2**63)
    if len(bounds) > 1 and isinstance(default, float):
        yield from (min(bounds) + part * (max(bounds) - min(bounds)) for part in (1e-6, 0.01, 0.3, 0.9))
    if not isinstance(specification.choices, str):
        yield from (str(one) for one in specification.choices)
    yield default


def value_of(chance: random.Random, specification: Any, default: Any) -> ParameterValue:
    """Return a value: often one that may be allowed, else one of another type or none."""
    if chance.random() < 0.6:
        value = chance.choice(list(candidates(specification, default)))
    elif chance.random() < 0.7:
        pools = {float: NUMBERS, int: INTEGERS, str: TEXTS, bool: (True, False)}
        value = chance.choice(pools[type(default)])
    else:
        value = chance.choice((*NUMBERS, *INTEGERS, *TEXTS, True, False))
    if chance.random() < 0.05:
        return ParameterValue(type=chance.choice((0, 5, 6, 7, 8, 9, 10, 77, 255)))
    kinds = {bool: (1, 'bool_value'), int: (2, 'integer_value')}
    kinds |= {float: (3, 'double_value'), str: (4, 'string_value')}
    number, field = kinds[type(value)]
    return ParameterValue(type=number, **{field: value})


def permitted(specification: Any, default: Any, value: Any) -> bool:
    """Return whether the declaration alone allows a value."""
    if type(value) is int and type(default) is float:
        value = float(value)
    if type(value) is not type(default) or specification.read_only:
        return False
    if isinstance(value, bool):
        return True
    if isinstance(value, str):
        return value in specification.choices if specification.choices else 0 < len(value) <= 256
    if value != value:
        return bool(specification.nan_is_none)
    low, high, above = specification.low, specification.high, specification.above
    inside = (low is None or low <= value) and (high is None or value <= high)
    return inside and (above is None or value > above)


def same(first: Any, second: Any) -> bool:
    return type(first) is type(second) and (first == second or (first != first and second != second))


class Fuzzer:
    """Sets parameters of one running node."""

    def __init__(self, world: Any, name: str, chance: random.Random) -> None:
        self.name, self.chance, self.harness = name, chance, world.harness
        self.known = DECLARED[name]
        self.names = list(self.known)
        self.child = world.start(name, '--ros-args', '-r', f'__ns:=/{name}')
        self.child.until_says('subscribed to')
        peer = self.harness.peer
        path = f'/{name}/{name}'
        self.set = peer.create_client(SetParameters, f'{path}/set_parameters')
        self.set_all = peer.create_client(SetParametersAtomically, f'{path}/set_parameters_atomically')
        self.get = peer.create_client(GetParameters, f'{path}/get_parameters')
        for client in (self.set, self.set_all, self.get):
            self.harness.until(client.service_is_ready, f'services of {name}')
        self.violations: list[str] = []
        self.outputs: list[Any] = []
        self._inputs = [
            (peer.create_publisher(type(message), f'/{name}/{topic}', 10), message)
            for topic, message in INPUTS[name]
        ]
        kind, topic = OUTPUTS[name]
        peer.create_subscription(kind, f'/{name}/{topic}', self.outputs.append, 100)
        self.values = self._values()

    def change(self) -> None:
        """Set one parameter, or a few at once, and check the answer and all values."""
        number = self.chance.choice((2, 3, 5)) if self.chance.random() < ATOMIC else 1
        changes = {}
        for name in self.chance.sample(self.names, number):
            changes[name] = value_of(self.chance, *self.known[name])
        messages = [ParameterMessage(name=name, value=value) for name, value in changes.items()]
        if number == 1:
            (result,) = self._call(self.set, SetParameters.Request(parameters=messages)).results
        else:
            result = self._call(
                self.set_all, SetParametersAtomically.Request(parameters=messages)
            ).result
        for publisher, message in self._inputs:
            publisher.publish(message)
        self._check(changes, result)

    def _check(self, changes: dict[str, ParameterValue], result: Any) -> None:
        given = {name: self._python(value) for name, value in changes.items()}
        what = f'{self.name}: {given!r:.300}'
        allowed = [permitted(*self.known[name], value) for name, value in given.items()]
        expected = dict(self.values)
        if result.successful:
            for name, value in given.items():
                double = type(self.known[name][1]) is float and value is not None
                expected[name] = float(value) if double else value
            if not all(allowed) and not self._unchanged(given):
                self.violations.append(f'{what} was accepted')
        elif not result.reason or not result.reason.isprintable() or len(result.reason) > 1000:
            self.violations.append(f'{what} was refused without a clear reason: {result.reason!r:.200}')
        self.values = self._values()
        wrong = [name for name, value in expected.items() if not same(self.values[name], value)]
        if wrong:
            self.violations.append(f'{what}: {wrong} differ from what was answered')
        for message in self.outputs:
            if not finite(message):
                self.violations.append(f'{what}: published {str(message)[:200]}')
                break
        self.outputs.clear()
        if not self.child.running:
            raise AssertionError(f'{what}: the node ended: {self.child.stderr[-500:]}')

    def _unchanged(self, given: dict[str, Any]) -> bool:
        """Return whether only read-only parameters are set, to the values that they have."""
        return all(same(self.values[name], value) for name, value in given.items())

    @staticmethod
    def _python(value: ParameterValue) -> Any:
        return parameter_value_to_python(value) if value.type <= 9 else ('type', value.type)

    def _values(self) -> dict[str, Any]:
        found = self._call(self.get, GetParameters.Request(names=self.names)).values
        return {name: self._python(value) for name, value in zip(self.names, found, strict=True)}

    def _call(self, client: Any, request: Any) -> Any:
        future = client.call_async(request)
        self.harness.until(lambda: future.done() or not self.child.running, f'answer of {self.name}')
        if not self.child.running:
            raise AssertionError(f'{self.name} ended: {self.child.stderr[-500:]}')
        return future.result()


INPUTS: dict[str, list[tuple[str, Any]]] = {
    'virtual_robot': [('cmd_vel', twist(0.3, 0.5))],
    'go_to_goal': [('goal_pose', goal(2, 0)), ('odom', odometry(0, 0, 0))],
    'wheel_bridge': [('cmd_vel', twist(0.3, 0.5))],
}


def start_up(harness: Any, chance: random.Random, count: int) -> list[str]:
    """Create nodes with fuzzed values as given on the command line."""
    classes = {'virtual_robot': VirtualRobot, 'go_to_goal': GoToGoal, 'wheel_bridge': WheelBridge}
    violations = []
    for _ in range(count):
        node_name = chance.choice(list(NODES))
        known = DECLARED[node_name]
        given: dict[str, Any] = {}
        for name in chance.sample(list(known), chance.choice((1, 1, 2))):
            value = value_of(chance, *known[name])
            if 1 <= value.type <= 4:
                given[name] = parameter_value_to_python(value)
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        what = f'{node_name} started with {given!r:.300}'
        try:
            node = classes[node_name](
                context=harness.context, namespace='/started', parameter_overrides=overrides
            )
        except ParameterError as error:
            if not str(error) or not str(error).isprintable():
                violations.append(f'{what}: refused without a clear reason: {error!r:.200}')
            continue
        for name, value in given.items():
            specification, default = known[name]
            actual = node.get_parameter(name).value
            if not same(actual, float(value) if type(default) is float else value):
                violations.append(f'{what}: {name} is {actual!r}')
            if not permitted(replace(specification, read_only=False), default, value):
                violations.append(f'{what}: was accepted')
        node.destroy_node()
    return violations


def run(count: int, seed: int = 0) -> Outcome:
    """Set so many parameters of running nodes, and a tenth as many at the start of nodes."""
    chance = random.Random(seed)
    violations: list[str] = []
    with tempfile.TemporaryDirectory(prefix='parameters_') as name, quiet_world(Path(name)) as world:
        fuzzers = [Fuzzer(world, node, chance) for node in NODES]
        for index in range(count):
            fuzzer = fuzzers[index % len(fuzzers)]
            try:
                fuzzer.change()
            except AssertionError as error:
                violations.append(f'{fuzzer.name}, change {index}: {error}, values {fuzzer.values}')
                break
            if index % 1000 == 999:
                print(f'  {index + 1} of {count}', flush=True)
        violations += start_up(world.harness, chance, max(3, count // 10))
        for fuzzer in fuzzers:
            violations += fuzzer.violations
            fuzzer.child.signal(2)
            if fuzzer.child.exit() != 0 or unexpected(fuzzer.child.stderr):
                violations.append(f'{fuzzer.name}: {unexpected(fuzzer.child.stderr)}')
    tried = count + max(3, count // 10)
    return Outcome(tried, violations, f'{count} at run time, {tried - count} at start-up')
