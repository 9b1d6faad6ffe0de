"""What is written about a finding: the case, a test that reproduces it, a bag and a picture."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from diffdrive_jacobian.bags.journal import JOURNAL
from diffdrive_jacobian.exploration.child import ChildDiedError, call_in_child
from diffdrive_jacobian.exploration.errors import ExplorationError
from diffdrive_jacobian.exploration.recorded_world import BAG, PICTURE, record
from diffdrive_jacobian.exploration.result import Finding
from diffdrive_jacobian.exploration.scenario import ScenarioName
from diffdrive_jacobian.exploration.source import Source
from diffdrive_jacobian.exploration.worker import can_run_here

CASE = 'counterexample.json'
"""Name of the file with the case."""
WRITTEN = 'Found and written by explore'
"""Words of each test that is written."""
TEST = '''"""{title}

{description}

{written}(seed={seed}). Passes once the controller is mended.
"""

{imports}
HERE = Path(__file__).resolve().parent
{loads}
CASE = {case}
FAULTS = [{faults}]


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
    seed: int = 0,
    executor: Executor | None = None,
) -> Finding:
    """Write a finding into a folder of its own, in the place of one of an earlier exploration.

    What cannot be written is noted in the finding.

    Args:
        finding: The finding.
        output: Folder of all findings.
        others: Findings that have a folder already.
        seed: Seed of the exploration.
        executor: Runs the case again, to write the bag and the picture, on this machine; None: these are
            not written.

    Returns:
        The finding, with its folder.
    """
    taken = {other.directory for other in others}
    stem = re.sub(r'\W+', '_', finding.violation.name)
    number, folder = 1, output / stem
    while folder in taken or _is_foreign(folder):
        number += 1
        folder = output / f'{stem}_{number}'
    notes = list(finding.notes)
    try:
        folder.mkdir(exist_ok=True)
        _remove_earlier(folder)
        (folder / CASE).write_text(_case(finding, seed))
        name = _snake(folder.name)
        (folder / f'test_{name}.py').write_text(test_source(finding, folder, name, seed))
        if executor is not None:
            notes += _record(finding, folder, executor)
    except OSError as error:
        notes.append(f'not written: {error}')
    return replace(finding, directory=folder, notes=tuple(notes))


def _is_foreign(folder: Path) -> bool:
    """Return whether a folder has files, and none of an earlier exploration."""
    return folder.is_dir() and not (folder / CASE).exists() and any(folder.iterdir())


def remove_others(output: Path, findings: Sequence[Finding]) -> None:
    """Remove what an earlier exploration has written, other than what was found again.

    Other files stay, and so do the files of a counterexample that was renamed or copied from elsewhere.

    Args:
        output: Folder of all findings.
        findings: What was found now.
    """
    kept = {finding.directory.name for finding in findings if finding.directory is not None}
    for case in output.glob(f'*/{CASE}'):
        folder = case.parent
        test = folder / f'test_{_snake(folder.name)}.py'
        if folder.name in kept or folder.is_symlink() or not _is_written(test):
            continue
        with suppress(OSError):
            # What pytest compiled would keep the folders.
            for file in (test, *folder.glob(f'__pycache__/{test.stem}.*')):
                file.unlink()
            _remove_earlier(folder)
            for empty in (folder / '__pycache__', folder):
                if empty.is_dir() and not any(empty.iterdir()):
                    empty.rmdir()


def _is_written(test: Path) -> bool:
    """Return whether a file is a test that `explore` has written."""
    try:
        return WRITTEN in test.read_text(errors='replace')
    except OSError:
        return False


def _remove_earlier(folder: Path) -> None:
    """Remove what an earlier exploration has written into a folder."""
    shutil.rmtree(folder / BAG, ignore_errors=True)
    # The journal is there if the process of the recording ended.
    for file in (folder / PICTURE, folder / CASE, folder / (BAG + JOURNAL)):
        file.unlink(missing_ok=True)


def _record(finding: Finding, folder: Path, executor: Executor) -> list[str]:
    """Record the smallest case. Return notes on what could not be written."""
    arguments = finding.setting, finding.trial, finding.violation.index, str(folder)
    try:
        return executor.submit(_record_in_process, *arguments).result()
    except ChildDiedError as error:
        return [f'not recorded: {error}']


def _record_in_process(*arguments: Any) -> list[str]:
    return list(record(*arguments) if can_run_here() else call_in_child(record, *arguments))


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
    """Return the source of a test that reproduces a finding.

    Args:
        finding: The finding.
        folder: Folder of the test and of the case.
        name: Name of the test, without `test_`.
        seed: Seed of the exploration.
    """
    source = Source()
    setting, trial, violation = finding.setting, finding.trial, finding.violation
    case = source.expression(trial.case)
    faults = ', '.join(source.expression(fault) for fault in trial.faults)
    required = ''
    if violation.index >= 0:
        expression = source.expression(setting.properties[violation.index])
        required = f'    lockstep.require({expression})\n'
    local = {one for one in source.imports if not one[0].startswith('diffdrive_jacobian.')}
    imports = ['from pathlib import Path', '']
    marker = ''
    if setting.args:
        imports += ['import pytest', '']
        marker = f'@pytest.mark.lockstep(args={list(setting.args)!r})\n'
    names: dict[str, list[str]] = {'diffdrive_jacobian.testing': ['reproducing', 'scenario_from']}
    for module, member in source.imports - local:
        names.setdefault(module, []).append(member)
    if setting.scenario.root is None:
        names[setting.scenario.module] = [setting.scenario.name]
        names['diffdrive_jacobian.testing'].remove('scenario_from')
    loads = [_load(folder, setting.scenario, setting.scenario.module, setting.scenario.name)]
    loads += [_load(folder, setting.scenario, *one) for one in sorted(local)]
    loads = [line for line in loads if line]
    imports += [f'from {module} import {", ".join(sorted(names[module]))}' for module in sorted(names)]
    title, description = f'{violation.key}, at {violation.seconds:g} s.', violation.headline
    if violation.index >= 0:
        title = f'{violation.key} is violated at {violation.seconds:g} s.'
        description = '\n'.join(violation.text.strip().splitlines()[:10])
    return TEST.format(
        title=_quoted(title),
        description=_quoted(description),
        written=WRITTEN,
        seed=seed,
        imports='\n'.join(imports) + '\n',
        loads='\n'.join(loads),
        case=case,
        faults=faults,
        marker=marker,
        name=name,
        inject=f'    lockstep.inject(*FAULTS, seed={trial.seed})\n' if trial.faults else '',
        require=required,
        file=CASE,
        scenario=setting.scenario.name,
    ).replace('FAULTS = []\n', '')


def _load(folder: Path, scenario: ScenarioName, module: str, name: str) -> str:
    """Return the line that imports an object of the user."""
    if scenario.root is None:
        return '' if name == scenario.name else f'from {module} import {name}'
    root, here = Path(scenario.root), folder.resolve()
    common = Path(os.path.commonpath([root, here]))
    place = (
        f'HERE / {os.path.relpath(root, here)!r}' if common != Path(common.anchor) else repr(str(root))
    )
    return f'{name} = scenario_from({place}, {module!r}, {name!r})'


def _quoted(text: str) -> str:
    """Return a text that can stand in a docstring."""
    return text.replace('\\', '\\\\').replace('"""', "'''")


def _snake(name: str) -> str:
    return re.sub(r'(?<=[a-z0-9])(?=[A-Z])', '_', name).lower()
