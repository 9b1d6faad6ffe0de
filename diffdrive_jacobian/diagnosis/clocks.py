"""Clocks: use_sim_time, /clock, and stamps that are far from the time."""

from __future__ import annotations

from collections.abc import Iterator

from diffdrive_jacobian.diagnosis.description import Finding, Graph, Stream
from diffdrive_jacobian.messages.topics import CLOCK
from diffdrive_jacobian.text import listed

MAX_AGE = 1.0
"""Largest age of a message on receipt (s)."""
MAX_AHEAD = 0.1
"""Largest time by which a stamp may lie in the future (s)."""
PATIENCE = 1.0
"""Shortest observation after which a silent /clock is reported (s)."""


def check_clocks(graph: Graph) -> Iterator[Finding]:
    """Yield what is wrong with the clocks of the nodes."""
    publishers = [one.node for one in graph.publishers(CLOCK)]
    simulated = [node.name for node in graph.nodes if node.use_sim_time]
    real = [
        node.name for node in graph.nodes if node.use_sim_time is False and node.name not in publishers
    ]
    if len(publishers) > 1:
        yield Finding(
            f'{listed(publishers)} publish {CLOCK}: the time jumps back and forth',
            'stop all but one (a simulator, replay_run --clock or ros2 bag play --clock)',
        )
    if simulated and not publishers:
        yield Finding(
            f'{listed(simulated)} uses simulated time (use_sim_time), but nobody publishes {CLOCK}: '
            'its time stands at zero',
            'start the simulator, or set use_sim_time to false',
        )
    if publishers and graph.seconds >= PATIENCE:
        yield from _check_messages(graph, publishers, simulated)
    if simulated and real and publishers:
        yield Finding(
            f'{listed(simulated)} uses simulated time, {listed(real)} does not: their stamps cannot be '
            'compared',
            'set use_sim_time to the same value everywhere (-p use_sim_time:=true)',
        )
    elif publishers and real:
        yield Finding(
            f'{listed(publishers)} publishes {CLOCK}, but no node uses it',
            'set use_sim_time to true (-p use_sim_time:=true) if it is the time of the robot',
            problem=False,
        )
    for stream in graph.streams:
        yield from _check_stamps(graph, stream)


def _check_messages(graph: Graph, publishers: list[str], simulated: list[str]) -> Iterator[Finding]:
    if not graph.clock.messages:
        yield Finding(
            f'nothing was received on {CLOCK} in {graph.seconds:.1f} s, although '
            f'{listed(publishers)} publishes it',
            'start or resume the simulator; it may be paused',
            problem=bool(simulated),
        )
    elif graph.clock.messages > 1 and graph.clock.advanced <= 0.0 and not graph.clock.went_back:
        yield Finding(
            f'the time on {CLOCK} stands still', 'resume the simulator', problem=bool(simulated)
        )
    elif graph.clock.went_back:
        yield Finding(
            f'the time on {CLOCK} went back {graph.clock.went_back} times in {graph.seconds:.1f} s',
            'one source must publish it; a bag that loops sets it back at each round',
            problem=bool(simulated),
        )


def _check_stamps(graph: Graph, stream: Stream) -> Iterator[Finding]:
    clocks = {node.name: node.use_sim_time for node in graph.nodes}
    nodes = [one.node for one in graph.publishers(stream.topic)]
    known = {clocks.get(node) for node in nodes}
    ages = {True: stream.simulated_age, False: stream.age}
    # A node that did not report its clock may have either.
    wanted = known if known <= {True, False} and len(known) == 1 else {True, False}
    present = [age for clock, age in ages.items() if clock in wanted and age is not None]
    if not present:
        return
    age = min(present, key=abs)
    if -MAX_AHEAD <= age <= MAX_AGE:
        return
    where = f'{age:.3g} s old on receipt' if age > 0.0 else f'{-age:.3g} s in the future'
    yield Finding(
        f'the messages of {listed(nodes)} on {stream.topic} have stamps that are {where}',
        'set the clocks of the machines (chrony or NTP), and use_sim_time to the same value everywhere',
    )
