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

"""The layers: imports go down only, the pure ones need NumPy alone, and only the tools print."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

import diffdrive_jacobian
from diffdrive_jacobian.tools.entry_points import ROS_MODULES

PACKAGE = diffdrive_jacobian.__name__
ROOT = Path(diffdrive_jacobian.__file__).parent
FILES = sorted(ROOT.rglob('*.py'))
# From the ground up: each layer may import itself and what stands before it.
LAYERS = (
    *('numerics', 'kinematics', 'control', 'simulation'),
    *('messages', 'parameters', 'bags', 'calibration', 'plots'),
    *('ros', 'nodes', 'diagnosis', 'recording', 'lockstep', 'faults', 'properties'),
    *('relations', 'exploration', 'drives'),
    *('testing', 'robot_testing', 'live', 'grading', 'exercises', 'tools'),
)
PURE = LAYERS[:4]
# These may load rosbags and what it needs, but nothing of ROS, and matplotlib only when they draw.
WITHOUT_ROS = LAYERS[4:9]
COMMON = ('text', 'time_units', 'errors', 'lazy', 'safe_yaml', 'signals', 'locks')
"""Modules beside the layers, which every layer may import. They import none of the package."""
TYPES = 'TYPE_CHECKING'


def place(path) -> str:
    """Return the layer of a file, or its name if it stands beside them."""
    first, *rest = path.relative_to(ROOT).parts
    return first if rest else path.stem


def imports(path) -> set[str]:
    """Return what a file imports, anywhere in it: `a.b`, and `a.b` and `a` of `from a import b`."""
    found = set()
    package = '.'.join((PACKAGE, *path.parent.relative_to(ROOT).parts))
    pending = [ast.parse(path.read_text(encoding='utf-8'))]
    while pending:
        node = pending.pop()
        if path.name == '__init__.py' and isinstance(node, ast.If) and TYPES in ast.unparse(node.test):
            # Names that are imported on first use, wherever they are.
            continue
        # Statements only.
        for field in ('body', 'orelse', 'handlers', 'finalbody', 'cases'):
            pending += getattr(node, field, ())
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = importlib.util.resolve_name('.' * node.level + (node.module or ''), package)
            found.update({module, *(f'{module}.{alias.name}' for alias in node.names)})
    return found


@pytest.mark.slow
def test_every_module_has_its_place_and_imports_go_down_only():
    assert {place(path) for path in FILES} == {*LAYERS, *COMMON, '__init__'}
    for path in FILES:
        names, here = imports(path), place(path)
        first = {name.split('.')[0] for name in names}
        allowed = ()
        if here in LAYERS:
            allowed = (*COMMON, *LAYERS[: LAYERS.index(here) + 1])
        ours = {name.split('.')[1] for name in names if name.startswith(f'{PACKAGE}.')}
        assert ours & {*LAYERS, *COMMON} <= {*allowed}, path
        if here in PURE:
            assert first - sys.stdlib_module_names <= {'numpy', PACKAGE}, path
        if here in WITHOUT_ROS and path.relative_to(ROOT) != Path('messages/conversion.py'):
            assert not first & {*ROS_MODULES}, path


def modules(layers) -> list[str]:
    files = [path.relative_to(ROOT.parent).with_suffix('') for path in FILES if place(path) in layers]
    return [str(path).replace('/', '.').removesuffix('.__init__') for path in files]


@pytest.mark.process
def test_the_pure_layers_load_nothing_but_numpy_and_reading_and_drawing_nothing_of_ros():
    """One after the other, in an interpreter of its own."""
    pure = [*modules(PURE), f'{PACKAGE}.calibration']
    program = 'import sys, numpy; before = set(sys.modules)\n'
    for names in (pure, modules(WITHOUT_ROS)):
        program += f'import {", ".join(names)}\nprint(*set(sys.modules) - before)\n'
    run = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60
    )
    first, both = (set(line.split()) for line in run.stdout.splitlines())
    loaded, more = ({name.split('.')[0] for name in names} for names in (first, both))
    assert loaded - sys.stdlib_module_names <= {'numpy', PACKAGE}
    assert not more & {*ROS_MODULES, 'rpyutils', 'matplotlib', 'rich'}


def test_only_the_tools_print():
    """Neither `print` nor a standard stream is named below the tools, but those of other processes."""
    loud = set()
    for path in FILES:
        text = path.read_text(encoding='utf-8')
        # Few files are worth parsing.
        for node in ast.walk(ast.parse(text)) if 'print' in text or 'std' in text else ():
            printing = isinstance(node, ast.Name) and node.id == 'print'
            if printing or (isinstance(node, ast.Attribute) and node.attr in ('stdout', 'stderr')):
                loud.add(place(path))
    assert loud == {'tools', 'grading'}


def test_every_source_says_whose_it_is_and_under_which_licence():
    def header(path):
        # In C and C++ behind //, as half of the address is. The year is that of the file.
        first = path.read_text(encoding='utf-8').replace('//', '#').partition('\n\n')[0]
        return re.sub(r' 20\d\d ', ' ', first)

    folders = (ROOT, Path(__file__).parents[1])
    sources = [
        path
        for folder in folders
        for ending in ('py', 'c', 'cpp')
        for path in folder.rglob(f'*.{ending}')
    ]
    assert len(sources) > 500
    assert [path for path in sources if header(path) != header(Path(__file__))] == []
