"""The layers: imports go down only, the pure ones need NumPy alone, and only the tools print."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import sys
from collections import defaultdict
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
    *('exploration', 'drives'),
    *('live', 'testing', 'tools'),
)
PURE = LAYERS[:4]
# These may load rosbags and what it needs, but nothing of ROS, and matplotlib only when they draw.
WITHOUT_ROS = LAYERS[4:9]
# Modules beside the layers, which every layer may import, and what they may import themselves.
COMMON = {
    **dict.fromkeys(('text', 'time_units', 'errors', 'lazy', 'signals'), ()),
    'bounded_yaml': ('errors', 'text'),
}
LOUD = re.compile('print|stdout|stderr')


def place(path) -> str:
    """Give the layer of a file, or its name if it stands beside them."""
    first, *rest = path.relative_to(ROOT).parts
    return first if rest else path.stem


def statements(node):
    """Yield the statements in a node of a syntax tree, anywhere in it."""
    for field in ('body', 'orelse', 'handlers', 'finalbody', 'cases'):
        for each in getattr(node, field, ()):
            yield each
            yield from statements(each)


def imports() -> dict[Path, set[str]]:
    """Collect what each file imports, anywhere in it: `a.b`, and `a.b` and `a` of `from a import b`."""
    found = defaultdict(set)
    for path in FILES:
        package = '.'.join((PACKAGE, *path.parent.relative_to(ROOT).parts))
        for node in statements(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                found[path].update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                module = importlib.util.resolve_name('.' * node.level + (node.module or ''), package)
                found[path].update({module, *(f'{module}.{alias.name}' for alias in node.names)})
    return found


@pytest.mark.slow
def test_every_module_has_its_place_and_imports_go_down_only():
    assert {place(path) for path in FILES} == {*LAYERS, *COMMON, '__init__'}
    for path, names in imports().items():
        here, first = place(path), {name.split('.')[0] for name in names}
        allowed = {**COMMON, '__init__': ()}.get(here)
        if allowed is None:
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


def loaded(modules) -> set[str]:
    """Import modules in an interpreter of its own; return the top-level names that it has loaded."""
    program = f'import sys, numpy; before = set(sys.modules); import {", ".join(modules)}\n'
    program += 'print(*set(sys.modules) - before)'
    run = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60
    )
    names = set(run.stdout.split())
    assert {*modules} <= names
    return {name.split('.')[0] for name in names}


@pytest.mark.process
def test_the_pure_layers_load_nothing_but_numpy():
    names = loaded([*modules(PURE), f'{PACKAGE}.calibration'])
    assert names - sys.stdlib_module_names <= {'numpy', PACKAGE}


@pytest.mark.process
def test_reading_and_drawing_load_nothing_of_ros():
    assert not loaded(modules(WITHOUT_ROS)) & {*ROS_MODULES, 'rpyutils', 'matplotlib', 'rich'}


def test_only_the_tools_print():
    """Neither `print` nor a standard stream is named below the tools."""
    loud = set()
    for path in FILES:
        text = path.read_text(encoding='utf-8')
        for node in ast.walk(ast.parse(text)) if LOUD.search(text) else ():
            printing = isinstance(node, ast.Name) and node.id == 'print'
            if printing or (isinstance(node, ast.Attribute) and node.attr in ('stdout', 'stderr')):
                loud.add(place(path))
    assert loud == {'tools'}
