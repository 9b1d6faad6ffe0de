"""The faults of a world. What each of them does is in `diffdrive_jacobian.faults`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.qos import QoSProfile
from std_msgs.msg import String

from diffdrive_jacobian.lockstep._errors import IneffectiveFaultsError, LockstepError
from diffdrive_jacobian.lockstep._fault_log import MAX_REPORTED, FaultEvent, FaultLog
from diffdrive_jacobian.lockstep._injection import Fault, Injection, World
from diffdrive_jacobian.lockstep._nodes import Nodes
from diffdrive_jacobian.lockstep._scheduler import Scheduler
from diffdrive_jacobian.lockstep.external.others import Isolated
from diffdrive_jacobian.messages.topics import FAULT_EVENTS
from diffdrive_jacobian.time_units import NANOSECONDS, in_seconds


class Faults:
    """All faults of a world."""

    def __init__(
        self, scheduler: Scheduler, nodes: Nodes, others: Isolated, settle: Callable[[], None]
    ) -> None:
        """Start without faults.

        Args:
            scheduler: Executes the nodes.
            nodes: The nodes of the world.
            others: Nodes in other processes.
            settle: Executes all callbacks that are due.
        """
        self._scheduler = scheduler
        self._nodes = nodes
        self._others = others
        self._settle = settle
        self._log = FaultLog(lambda: (scheduler.agenda.now, scheduler.clocks.now))
        self._world = World(
            scheduler=scheduler,
            node=nodes.own,
            log=self._log,
            observers=nodes.observers,
            restartable=nodes.restartable,
            restart=nodes.restart,
        )
        self._injections: list[Injection] = []
        self.faults: list[Any] = []
        """The faults that were injected."""

    def inject(self, faults: tuple[Fault, ...], seed: int) -> None:
        """Inject faults, as `Lockstep.inject`."""
        if not isinstance(seed, int) or isinstance(seed, bool):
            raise LockstepError(f'seed must be an integer, got {seed!r}')
        for fault in faults:
            _check(fault, self._scheduler.agenda.now)
        self._settle()
        if self._log.publisher is None:
            self._log.publisher = self._nodes.own.create_publisher(
                String, FAULT_EVENTS, QoSProfile(depth=1000)
            )
            self._scheduler.links.unaffected.add(self._log.publisher)
            # Recorders subscribe.
            self._settle()
            self._nodes.on_change.append(self._look)
        for fault in faults:
            self._add(fault, seed)
        self._settle()
        self.faults.extend(faults)

    def _add(self, fault: Fault, seed: int) -> None:
        same = sum(injection.fault == fault for injection in self._injections)
        injection = Injection(self._world, fault, len(self._injections), same, seed)
        fault.install(injection)
        self._check_receivers(injection)
        self._injections.append(injection)
        injection.schedule()
        self._scheduler.links.filter(injection.stage_of)

    def _look(self) -> None:
        """Check which faults have met what they affect."""
        for injection in self._injections:
            injection.look()

    def check_receivers(self) -> None:
        """Check that no fault affects what nodes in other processes receive."""
        for injection in self._injections:
            self._check_receivers(injection)

    def _check_receivers(self, injection: Injection) -> None:
        if others := injection.receivers(self._others.subscribed_nodes):
            raise LockstepError(
                f'{injection.fault!r} cannot affect {", ".join(sorted(others))}: messages to other '
                'processes are not intercepted; give node= with the name of a node of this world'
            )

    def check(self) -> None:
        """Check that every fault met something that it could affect.

        Raises:
            IneffectiveFaultsError: One did not.
        """
        missing = [(one.fault, one.missing) for one in self._injections if one.missing]
        if missing:
            raise IneffectiveFaultsError(
                [f'{fault!r}: {what}' for fault, what in missing], [what for _, what in missing]
            )

    def events(self) -> list[FaultEvent]:
        """Return all events, also of the latest messages, of which there may be more."""
        log = self._log
        return [
            *log.events,
            *(log.event(one.fault, text) for one in self._injections for text in one.unfinished()),
        ]

    def describe(self) -> list[str]:
        """Return the faults and their latest events as lines of text."""
        if self._log.publisher is None:
            return []
        events = self.events()
        hidden = max(0, len(events) - MAX_REPORTED)
        return [
            f'faults, {in_seconds(self._scheduler.agenda.now)} after the start:',
            *(f'  {one.fault!r}: {one.state()}' for one in self._injections),
            f'events of faults{f", without the first {hidden}" if hidden else ""}:',
            *(f'  {event}' for event in events[hidden:]),
        ]


def _check(fault: Any, now: int) -> None:
    """Raise LockstepError if an argument of `inject` is no fault, or over at a world time (ns)."""
    if isinstance(fault, type) or not callable(getattr(fault, 'install', None)):
        raise LockstepError(f'inject takes faults, got {fault!r}')
    if fault.start + fault.duration <= now / NANOSECONDS:
        raise LockstepError(f'{fault!r} is over: {now / NANOSECONDS:g} s have passed since the start')
