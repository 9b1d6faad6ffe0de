"""What is written about a finding: the case, a test that reproduces it, a bag and a picture."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import count, groupby
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from diffdrive_jacobian.bags import BagError, read_run
from diffdrive_jacobian.exploration.processes import ChildDiedError, call_in_child, can_run_here
from diffdrive_jacobian.exploration.result import LONGEST_KEY, Finding
from diffdrive_jacobian.exploration.scenario import ExplorationError, Source
from diffdrive_jacobian.exploration.trial import Setting, Trial, run
from diffdrive_jacobian.lockstep.world import Lockstep
from diffdrive_jacobian.plots.run_figure import ViolationMark, draw
from diffdrive_jacobian.recording.recorder import Recorder, Selection
from diffdrive_jacobian.recording.recording import Recording, RecordingError
from diffdrive_jacobian.text import error_text, printable

BAG, PICTURE = 'run', 'run.png'
"""Names of the bag and of the picture."""
TESTING = 'diffdrive_jacobian.testing'
CASE = 'counterexample.json'
"""Name of the file with the case."""
MARK = '.written_by_explore'
"""Name of the file that lists what was written into a folder, with SHA-256 sums."""
MARK_TITLE = '# written by explore into {folder}; it removes a file only if it has this SHA-256 sum'
"""First line of that file. A folder that was renamed or copied has another name."""
TEST = '''"""{title}

{description}

Found and written by explore(seed={seed}). Passes once the controller is mended.
"""

{imports}
HERE = Path(__file__).resolve().parent
{loads}
CASE = {case}
{faults}

{marker}def test_{name}(lockstep):
{inject}{require}    with reproducing(lockstep, HERE / '{file}'):
        {scenario}(lockstep, CASE)
        lockstep.finish()
'''


def check_output(folder: Path) -> None:
    """Create the folder of the findings.

    Raises:
        ExplorationError: It cannot be created or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExplorationError(f'output {folder} cannot be created: {error.strerror}') from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ExplorationError(f'output {folder} cannot be written to')


def write_finding(
    finding: Finding,
    output: Path,
    others: Sequence[Finding],
    *,
    seed: int,
    executor: Executor | None = None,
) -> Finding:
    """Write a finding into a folder of its own, in the place of one of an earlier exploration.

    Nothing else is overwritten: where it is in the way, the folder gets a number. What cannot be written
    is noted in the finding that is returned. `others` have a folder already. The executor runs the case
    again, to write the bag and the picture. Without one these are not written.
    """
    taken = {other.directory for other in others}
    stem = re.sub(r'\W+', '_', finding.violation.name)
    folders = (output / (stem if number == 1 else f'{stem}_{number}') for number in count(1))
    folder = next(one for one in folders if one not in taken and _is_free(one))
    notes = list(finding.notes)
    try:
        _remove(folder)
        folder.mkdir(exist_ok=True)
        case, test = folder / CASE, _test(folder)
        for path, text in (
            (folder / MARK, MARK_TITLE.format(folder=folder.name) + '\n'),
            (case, _case(finding, seed)),
            (test, test_source(finding, folder, test.stem.removeprefix('test_'), seed)),
        ):
            with path.open('x', encoding='utf-8') as file:
                file.write(text)
        _mark(folder, [case, test])
        if executor is not None:
            notes += _record(finding, folder, executor)
    except OSError as error:
        notes.append(f'not written: {error}')
    return replace(finding, directory=folder, notes=tuple(notes))


def remove_others(output: Path, findings: Sequence[Finding]) -> None:
    """Remove what an earlier exploration has written, other than what was found again.

    A folder that was renamed or copied stays, and so does one in which a file was changed or renamed.
    Files that were added stay, too.
    """
    kept = {finding.directory.name for finding in findings if finding.directory is not None}
    for mark in output.glob(f'*/{MARK}'):
        if mark.parent.name not in kept:
            with suppress(OSError):
                _remove(mark.parent)


# --- What explore has written into a folder


def _is_free(folder: Path) -> bool:
    """Return whether a finding can be written into a folder without overwriting anything else."""
    if not os.path.lexists(folder):
        return True
    with suppress(OSError):
        return not folder.is_symlink() and (bool(_own(folder)) or not any(folder.iterdir()))
    return False


def _own(folder: Path) -> list[Path]:
    """Return the files that an exploration has written into a folder, which may be removed.

    None if one of them was changed, if the test was renamed, or if there is anything else in the bag or
    under the name of a file of a finding.
    """
    mark = folder / MARK
    if folder.is_symlink() or mark.is_symlink() or not mark.is_file():
        return []
    title, *lines = mark.read_text(encoding='utf-8', errors='replace').split('\n')
    if title != MARK_TITLE.format(folder=folder.name):
        return []
    written = {name: checksum for checksum, _, name in (line.partition('  ') for line in lines)}
    present = {str(path.relative_to(folder)): path for path in _files(folder)}
    own = {
        name: path
        for name, path in present.items()
        if name in written and path.is_file() and not path.is_symlink()
        if written[name] == _checksum(path)
    }
    reserved = {CASE, _test(folder).name, BAG, PICTURE, *written}
    others = {name.partition('/')[0] for name in present.keys() - own.keys()}
    return [] if _test(folder).name not in own or others & reserved else [*own.values(), mark]


def _remove(folder: Path) -> None:
    """Remove what an exploration has written into a folder, and the folder if nothing else is in it."""
    own = _own(folder)
    cache = folder / '__pycache__'
    if own and not cache.is_symlink():
        # What pytest compiled.
        own += cache.glob(f'{_test(folder).stem}.*.pyc')
    for file in own:
        file.unlink()
    for part in (folder / BAG, cache, folder) if own else ():
        if part.is_dir() and not part.is_symlink() and not any(part.iterdir()):
            part.rmdir()


def _test(folder: Path) -> Path:
    """Return the path of the test in the folder of a finding."""
    return folder / f'test_{re.sub("(?<=[a-z0-9])(?=[A-Z])", "_", folder.name).lower()}.py'


def _mark(folder: Path, files: Iterable[Path]) -> None:
    """Note that files were written into a folder."""
    with (folder / MARK).open('a', encoding='utf-8') as file:
        file.writelines(f'{_checksum(one)}  {one.relative_to(folder)}\n' for one in files)


def _files(folder: Path) -> Iterator[Path]:
    """Yield all files below a folder, and the links, which are not followed."""
    for root, folders, files in os.walk(folder):
        for name in (*files, *folders):
            path = Path(root, name)
            if path.is_symlink() or not path.is_dir():
                yield path


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _record(finding: Finding, folder: Path, executor: Executor) -> list[str]:
    """Record the smallest case. Return notes on what could not be written."""
    # Apart until it is complete: after Ctrl-C the process of the recording goes on for a moment.
    with TemporaryDirectory(prefix='.recording_', dir=folder, ignore_cleanup_errors=True) as apart:
        arguments = finding.setting, finding.trial, finding.violation.index, apart
        try:
            notes = executor.submit(_record_in_process, *arguments).result()
        except ChildDiedError as error:
            notes = [f'not recorded: {error}']
        except Exception as error:
            # The finding must not be lost.
            notes = [f'not recorded: {type(error).__name__}: {error_text(error)}']
        for path in Path(apart).iterdir():
            new = path.rename(folder / path.name)
            _mark(folder, _files(new) if new.is_dir() else [new])
    return notes


def _record_in_process(*arguments: Any) -> list[str]:
    return list(record(*arguments) if can_run_here() else call_in_child(record, *arguments))


def record(setting: Setting, trial: Trial, only: int, folder: str) -> list[str]:
    """Run a world, write its bag and its picture into a folder, and return what could not be written."""
    bag = Path(folder) / BAG
    ended = 0

    @contextmanager
    def recording(world: Lockstep) -> Iterator[None]:
        nonlocal ended
        writing = Recording(bag, lossless=True)
        recorder = Recorder(Selection(everything=True), writing)
        world.add(recorder, observer=True)
        world.on_new_topics(recorder.discover)
        recorder.discover()
        try:
            yield
        finally:
            ended = world.now
            writing.finish()

    try:
        outcome = run(setting, trial, only=only, during=recording)
    except (RecordingError, OSError) as error:
        return [f'no bag: {error}']
    # A violation ends the world.
    marks = [
        ViolationMark(ended, f'violated: {one.key}' if one.index >= 0 else one.key)
        for one in outcome.violations[:1]
    ]
    try:
        draw([read_run(bag)], Path(folder) / PICTURE, violations=marks)
    except (BagError, ModuleNotFoundError, OSError) as error:
        return [f'no picture: {error}']
    return []


def _case(finding: Finding, seed: int) -> str:
    source = Source()
    scenario, trial, violation = finding.setting.scenario, finding.trial, finding.violation
    fields = {
        'violation': violation.key,
        'seconds': violation.seconds,
        'text': violation.text,
        'scenario': {'module': scenario.module, 'name': scenario.name},
        'case': source.expression(trial.case),
        'faults': [source.expression(fault) for fault in trial.faults],
        'fault_seed': trial.seed,
        'seed': seed,
        'world': finding.first_world,
        'digest': finding.digest,
        'versions': finding.versions,
    }
    return json.dumps(fields, indent=2) + '\n'


def test_source(finding: Finding, folder: Path, name: str, seed: int) -> str:
    """Return the source of a test in a folder, `test_` and its name, that reproduces a finding."""
    source = Source()
    setting, trial, violation = finding.setting, finding.trial, finding.violation
    scenario = setting.scenario
    case = source.expression(trial.case)
    faults = ', '.join(map(source.expression, trial.faults))
    required = ''
    key = printable(violation.key, LONGEST_KEY)
    title, description = f'{key}, at {violation.seconds:g} s.', violation.headline
    if violation.index >= 0:
        title = f'{key} is violated at {violation.seconds:g} s.'
        description = '\n'.join(violation.text.strip().splitlines()[:10])
        expression = source.expression(setting.properties[violation.index])
        required = f'    lockstep.require({expression})\n'
    imported = {(TESTING, 'reproducing')}
    loads = []
    for module, member in ((scenario.module, scenario.name), *sorted(source.imports)):
        if scenario.root is None or module.startswith('diffdrive_jacobian.'):
            imported.add((module, member))
        else:
            place = _place(Path(scenario.root), folder.resolve())
            loads.append(f'{member} = scenario_from({place}, {module!r}, {member!r})')
            imported.add((TESTING, 'scenario_from'))
    imports = ['from pathlib import Path', '', *(['import pytest', ''] if setting.args else [])]
    for module, group in groupby(sorted(imported), key=itemgetter(0)):
        imports.append(f'from {module} import {", ".join(member for _, member in group)}')
    return TEST.format(
        title=_quoted(title),
        description=_quoted(description),
        seed=seed,
        imports='\n'.join(imports) + '\n',
        loads='\n'.join(loads),
        case=case,
        faults=f'FAULTS = [{faults}]\n' if trial.faults else '',
        marker=f'@pytest.mark.lockstep(args={list(setting.args)!r})\n' if setting.args else '',
        name=name,
        inject=f'    lockstep.inject(*FAULTS, seed={trial.seed})\n' if trial.faults else '',
        require=required,
        file=CASE,
        scenario=scenario.name,
    )


def _place(root: Path, folder: Path) -> str:
    """Return an expression for a folder, relative to that of the test unless only `/` is common."""
    common = Path(os.path.commonpath([root, folder]))
    if common == Path(common.anchor):
        return repr(str(root))
    return f'HERE / {os.path.relpath(root, folder)!r}'


def _quoted(text: str) -> str:
    """Return a text that can stand in a docstring."""
    return text.replace('\\', '\\\\').replace('"""', "'''")
