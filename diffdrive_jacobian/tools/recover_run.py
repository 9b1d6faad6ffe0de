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

"""Write a complete bag with all that can be read of a damaged bag or a journal."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from diffdrive_jacobian.bags.recovery import (
    RECOVERED,
    NothingToSaveError,
    Recovery,
    UncheckedError,
    recover,
)
from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE, FAILED, USER_ERROR

PROGRAM = 'recover_run'
UNCHECKED = 3
"""Exit code: nothing was found missing, but not all could be checked."""
MAX_LOSSES = 50
"""Number of losses that are listed."""
MAX_LINE = 400
"""Length of the line of each."""


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool and return its exit code."""
    options = _parser().parse(arguments, ros=False)
    try:
        with _output.busy(PROGRAM, f'reading {options.bag}'):
            recovery = recover(
                options.bag,
                options.output,
                replace=options.force,
                interrupted=lambda: signals.count > 0,
            )
    except NothingToSaveError as error:
        reason, *losses = error.args
        _output.note(PROGRAM, reason)
        print(*_listed(losses), sep='\n', end='\n' if losses else '', file=sys.stderr)
        return UNCHECKED if isinstance(error, UncheckedError) else FAILED
    except FileExistsError as error:
        raise UserError(str(error)) from error
    except OSError as error:
        wrong = isinstance(error, PermissionError | FileNotFoundError | NotADirectoryError)
        code = USER_ERROR if wrong else FAILED
        return _output.complain(PROGRAM, f'no bag was written: {error}', code)
    print(report(recovery))
    return FAILED if recovery.topics_left_out else DONE


def report(recovery: Recovery) -> str:
    """Return a description of a recovery, of several lines."""
    lines = [_output.describe_bag(recovery.bag, recovery.summary, 'written')]
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
        'because their type is unknown; 2: wrong arguments; '
        '3: nothing to recover (nothing was found missing, but not all could be checked, for want of '
        'checksums or counts); 130: interrupted.',
    )
    parser.add_bag(
        'directory of a bag, a file of it (.mcap, .db3), a journal of record_run, or the bag that '
        'the journal belongs to'
    )
    parser.add_output(
        'NEW',
        f'directory to write (default: BAG{RECOVERED}, for a journal the bag it belongs to)',
        kind=Path,
    )
    parser.add_force('NEW, which must not be BAG')
    parser.refuse_storage()
    return parser
