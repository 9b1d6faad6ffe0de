"""The selection of topics to record."""

from __future__ import annotations

from dataclasses import dataclass

RUN_TOPICS = (
    'cmd_vel',
    'cmd_vel_out',
    'odom',
    'ground_truth',
    'start_pose',
    'initialpose',
    'goal_pose',
    'goals',
    'goal_status',
    'joint_command',
    'joint_states',
    '/tf',
    '/parameter_events',
)
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
