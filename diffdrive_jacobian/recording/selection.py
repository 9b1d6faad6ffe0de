"""The selection of topics to record."""

from __future__ import annotations

from dataclasses import dataclass

from diffdrive_jacobian.messages.topics import TOPICS

RUN_TOPICS = tuple(topic.name for topic in TOPICS.values() if topic.recorded)
"""The topics of a run."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Selection:
    """Which topics are recorded."""

    topics: tuple[str, ...] = RUN_TOPICS
    """Names, resolved by the recorder's namespace and remappings."""
    everything: bool = False
    """Whether to record every topic that is not hidden."""
    pattern: str = ''
    """Regular expression. Topics in whose full name it is found are recorded as well."""
