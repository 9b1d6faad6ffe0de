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

"""Find out why nodes do not communicate: who is there, who talks to whom, and what does not match."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from diffdrive_jacobian.diagnosis.graph import Graph, Participant, Problem, check_clocks, check_topics
from diffdrive_jacobian.diagnosis.machine import (
    Environment,
    check_environment,
    check_shared_memory,
    environment,
    shared_memory,
)
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import how_to_get_ros, printable
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools._output import counted
from diffdrive_jacobian.tools.entry_points import DONE, FAILED, INTERRUPTED, long_lived

PROGRAM = 'doctor'
DISCOVERY = 3.5
"""Time within which every node is discovered (s): an older participant is announced every 3 s."""
MAX_LISTED = 100
"""Number of nodes and of topics that are listed."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Diagnosis:
    """What was found."""

    environment: Environment
    rmw: str
    """The implementation of the middleware. Empty: ROS cannot be used."""
    graph: Graph
    findings: tuple[Problem, ...]

    @property
    def problems(self) -> list[Problem]:
        """The findings because of which something does not work."""
        return [one for one in self.findings if one.problem]


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    options = _parser().parse(arguments)
    found = environment()
    if not options.json:
        print(*_heading(found), sep='\n', flush=True)
    findings = list(check_environment(found))
    usable = not any(one.problem for one in findings)
    findings += check_shared_memory(shared_memory())
    rmw, graph = '', Graph()
    if usable:
        try:
            rmw, graph = _observe(options, signals)
        except (ImportError, OSError, RuntimeError) as error:
            why = printable(' '.join(str(error).split()), 300)
            findings.append(Problem(f'ROS cannot be used: {why}', how_to_get_ros()))
    findings += [*check_topics(graph), *check_clocks(graph)]
    if signals.count:
        return INTERRUPTED
    diagnosis = Diagnosis(environment=found, rmw=rmw, graph=graph, findings=tuple(findings))
    if options.json:
        print(json.dumps(asdict(diagnosis), indent=2))
    else:
        print(*_report(diagnosis), sep='\n')
    return FAILED if diagnosis.problems else DONE


def _observe(options: argparse.Namespace, signals: Signals) -> tuple[str, Graph]:
    """Return the name of the middleware, and the graph."""
    with long_lived(), signals.ending_at_once():
        # Not above: --help needs no ROS, and a diagnosis without ROS is one as well.
        from rclpy import get_rmw_implementation_identifier

        from diffdrive_jacobian.diagnosis.observation import observe

    if not options.json:
        print(
            f'waiting {options.timeout:g} s for the discovery of other nodes '
            f'(those that run already are announced every 3 s)',
            flush=True,
        )
    graph = observe(options.timeout, ros_arguments=options.ros, signals=signals)
    return get_rmw_implementation_identifier(), graph


def _heading(found: Environment) -> Iterator[str]:
    versions = ', '.join(f'{name} {version}' for name, version in found.versions.items())
    sources = sorted(set(found.sources.values()))
    yield f'python {found.python}, {versions}'
    yield (
        f'ROS from: {" and ".join(sources) or "nowhere"}; domain {printable(found.domain)}, '
        f'discovery range {found.reach}'
    )


def _report(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield the lines of a report."""
    graph = diagnosis.graph
    if diagnosis.rmw:
        yield f'middleware: {diagnosis.rmw}'
        yield f'{counted(len(graph.nodes), "node")} found'
    else:
        yield 'nodes were not searched, see the problems'
    yield from _shortened([_node(node) for node in graph.nodes])
    yield from _shortened(_topics(graph))
    for what, findings in (
        ('problem', diagnosis.problems),
        ('note', [one for one in diagnosis.findings if not one.problem]),
    ):
        for number, one in enumerate(findings, 1):
            yield f'{what} {number}: {one.what}'
            yield f'  remedy: {one.remedy}'
    yield f'{counted(len(diagnosis.problems), "problem")} found'


def _shortened(lines: list[str]) -> Iterator[str]:
    yield from lines[:MAX_LISTED]
    if len(lines) > MAX_LISTED:
        yield f'  ... and {len(lines) - MAX_LISTED} more'


def _node(node: Participant) -> str:
    clock = {True: ' (simulated time)', None: ' (clock unknown)'}.get(node.use_sim_time, '')
    return f'  {node.name}{clock}'


def _topics(graph: Graph) -> list[str]:
    """Return a line for each topic: who publishes it, who is subscribed to it, and how often."""
    rates = {one.topic: one for one in graph.streams}
    lines = []
    for topic in graph.topics():
        publishers, subscriptions = graph.publishers(topic), graph.subscriptions(topic)
        kinds = ' or '.join(sorted({one.kind for one in (*publishers, *subscriptions)}))
        sources = ', '.join(one.node for one in publishers) or 'nobody'
        sinks = ', '.join(one.node for one in subscriptions) or 'nobody'
        stream = rates.get(topic)
        rate = '' if stream is None else ', silent' if not stream.messages else f', {stream.rate:.3g} Hz'
        lines.append(f'  {topic} ({kinds}{rate}): {sources} -> {sinks}')
    return lines


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} [options] [--ros-args ...]',
        description='Report which nodes run, who communicates with whom, and what prevents it: types '
        'and quality of service that do not match, topics that nobody reads or publishes, several '
        'publishers, clocks, discovery, versions and shared memory. Each problem is named with its '
        'remedy. Exit code 0: no problem was found; 1: there are problems; 2: wrong arguments; 130: '
        'interrupted.',
    )
    parser.add_timeout('duration of the discovery and of the observation (s)', default=DISCOVERY)
    parser.add_argument('--json', action='store_true', help='print the report as JSON')
    return parser
