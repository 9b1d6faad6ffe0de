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

"""The test that reproduces a finding, and its case, as text."""

from __future__ import annotations

import json
import os
from itertools import groupby
from operator import itemgetter
from pathlib import Path

from diffdrive_jacobian.exploration.own_files import CASE
from diffdrive_jacobian.exploration.result import LONGEST_KEY, Finding
from diffdrive_jacobian.exploration.scenario import Source
from diffdrive_jacobian.relations.base import Relation
from diffdrive_jacobian.text import printable

TESTING = 'diffdrive_jacobian.testing'
TEST = '''"""{title}

{description}

Found and written by explore(seed={seed}). Passes once the node is mended.
"""

{imports}
HERE = Path(__file__).resolve().parent
{loads}
CASE = {case}
{faults}

{test}
'''
IN_WORLD = """{marker}def test_{name}(lockstep):
{inject}{require}    # To stop there in a debugger: lockstep.pause_at({seconds!r})
    with reproducing(lockstep, HERE / '{file}'):
        {scenario}(lockstep, CASE)
        lockstep.finish()"""
WITH_IMAGE = """def test_{name}():
    # To stop there in a debugger, add: pause_at={seconds!r}
    with reproducing(None, HERE / '{file}'):
        check_relation({scenario}, {relation}, case=CASE{arguments})"""


def case_source(finding: Finding, seed: int) -> str:
    """Return the content of the file with the case of a finding, as JSON."""
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
    required = relation = ''
    key = printable(violation.key, LONGEST_KEY)
    title, description = f'{key}, at {violation.seconds:g} s.', violation.headline
    if violation.index >= 0:
        title = f'{key} is violated at {violation.seconds:g} s.'
        description = '\n'.join(violation.text.strip().splitlines()[:10])
        one = setting.required(violation.index)
        expression = source.expression(one)
        if isinstance(one, Relation):
            relation = expression
        else:
            required = f'    lockstep.require({expression})\n'
    imported = {(TESTING, 'reproducing')}
    if relation:
        imported.add(('diffdrive_jacobian.relations', 'check_relation'))
    loads = []
    for module, member in ((scenario.module, scenario.name), *sorted(source.imports)):
        if scenario.root is None or module.startswith('diffdrive_jacobian.'):
            imported.add((module, member))
        else:
            place = _place(Path(scenario.root), folder.resolve())
            loads.append(f'{member} = scenario_from({place}, {module!r}, {member!r})')
            imported.add((TESTING, 'scenario_from'))
    needs_pytest = setting.args and not relation
    imports = ['from pathlib import Path', '', *(['import pytest', ''] if needs_pytest else [])]
    for module, group in groupby(sorted(imported), key=itemgetter(0)):
        imports.append(f'from {module} import {", ".join(member for _, member in group)}')
    common = {'name': name, 'seconds': violation.seconds, 'file': CASE, 'scenario': scenario.name}
    if relation:
        arguments = f', faults=FAULTS, seed={trial.seed}' if trial.faults else ''
        arguments += f', args={list(setting.args)!r}' if setting.args else ''
        test = WITH_IMAGE.format(**common, relation=relation, arguments=arguments)
    else:
        test = IN_WORLD.format(
            **common,
            marker=f'@pytest.mark.lockstep(args={list(setting.args)!r})\n' if setting.args else '',
            inject=f'    lockstep.inject(*FAULTS, seed={trial.seed})\n' if trial.faults else '',
            require=required,
        )
    return TEST.format(
        title=_quoted(title),
        description=_quoted(description),
        seed=seed,
        imports='\n'.join(imports) + '\n',
        loads='\n'.join(loads),
        case=case,
        faults=f'FAULTS = [{faults}]\n' if trial.faults else '',
        test=test,
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
