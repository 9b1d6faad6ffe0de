"""Write a complete bag with all that can be read of a damaged bag or a journal."""

from __future__ import annotations

import sqlite3
import sys
from collections.abc import Sequence
from pathlib import Path

from diffdrive_jacobian.bags.bag_writer import STORAGES
from diffdrive_jacobian.bags.journal import JournalError
from diffdrive_jacobian.bags.recovery import (
    RECOVERED,
    NotABagError,
    NothingToSaveError,
    Recovery,
    RecoveryInterruptedError,
    UncheckedError,
    recover,
)
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.tools import _cli
from diffdrive_jacobian.tools._bags import describe
from diffdrive_jacobian.tools._waiting import busy

PROGRAM = 'recover_run'
UNCHECKED = 3
"""Exit code: nothing was found missing, but not all could be checked."""
MAX_LOSSES = 50
"""Number of losses that are listed."""
MAX_LINE = 400
"""Length of the line of each."""


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool and return its exit code."""
    options = _parser().parse_args(arguments)
    try:
        with busy(PROGRAM, f'reading {printable(options.what, PATH_LIMIT)}'):
            recovery = recover(
                options.what,
                options.output,
                options.storage,
                replace=options.force,
                interrupted=lambda: bool(signals.count),
            )
    except RecoveryInterruptedError:
        print(f'{PROGRAM}: interrupted: no bag was written', file=sys.stderr)
        return _cli.INTERRUPTED
    except NothingToSaveError as error:
        reason, *losses = error.args
        print(f'{PROGRAM}: {printable(reason, PATH_LIMIT)}', *_listed(losses), sep='\n', file=sys.stderr)
        return UNCHECKED if isinstance(error, UncheckedError) else _cli.FAILED
    except (NotABagError, JournalError, FileExistsError) as error:
        return _cli.complain(PROGRAM, printable(error, PATH_LIMIT))
    except (OSError, sqlite3.Error) as error:
        print(f'{PROGRAM}: error: no bag was written: {printable(error, PATH_LIMIT)}', file=sys.stderr)
        return (
            _cli.USER_ERROR
            if isinstance(error, PermissionError | FileNotFoundError | NotADirectoryError)
            else _cli.FAILED
        )
    print(report(recovery))
    return _cli.FAILED if recovery.topics_left_out or recovery.records_left_out else _cli.DONE


def report(recovery: Recovery) -> str:
    """Return a description of a recovery, of several lines."""
    lines = [describe(recovery.bag, recovery.summary, 'written')]
    if recovery.damaged:
        lines.append(f'damaged: {recovery.damaged}')
    lost = _listed([*recovery.lost, *recovery.lost_before], 'lost: ')
    further = 'further ' if lost else ''
    unchecked = _listed(recovery.unchecked, f'{further}loss cannot be excluded: ')
    lines += [*lost, *unchecked] or ['no loss was found']
    lines += _listed(recovery.undecodable, 'saved as recorded: ')
    return '\n'.join(lines)


def _listed(losses: Sequence[str], prefix: str = '') -> list[str]:
    """Return one line for each loss, or for the first ones if there are many."""
    lines = [prefix + printable(one, MAX_LINE) for one in losses[:MAX_LOSSES]]
    if len(losses) > MAX_LOSSES:
        lines.append(f'{prefix}... and {len(losses) - MAX_LOSSES} more')
    return lines


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} BAG [options]',
        description='Write a complete bag with all messages that can be read of one that a crash or a '
        'full disk has left incomplete, and report what was saved and what was lost. The original is '
        'not changed. Exit code 0: all that could be read is in the new bag; 1: nothing to recover (the '
        'bag is complete, or no message can be read), or the disk is full, or topics were left out '
        'because their type is unknown, or records because they are too large; 2: wrong arguments; '
        '3: nothing to recover (nothing was found missing, but not all could be checked, for want of '
        'checksums or counts); 130: interrupted.',
    )
    parser.add_argument(
        'what',
        metavar='BAG',
        type=Path,
        help='directory of a bag, a file of it (.mcap, .db3), a journal of record_run, or the bag that '
        'the journal belongs to',
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='NEW',
        type=Path,
        help=f'directory to write (default: BAG{RECOVERED}, for a journal the bag it belongs to)',
    )
    _cli.add_force(parser, 'NEW, which must not be BAG')
    parser.add_argument(
        '-s', '--storage', choices=sorted(STORAGES), help='storage format (default: that of BAG)'
    )
    return parser
