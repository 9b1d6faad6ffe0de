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

"""Grade hand-ins of an exercise, and write the points and reasons as a table."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.grading.grader import SECONDS, Graded, exercises, find_exercise, grade, table
from diffdrive_jacobian.plots.output_files import new_file
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE, FAILED

PROGRAM = 'grade_hand_ins'


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    parser = _parser()
    options = parser.parse(arguments)
    exercise = find_exercise(options.exercise)
    for path in options.hand_ins:
        if not path.is_file():
            parser.error(f'there is no hand-in {printable(path)}')
    parser.refuse_without(options, '--force', '--csv')
    csv = None
    if options.csv is not None:
        csv = new_file(options.csv, ('csv',), 'table', replace=options.force)
    if find_spec('pytest') is None:
        raise UserError("grading needs pytest: pip install 'diffdrive_jacobian[testing]'")

    def show(one: Graded) -> None:
        print(f'{one.points:g} of {one.of:g}  {printable(one.hand_in)}  ({one.seconds:.1f} s)')
        for reason in one.reasons:
            print(f'    {printable(reason, 300)}', flush=True)

    found = grade(
        exercise,
        options.hand_ins,
        seconds=options.timeout,
        pictures=options.pictures,
        jobs=options.jobs,
        graded=show,
        stopped=lambda: signals.count > 0,
    )
    if csv is not None:
        _output.write(csv, table(found).encode(errors='backslashreplace'), replace=options.force)
        _output.say(csv)
    _output.check(signals, f'{len(found)} of {len(options.hand_ins)} hand-ins were graded')
    return FAILED if any(one.error for one in found) else DONE


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} EXERCISE HAND_IN [HAND_IN ...] [options]',
        description='Grade hand-ins of an exercise. Each is a Python file that runs in a process of its '
        'own, which can open no file and is ended in time. Exit code 0: all were graded, well or badly; '
        '1: one was not graded to its end, or the exercise fails; 2: wrong arguments; 130: interrupted.',
    )
    parser.add_argument(
        'exercise',
        metavar='EXERCISE',
        help=f'file with tests of pytest, or one of {", ".join(exercises())}',
    )
    parser.add_argument(
        'hand_ins', metavar='HAND_IN', nargs='+', type=Path, help='Python file of a student'
    )
    parser.add_value('--csv', 'FILE', 'write the table to a file, .csv', kind=Path)
    parser.add_value('--pictures', 'DIR', 'save pictures of the drives in a folder', kind=Path)
    parser.add_timeout('longest duration of the grading of one hand-in (s)', default=SECONDS)
    parser.add_value(
        '--jobs', 'N', 'how many at a time (default: as many as cores)', kind=_cli.integer_from(1, 256)
    )
    parser.add_force('the table')
    return parser
