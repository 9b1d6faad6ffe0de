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

"""What a benchmark tells: rows, each a ratio of two sides that were measured in turn, round by round.

The two sides of a round follow each other at once, so that a change of the machine's speed meets both.
The figures shown are medians of the rounds with least and greatest; the ratio is that within a round.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

WIDTH = 150


class Goal(NamedTuple):
    """What the ratio should be."""

    ratio: float
    at_most: bool = True

    def __str__(self) -> str:
        return f'{"<=" if self.at_most else ">="} {self.ratio:g}'

    def judge(self, ratio: float) -> str:
        """Tell whether a ratio reaches it."""
        reached = ratio <= self.ratio if self.at_most else ratio >= self.ratio
        return 'reached' if reached else 'missed'


@dataclass(frozen=True, kw_only=True)
class Row:
    """One comparison: a figure of each side for every round."""

    group: str
    ours: str
    beside: str
    quantity: str
    """What is compared, with its unit."""
    pairs: Sequence[tuple[float, float]]
    """For each round our figure and the other's."""
    goal: Goal | None = None
    digits: int = 0
    notes: Sequence[str] = field(default=())

    @property
    def ratio(self) -> float:
        """Median of the rounds' ratios."""
        return statistics.median(self._ratios())

    def _ratios(self) -> list[float]:
        return [ours / beside if beside else float('nan') for ours, beside in self.pairs]

    def cells(self, judged: bool) -> list[str]:
        """Give what the table shows."""
        ours, beside = zip(*self.pairs, strict=True)
        goal = ['-' if self.goal is None else str(self.goal)]
        if self.goal is not None and judged:
            goal.append(self.goal.judge(self.ratio))
        return [
            f'{self.ours}\n[dim]beside[/dim] {self.beside}',
            self.quantity,
            spread(ours, self.digits),
            spread(beside, self.digits),
            f'[bold]{spread(self._ratios(), 2)}[/bold]',
            '\n'.join(goal),
        ]


def spread(values: Sequence[float], digits: int) -> str:
    """Write the median with the least and the greatest."""
    median = f'{statistics.median(values):.{digits}f}'
    if len(values) == 1:
        return median
    return f'{median}\n({min(values):.{digits}f}-{max(values):.{digits}f})'


def show(rows: Sequence[Row], console: Console, *, judged: bool) -> None:
    """Print the table and the notes of its rows; judged: also whether they reach their goals."""
    table = Table(title='Ratios, measured side by side', show_lines=True, expand=True)
    for name in ('ours beside the reference', 'what', 'ours', 'reference', 'ratio', 'goal'):
        right = name in ('ours', 'reference', 'ratio')
        table.add_column(name, justify='right' if right else 'left', no_wrap=right)
    group = None
    for row in rows:
        if row.group != group:
            group = row.group
            table.add_row(f'[bold]{group}[/bold]')
        table.add_row(*row.cells(judged))
    console.print(table)
    for note in dict.fromkeys(note for row in rows for note in row.notes):
        console.print(f'- {note}', highlight=False)


def sections(rows: Sequence[Row], measured: str) -> dict[str, list[str]]:
    """Return the lines of a page for each group of rows, by its heading.

    Args:
        rows: The rows.
        measured: When and where they were measured.
    """
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(f'### {row.group[:1].upper()}{row.group[1:]}', []).append(row)
    found = {}
    for heading, members in groups.items():
        notes = dict.fromkeys(note for row in members for note in row.notes)
        found[heading] = [
            '| | what | ours | reference | ratio | goal |',
            '|---|---|---:|---:|---:|---|',
            *map(_line, members),
            '',
            *(f'- {note}' for note in [*notes, measured]),
        ]
    return found


def _line(row: Row) -> str:
    cells = [cell.replace('[dim]', '').replace('[/dim]', '') for cell in row.cells(judged=True)]
    cells[4] = cells[4].removeprefix('[bold]').removesuffix('[/bold]')
    return f'| {" | ".join(cell.replace(chr(10), " ") for cell in cells)} |'


def interleave(sides: Iterable[Any], rounds: int, measure: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """Measure every side once in each round, one after the other; gives the figures of each side."""
    figures: dict[Any, list[Any]] = {side: [] for side in sides}
    for number in range(rounds):
        # Every other round backwards, so that a drift favours nobody.
        for side in list(figures)[:: -1 if number % 2 else 1]:
            figures[side].append(measure(side))
    return figures
