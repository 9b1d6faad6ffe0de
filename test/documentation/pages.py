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

"""The pages of the documentation: their code blocks, how these are run, and what is generated in them.

    python test/documentation/pages.py parameters  write the parameter tables of doc/nodes.md
    python test/documentation/pages.py bodies [PAGE ...]  write the bodies of functions into pages
    python test/documentation/pages.py outputs [PAGE ...]  run pages and write their outputs
    python test/documentation/pages.py public  write doc/public.md
    python test/documentation/pages.py pictures  draw the pictures of plot_jacobian that pages show

A page is run from top to bottom in one empty directory. A `python` block is a program and a `bash` block
a script.
A block of any language whose first line is `# NAME.EXTENSION` is a file. HTML comments before
a block say what differs:

    <!-- test: skip, REASON -->          is not run; only the options of our tools in it are checked
    <!-- test: instead COMMAND -->       this command is run instead
    <!-- test: exit N -->                ends with this exit code
    <!-- test: processes -->             every line is a process; the last one ends by itself
    <!-- test: beside COMMAND; ... -->   runs while these commands run
    <!-- test: edit FILE, WORDS -->      replaces the one line of the file that has these words
    <!-- output -->                      is all that the block before printed; `...` stands for lines
    <!-- output: part -->                its lines are in what the block before printed, in this order
    <!-- output: part, exact -->         the same, with equal numbers (also without `part`)

Equal are integers, and other numbers that differ by at most one in the last place. Numbers in other
outputs may differ. Before a `py` block, which is not run:

    <!-- body: PACKAGE.MODULE.FUNCTION -->   a function of the package, without its docstring
"""

from __future__ import annotations

import ast
import importlib
import inspect
import io
import itertools
import os
import pkgutil
import re
import signal
import subprocess
import sys
import sysconfig
import tempfile
import textwrap
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from types import ModuleType
from typing import get_origin
from unittest import mock

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from support.domains import domain_id

import diffdrive_jacobian
from diffdrive_jacobian.parameters.declaration import NodeParameters
from diffdrive_jacobian.parameters.nodes import (
    GoToGoalParameters,
    VirtualRobotParameters,
    WheelBridgeParameters,
)

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    str(path.relative_to(ROOT)): path for path in (ROOT / 'README.md', *sorted(ROOT.glob('doc/*.md')))
}
PARAMETERS: dict[str, type[NodeParameters]] = {
    'virtual_robot': VirtualRobotParameters,
    'go_to_goal': GoToGoalParameters,
    'wheel_bridge': WheelBridgeParameters,
}
PATIENCE = 240.0
"""How long a block may run, or a process beside it may take to print something (s)."""
TYPING = 2.0
"""Time in which a person goes to the next terminal (s). Processes that have just started find each other
one after the other: a recorder that hears the odometry already may miss the first command."""
BLOCK = re.compile(
    r'(?P<notes>(?:^<!-- (?:test|output)[^\n]*-->\n+)*)^```(?P<language>\w*)\n(?P<code>.*?)^```$',
    re.MULTILINE | re.DOTALL,
)
FILE_NAME = re.compile(r'# ([\w./-]+\.\w+)\n')
ELLIPSIS = '...'
NUMBER = re.compile(r'-?\d+(\.\d+)?(e[-+]?\d+)?')


@dataclass(frozen=True, kw_only=True, slots=True)
class Block:
    """One block of a page, and what the comments before it say."""

    language: str
    code: str
    notes: dict[str, str]
    line: int
    start: int
    """Offset of the code in the text of the page."""

    @property
    def file(self) -> str | None:
        """The name of the file that the block is; None if it is none."""
        found = FILE_NAME.match(self.code)
        return found.group(1) if found else None


def blocks(text: str) -> list[Block]:
    """Return the blocks of a page from top to bottom."""
    found = []
    for match in BLOCK.finditer(text):
        notes = {}
        for words in re.findall(r'<!-- (?:test: )?(.*?) -->', match['notes']):
            word, rest = re.fullmatch(r'(\w+)[:,]? ?(.*)', words).groups()
            notes[word] = rest
        found.append(
            Block(
                language=match['language'],
                code=match['code'],
                notes=notes,
                line=text.count('\n', 0, match.start('code')),
                start=match.start('code'),
            )
        )
    return found


class Session:
    """A page that is run in a directory."""

    def __init__(self, directory: Path) -> None:
        """Run in an empty directory."""
        self._directory = directory
        (directory / 'config').symlink_to(ROOT / 'config')
        scripts = sysconfig.get_path('scripts')
        self._environment = {
            **os.environ,
            'PATH': os.pathsep.join([scripts, os.environ['PATH']]),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_DOMAIN_ID': str(domain_id()),
            'PYTHONUNBUFFERED': '1',
            # These take longer to import than most tests of the pages run.
            'PYTEST_ADDOPTS': '-p no:hypothesispytest -p no:xdist -p no:launch_testing',
        }

    def run(self, block: Block) -> str:
        """Run a block; return what it printed.

        Raises:
            AssertionError: It ended with another exit code than it should.
        """
        if block.file is not None:
            path = self._directory / block.file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.code)
            return ''
        if 'edit' in block.notes:
            self._edit(*block.notes['edit'].split(', ', 1), block.code)
            return ''
        beside = [one.strip() for one in block.notes.get('beside', '').split(';') if one.strip()]
        command = ['bash', '-euo', 'pipefail', '-c', block.notes.get('instead', block.code)]
        if block.language == 'python':
            command = ['python', '-c', block.code]
        elif 'processes' in block.notes:
            *beside, last = [line for line in block.code.splitlines() if not line.startswith('#')]
            command = ['bash', '-c', f'exec {last}']
        with ExitStack() as stack:
            for line in beside:
                stack.enter_context(self._running(line))
            if 'processes' in block.notes:
                time.sleep(TYPING)
            process = self._start(command, subprocess.PIPE, start_new_session=True)
            try:
                output, _ = process.communicate(timeout=PATIENCE)
                how, expected = f'exit code {process.returncode}', int(block.notes.get('exit', 0))
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                output, _ = process.communicate()
                how, expected = f'not within {PATIENCE} s', None
        assert process.returncode == expected, f'line {block.line}: {how}:\n{block.code}\n{output}'
        return output

    def _start(self, command: list[str], output: object, **options: bool) -> subprocess.Popen[str]:
        return subprocess.Popen(
            command,
            cwd=self._directory,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            text=True,
            **options,
        )

    @contextmanager
    def _running(self, command: str) -> Iterator[None]:
        """Run a command, from its first output on. It has to exit with 0 when it is interrupted."""
        with tempfile.TemporaryFile(mode='w+') as file:
            process, passed = self._start(['bash', '-c', f'exec {command}'], file), False
            try:
                deadline = time.monotonic() + PATIENCE
                while os.fstat(file.fileno()).st_size == 0:
                    assert process.poll() is None, f'{command} printed nothing'
                    assert time.monotonic() < deadline, f'{command} printed nothing'
                    time.sleep(0.01)
                yield
                passed = True
            finally:
                process.send_signal(signal.SIGINT)
                try:
                    code = process.wait(PATIENCE)
                except subprocess.TimeoutExpired:
                    process.kill()
                    code = process.wait()
                file.seek(0)
                if code or not passed:
                    print(f'{command}: exit code {code}\n{file.read()}')
            assert code == 0, f'{command}: exit code {code}'

    def _edit(self, name: str, words: str, replacement: str) -> None:
        path = self._directory / name
        lines = path.read_text().splitlines(keepends=True)
        (index,) = [number for number, line in enumerate(lines) if words in line]
        lines[index] = replacement
        path.write_text(''.join(lines))


def is_run(block: Block) -> bool:
    """Return whether a block is run, written or used to edit a file."""
    if 'skip' in block.notes or 'output' in block.notes:
        return False
    return block.language in ('python', 'bash') or block.file is not None


def masked(line: str) -> str:
    """Return a line without what may differ from run to run: numbers and the width of spaces."""
    return spaced(NUMBER.sub('#', line))


def spaced(line: str) -> str:
    """Return a line with single spaces."""
    return ' '.join(line.split())


def check_output(quoted: Block, printed: str) -> None:
    """Compare a quoted output with the real one.

    Raises:
        AssertionError: They differ in more than numbers. If the quotation is exact, in numbers, too: in
            integers at all, in others by more than one in the last place. Processors round differently.
    """
    exact = 'exact' in quoted.notes['output']
    real, lines = (
        [spaced(line) for line in text.strip().splitlines()] for text in (printed, quoted.code)
    )
    where = f'line {quoted.line}: printed was\n{printed}'
    if 'part' in quoted.notes['output']:
        rest = iter(real)
        for line in lines:
            assert any(agree(line, other, exact) for other in rest), (
                f'not in this order: {line}; {where}'
            )
    else:
        found = shortened(real, lines)
        assert len(found) == len(lines), where
        for line, other in zip(lines, found, strict=True):
            assert agree(line, other, exact), where


def agree(quoted: str, printed: str, exact: bool) -> bool:
    """Return whether two lines differ in numbers alone; if exact, in the last place of decimal ones."""
    if masked(quoted) != masked(printed):
        return False
    pairs = zip(NUMBER.finditer(quoted), NUMBER.finditer(printed), strict=True)
    return not exact or all(
        abs(Decimal(a[0]) - Decimal(b[0])) <= (last_place(a[0]) if a[1] or a[2] else 0) for a, b in pairs
    )


def last_place(number: str) -> Decimal:
    """Return what one is in the last place of a number: 0.001 of 0.206, 1e4 of 1.25e6."""
    return Decimal(1).scaleb(int(Decimal(number).as_tuple().exponent))


def shortened(real: list[str], quoted: list[str]) -> list[str]:
    """Return printed lines with `...` for as many as in a quotation."""
    if ELLIPSIS not in quoted:
        return real
    cut = quoted.index(ELLIPSIS)
    return [*real[:cut], ELLIPSIS, *real[len(real) - len(quoted) + cut + 1 :]]


def refreshed(quoted: Block, printed: str) -> str:
    """Return the code of a quoted output as it should be, shortened as it was.

    A part stays as it is; if it is out of date, that is reported.
    """
    if 'part' in quoted.notes['output']:
        try:
            check_output(quoted, printed)
        except AssertionError as error:
            print(f'edit by hand: {error}')
        return quoted.code
    return '\n'.join(shortened(printed.strip().splitlines(), quoted.code.splitlines())) + '\n'


def run_page(text: str, directory: Path) -> list[tuple[Block, str]]:
    """Run the blocks of a page; return the quoted outputs with what was printed."""
    printed, outputs = '', []
    session = Session(directory)
    for block in blocks(text):
        if 'output' in block.notes:
            outputs.append((block, printed))
        elif is_run(block):
            printed = session.run(block)
    return outputs


# --- Parameter tables


@mock.patch('importlib.metadata.entry_points', new=mock.Mock(return_value=()))
def parameter_table(parameters: type[NodeParameters]) -> str:
    """Return the table of the parameters of a node, without controllers that others have installed."""
    rows = ['| parameter | default | allowed | |', '|---|---|---|---|']
    for name, one in parameters().declared().items():
        allowed = one.allowed.removeprefix('in ').replace("'", '`')
        rows.append(f'| `{name}` | {_written(one.default)} | {allowed} | {one.description} |')
    return '\n'.join(rows)


def _written(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return '.nan' if value != value else str(value)


TABLE = re.compile(
    r'(<!-- parameters of (\w+) -->\n).*?(<!-- end of parameters -->)', re.MULTILINE | re.DOTALL
)


def with_parameter_tables(text: str) -> str:
    """Return a page with its parameter tables as they should be."""
    return TABLE.sub(
        lambda match: f'{match[1]}\n{parameter_table(PARAMETERS[match[2]])}\n\n{match[3]}', text
    )


# --- Bodies of functions

BODY = re.compile(r'(<!-- body: ([\w.]+) -->\n+```py\n)(.*?)(^```$)', re.MULTILINE | re.DOTALL)


def body(name: str) -> str:
    """Return the source of a function or method, without decorators and docstring.

    Args:
        name: Its full name, `PACKAGE.MODULE.FUNCTION` or `PACKAGE.MODULE.CLASS.METHOD`.
    """
    source = textwrap.dedent(inspect.getsource(pkgutil.resolve_name(name)))
    (function,) = ast.parse(source).body
    assert isinstance(function, ast.FunctionDef), f'{name} is no function'
    lines = source.splitlines(keepends=True)
    first = function.body[0]
    if ast.get_docstring(function) is not None:
        del lines[first.lineno - 1 : first.end_lineno]
    return ''.join(lines[function.lineno - 1 :])


def with_bodies(text: str) -> str:
    """Return a page with its bodies of functions as they should be."""
    return BODY.sub(lambda match: match[1] + body(match[2]) + match[4], text)


# --- Public names


def public_names(package: ModuleType = diffdrive_jacobian, prefix: str = '') -> dict[str, object]:
    """Return the public objects by their path in this package, those in public modules included."""
    found = {}
    for name in package.__all__:
        if not hasattr(package, name):
            importlib.import_module(f'{package.__name__}.{name}')
        value = found[f'{prefix}{name}'] = getattr(package, name)
        if inspect.ismodule(value):
            found |= public_names(value, f'{prefix}{name}.')
    return found


def public_page() -> str:
    """Return the page that lists the public names."""
    lines = [
        '# Public names',
        '',
        'What a program may import, with the first sentence of its docstring. Paths begin with',
        '`diffdrive_jacobian`: under kinematics, `planar_arm.PlanarArm` is',
        '`from diffdrive_jacobian.kinematics.planar_arm import PlanarArm`. Each object has one public',
        'path, as on this page. Packages and modules list these names in `__all__`. Everything else is',
        'internal and may change without notice. All errors derive from `errors.DiffdriveError`.',
        '',
        'Written by `python test/documentation/pages.py public`.',
    ]
    for path, value in public_names().items():
        package, _, name = path.partition('.')
        if not name:
            lines += ['', f'## {package}', '', sentence(value), '', '| name | |', '|---|---|']
        else:
            lines.append(f'| `{name}` | {sentence(value, path)} |')
    return '\n'.join([*lines, ''])


def sentence(value: object, path: str = '') -> str:
    """Return the first sentence of the docstring of a public object, at this path in the package."""
    documented = inspect.ismodule(value) or inspect.isclass(value) or inspect.isroutine(value)
    # Until Python 3.10 the alias of a type is an instance of `type`, too.
    documented = documented and not get_origin(value)
    text = (inspect.getdoc(value) if documented else _constant_docstring(value, path)) or ''
    text = ' '.join(text.partition('\n\n')[0].split())
    found = re.match(r'.*?\.(?= [A-Z]|$)', text)
    return (found[0] if found else text).replace('|', '\\|')


def _constant_docstring(value: object, path: str) -> str:
    """Return the string below the assignment of a constant."""
    if description := getattr(value, 'description', ''):
        return str(description)
    name = path.split('.')[-1]
    for key, module in list(sys.modules.items()):
        if not key.startswith(f'{diffdrive_jacobian.__name__}.') or vars(module).get(name) is not value:
            continue
        for pair in itertools.pairwise(ast.parse(inspect.getsource(module)).body):
            match pair:
                case ast.Assign(targets=[ast.Name(id=found)]), ast.Expr(ast.Constant(text)):
                    if found == name:
                        return str(text)
    raise ValueError(f'the public constant {path} has no docstring')


# --- Pictures


def write_pictures() -> None:
    """Draw the pictures of `plot_jacobian` that pages show, with a palette, a third of the size."""
    from PIL import Image

    from diffdrive_jacobian import plots
    from diffdrive_jacobian.plots.rendering import render

    shown = {
        Path(link)
        for path in PAGES.values()
        for link in re.findall(r'!\[.*?\]\((.*?)\)', path.read_text())
    }
    for name in plots.PICTURES:
        if (file := Path('../resource/pictures') / f'{name}.png') in shown:
            content = render(getattr(plots, name)(), 'png')
            picture = Image.open(io.BytesIO(content)).convert('RGB').quantize(dither=Image.Dither.NONE)
            picture.save(ROOT / 'doc' / file, optimize=True)


def with_outputs(text: str) -> str:
    """Run a page, and return it with its outputs as they should be."""
    with tempfile.TemporaryDirectory() as directory:
        for block, printed in reversed(run_page(text, Path(directory))):
            end = block.start + len(block.code)
            text = text[: block.start] + refreshed(block, printed) + text[end:]
    return text


WRITTEN = {'parameters': with_parameter_tables, 'bodies': with_bodies, 'outputs': with_outputs}
"""What is generated in pages, and the functions that write it."""


def main(what: str = '', *names: str) -> None:
    """Write what is generated."""
    if what == 'public' and not names:
        (ROOT / 'doc' / 'public.md').write_text(public_page())
    elif what == 'pictures' and not names:
        write_pictures()
    elif what in WRITTEN and {*names} <= {*PAGES}:
        for name in names or PAGES:
            text = PAGES[name].read_text()
            if (new := WRITTEN[what](text)) != text:
                PAGES[name].write_text(new)
                print(f'{name}: written')
    else:
        sys.exit(__doc__)


if __name__ == '__main__':
    main(*sys.argv[1:])
