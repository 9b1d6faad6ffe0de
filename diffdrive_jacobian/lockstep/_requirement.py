"""What lockstep needs of a property that is required of a run."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol


class RequirementWatch(Protocol):
    """Observes one run."""

    def check(self) -> str | None:
        """Return what is violated at the current time, after all callbacks; None: nothing."""

    def finish(self) -> str | None:
        """Return what is violated at the end of the run; None: nothing."""


class Requirement(Protocol):
    """A property that can be required of a run."""

    def watch(self, world: Any) -> RequirementWatch:
        """Begin to observe a world."""


class Required(NamedTuple):
    """A property and what observes the run for it."""

    requirement: Requirement
    watch: RequirementWatch
    observing: list[tuple[list[Any], Any]]
    """The functions that observe, each with the list that it is in."""

    def end(self) -> None:
        """Stop observing."""
        for observers, observe in self.observing:
            observers.remove(observe)
