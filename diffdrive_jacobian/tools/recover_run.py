"""Make a complete bag of what a crash, a full disk or a cut has left, and leave that as it is."""

from __future__ import annotations

import argparse
import sqlite3
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from diffdrive_jacobian.bags.bag_writer import STORAGES, Summary, build_bag
from diffdrive_jacobian.bags.decoding import DecodingCheck
from diffdrive_jacobian.bags.journal import (
    JOURNAL,
    Channel,
    JournalError,
    Message,
    Record,
    is_being_written,
    journal_of,
)
from diffdrive_jacobian.reading.reader import damage
from diffdrive_jacobian.recovery.damaged_bag import NotABagError, Remains
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools.record_run import describe

PROGRAM = 'recover_run'
RECOVERED = '_recovered'
MAX_LOSSES = 50
"""How many losses are listed."""
MAX_LINE = 400
"""How long the line of each may be."""


class NothingToSaveError(Exception):
    """There is nothing to make a bag of; the arguments are the reason, and what could not be read."""


class InterruptedByUserError(Exception):
    """A signal came."""


class Report(NamedTuple):
    """What became of a bag."""

    bag: Path
    summary: Summary
    damaged: str
    """Why readers refuse the old one, in words; '': they do not, or it has no metadata.yaml."""
    lost: list[str]
    """What could not be read, in words."""
    left_out: bool
    """Whether these are topics, too, that could be read and not be written."""
    undecodable: list[str]
    """Messages that were saved although no reader can decode them, and topics not checked, in words."""


def recover(what: Path, output: Path | None, storage: str | None, signals: Signals) -> Report:
    """Make a new bag of what is left of another, which stays as it is.

    Args:
        what: A bag's directory, one of its files, a journal, or the bag that this belongs to.
        output: The new bag's directory; None: beside the old one.
        storage: `mcap` or `sqlite3`; None: as it was.
        signals: A signal ends it, and nothing is left of the new bag.

    Raises:
        NotABagError: There is nothing like a bag.
        NothingToSaveError: It is complete, or not a message can be read.
        FileExistsError: The new bag is there already.
        OSError: The one cannot be read, or the other not be written.
        InterruptedByUserError: A signal came.
    """
    if not what.exists() and journal_of(what).is_file():
        what = journal_of(what)
    with tempfile.TemporaryDirectory(prefix=f'{PROGRAM}_') as workshop:
        remains = Remains(what, Path(workshop))
        target = output or _beside(what, remains.kind)
        if target.exists():
            raise FileExistsError(f'{target} exists already')
        if remains.kind == 'journal' and is_being_written(remains.files[0]):
            raise NothingToSaveError(f'{what} is being recorded now: end record_run first')

        def records() -> Iterator[Record]:
            for record in remains.records():
                if signals.count:
                    raise InterruptedByUserError
                yield record

        # It may still grow: what counts is what was there now.
        kinds, decoding = _survey(records())
        losses, left_out = remains.losses, bool(remains.left_out)
        damaged = '' if remains.kind == 'journal' else damage(what)
        whole = remains.promised == kinds[Message] or (what.suffix == '.mcap' and what.is_file())
        if whole and not losses and not damaged:
            complete = f'{what} is complete: nothing to recover'
            raise NothingToSaveError('; '.join([complete, *decoding.undecodable]))
        if not kinds[Message]:
            raise NothingToSaveError(f'{what} holds no message that can be saved', *losses)
        summary = build_bag(lambda: islice(records(), kinds.total()), target, storage or remains.storage)
        return Report(target, summary, damaged, losses, left_out, decoding.undecodable)


def _survey(records: Iterable[Record]) -> tuple[Counter[type[Record]], DecodingCheck]:
    """Count the records by their kind, and the messages that cannot be decoded."""
    kinds: Counter[type[Record]] = Counter()
    channels: dict[int, Channel] = {}
    decoding = DecodingCheck()
    for record in records:
        kinds[type(record)] += 1
        if isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            decoding.add(channels[record.channel], record.data)
    return kinds, decoding


def _beside(what: Path, kind: str) -> Path:
    """Name the new bag after the old one."""
    if kind == 'journal' and what.suffix == JOURNAL:
        return what.with_suffix('')
    stem = what.stem if what.is_file() else what.resolve().name
    return what.resolve().with_name(stem + RECOVERED)


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; gives the exit code."""
    options = _parser().parse_args(arguments)
    try:
        report = recover(options.what, options.output, options.storage, signals)
    except InterruptedByUserError:
        print(f'{PROGRAM}: interrupted: no bag was made', file=sys.stderr)
        return _cli.INTERRUPTED
    except NothingToSaveError as error:
        reason, *losses = error.args
        print(f'{PROGRAM}: {printable(reason, PATH_LIMIT)}', *_listed(losses), sep='\n', file=sys.stderr)
        return _cli.FAILED
    except (NotABagError, JournalError, FileExistsError) as error:
        return _cli.complain(PROGRAM, printable(error, PATH_LIMIT))
    except (OSError, sqlite3.Error) as error:
        print(f'{PROGRAM}: error: no bag was made: {printable(error, PATH_LIMIT)}', file=sys.stderr)
        return (
            _cli.USER_ERROR
            if isinstance(error, PermissionError | FileNotFoundError | NotADirectoryError)
            else _cli.FAILED
        )
    print(describe(report.bag, report.summary))
    if report.damaged:
        print(f'damaged: {report.damaged}')
    print(*_listed(report.lost, 'lost: ') or ['nothing was lost that could be seen'], sep='\n')
    for line in _listed(report.undecodable, 'saved as recorded: '):
        print(line)
    return _cli.FAILED if report.left_out else _cli.DONE


def _listed(losses: Sequence[str], prefix: str = '') -> list[str]:
    """Return one line for each loss, of a large number only the first."""
    lines = [prefix + printable(one, MAX_LINE) for one in losses[:MAX_LOSSES]]
    if len(losses) > MAX_LOSSES:
        lines.append(f'{prefix}... and {len(losses) - MAX_LOSSES} more')
    return lines


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        usage=f'{PROGRAM} BAG [options]',
        description='Make a complete bag of what a crash, a full disk or a cut has left of one, and say '
        'what was saved and what was lost. The original stays as it is. Exit code 0: all that could be '
        'read is in the new bag; 1: nothing to recover (the bag is complete, or no message can be '
        'read), or the disk is full, or topics were left out, for nobody knows their type; 2: wrong '
        'arguments; 130: interrupted.',
    )
    parser.add_argument(
        'what',
        metavar='BAG',
        type=Path,
        help='a folder, a file of it (.mcap, .db3), a journal of record_run, or the bag this was for',
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='NEW',
        type=Path,
        help=f'the folder to write; of a journal the bag that it was for, else BAG{RECOVERED}',
    )
    parser.add_argument('-s', '--storage', choices=sorted(STORAGES), help='file format; as it was')
    return parser
