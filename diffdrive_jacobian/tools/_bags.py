"""Description of bags for the tools that write them."""

from __future__ import annotations

from pathlib import Path

from diffdrive_jacobian.bags.bag_writer import Summary
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.tools import _cli


def describe(bag: Path, summary: Summary, state: str = 'complete') -> str:
    """Return one line about the content of a bag."""
    what = f'{printable(bag, PATH_LIMIT)} is {state}'
    if summary.start is None or summary.end is None:
        return f'{what} and empty: no message was received'
    counts = sorted(summary.topics.items())
    topics = ', '.join(f'{printable(topic)} {count}' for topic, count in counts if count)
    seconds = (summary.end - summary.start) / 1e9
    lost = f'; {sum(summary.lost.values())} lost' if summary.lost else ''
    return f'{what}: {_cli.counted(summary.messages, "message")} in {seconds:.1f} s ({topics}){lost}'
