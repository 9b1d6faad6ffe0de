"""Running a finding again."""

from __future__ import annotations

from diffdrive_jacobian.exploration.errors import ExplorationError
from diffdrive_jacobian.exploration.result import Finding, Replay, compared
from diffdrive_jacobian.exploration.trial import DIED
from diffdrive_jacobian.exploration.worker import packed, run_world_afresh, run_worlds


def replay(finding: Finding | None) -> Replay:
    """Run the smallest case of a finding again, in a process of its own if need be, and compare.

    Raises:
        ExplorationError: There is no finding.
    """
    if finding is None:
        raise ExplorationError('there is nothing to replay: no property was violated')
    index = finding.violation.index
    data = packed(finding.setting, [finding.trial], only=index, digest=True)
    # A world that ends its process must not end this one.
    (outcome,) = (run_world_afresh if finding.violation.name == DIED else run_worlds)(data)
    return compared(finding, outcome.of(finding.violation.key), outcome.digest)
