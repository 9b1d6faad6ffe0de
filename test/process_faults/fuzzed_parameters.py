"""Every parameter of every node, set to values that its declaration allows, and to all others."""

from __future__ import annotations

import math
import random
from dataclasses import replace

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
    'virtual_robot': (VirtualRobot, VirtualRobotParameters),
    'go_to_goal': (GoToGoal, GoToGoalParameters),
    'wheel_bridge': (WheelBridge, WheelBridgeParameters),
}
INPUTS = {
    'virtual_robot': [('cmd_vel', twist(0.3, 0.5))],
    'go_to_goal': [('goal_pose', goal(2, 0)), ('odom', odometry(0, 0, 0))],
    'wheel_bridge': [('cmd_vel', twist(0.3, 0.5))],
}
DECLARED = {
    node: {
        name: (specification, default_of(parameters, field))
        for name, (field, specification) in specifications(parameters).items()
    }
    for node, (_, parameters) in NODES.items()
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


def candidates(specification, default):
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


def value_of(chance, specification, default):
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


def permitted(specification, default, value):
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


def same(first, second):
    return type(first) is type(second) and (first == second or (first != first and second != second))


def python(value):
    return parameter_value_to_python(value) if value.type <= 9 else ('type', value.type)


def in_use(default, value):
    """Return a given value as the node has it: an integer may be given for a double."""
    return float(value) if type(default) is float and value is not None else value


def is_clear(reason):
    return 0 < len(reason) <= 1000 and reason.isprintable()


class Fuzzer:
    """Sets parameters of one running node."""

    def __init__(self, world, name, chance):
        self.name, self.chance, self.harness = name, chance, world.harness
        self.known, self.violations, self.outputs = DECLARED[name], [], []
        self.child = world.start(name, '--ros-args', '-r', f'__ns:=/{name}')
        self.child.until_says('subscribed to')
        peer = self.harness.peer
        self._clients = {
            kind: peer.create_client(kind, f'/{name}/{name}/{service}')
            for kind, service in (
                (SetParameters, 'set_parameters'),
                (SetParametersAtomically, 'set_parameters_atomically'),
                (GetParameters, 'get_parameters'),
            )
        }
        for client in self._clients.values():
            self.harness.until(client.service_is_ready, f'services of {name}')
        self._inputs = [
            (peer.create_publisher(type(message), f'/{name}/{topic}', 10), message)
            for topic, message in INPUTS[name]
        ]
        kind, topic = OUTPUTS[name]
        peer.create_subscription(kind, f'/{name}/{topic}', self.outputs.append, 100)
        self.values = self._values()

    def change(self):
        """Set one parameter, or a few at once, and check the answer, all values, what is published."""
        number = self.chance.choice((2, 3, 5)) if self.chance.random() < ATOMIC else 1
        names = self.chance.sample(list(self.known), number)
        values = {name: value_of(self.chance, *self.known[name]) for name in names}
        messages = [ParameterMessage(name=name, value=value) for name, value in values.items()]
        if number == 1:
            (result,) = self._call(SetParameters, parameters=messages).results
        else:
            result = self._call(SetParametersAtomically, parameters=messages).result
        for publisher, message in self._inputs:
            publisher.publish(message)
        given = {name: python(value) for name, value in values.items()}
        expected, before, found = dict(self.values), self.values, []
        if result.successful:
            expected |= {name: in_use(self.known[name][1], value) for name, value in given.items()}
            allowed = all(permitted(*self.known[name], value) for name, value in given.items())
            # Parameters that are read-only may be set to the values that they have.
            if not allowed and not all(same(before[name], value) for name, value in given.items()):
                found.append('was accepted')
        elif not is_clear(result.reason):
            found.append(f'was refused without a clear reason: {result.reason!r:.200}')
        self.values = self._values()
        wrong = [name for name, value in expected.items() if not same(self.values[name], value)]
        found += [f'{wrong} differ from what was answered'] if wrong else []
        infinite = [one for one in self.outputs if not finite(one)]
        found += [f'published {str(one)[:200]}' for one in infinite[:1]]
        self.outputs.clear()
        self.violations += [f'{self.name}: {given!r:.300}: {one}' for one in found]

    def _values(self):
        names = list(self.known)
        values = self._call(GetParameters, names=names).values
        return {name: python(value) for name, value in zip(names, values, strict=True)}

    def _call(self, kind, **request):
        future = self._clients[kind].call_async(kind.Request(**request))
        self.harness.until(lambda: future.done() or not self.child.running, f'answer of {self.name}')
        if not self.child.running:
            raise AssertionError(f'{self.name} ended: {self.child.stderr[-500:]}')
        return future.result()


def start_up(harness, chance, count):
    """Create nodes with fuzzed values as given on the command line; return what broke the promise."""
    violations = []
    for _ in range(count):
        node_name = chance.choice(list(NODES))
        known, given, found = DECLARED[node_name], {}, []
        for name in chance.sample(list(known), chance.choice((1, 1, 2))):
            value = value_of(chance, *known[name])
            if 1 <= value.type <= 4:
                given[name] = python(value)
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        try:
            node = NODES[node_name][0](
                context=harness.context, namespace='/started', parameter_overrides=overrides
            )
        except ParameterError as error:
            found += [] if is_clear(str(error)) else [f'refused without a clear reason: {error!r:.200}']
        else:
            for name, value in given.items():
                specification, default = known[name]
                actual = node.get_parameter(name).value
                if not same(actual, in_use(default, value)):
                    found.append(f'{name} is {actual!r}')
                if not permitted(replace(specification, read_only=False), default, value):
                    found.append('was accepted')
            node.destroy_node()
        violations += [f'{node_name} started with {given!r:.300}: {one}' for one in found]
    return violations


def run(count, seed=0):
    """Set so many parameters of running nodes, and a tenth as many at the start of nodes."""
    chance = random.Random(seed)
    violations, starts = [], max(3, count // 10)
    with quiet_world() as world:
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
        violations += start_up(world.harness, chance, starts)
        for fuzzer in fuzzers:
            violations += fuzzer.violations
            fuzzer.child.signal(2)
            if fuzzer.child.exit() != 0 or unexpected(fuzzer.child.stderr):
                violations.append(f'{fuzzer.name}: {unexpected(fuzzer.child.stderr)}')
    return Outcome(count + starts, violations, f'{count} at run time, {starts} at start-up')
