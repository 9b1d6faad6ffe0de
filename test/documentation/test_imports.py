"""The house: imports go down only, the pure half needs NumPy alone, and only the tools print."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import pytest

import diffdrive_jacobian
from diffdrive_jacobian.tools.entry_points import ROS_MODULES

PACKAGE = diffdrive_jacobian.__name__
HOUSE = Path(diffdrive_jacobian.__file__).parent
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
WITHOUT_ROS = ('messages', 'parameters', 'bags', 'calibration', 'plots')
# Modules beside the layers, and the layers they may import.
DOORS = {
    '__init__': (),
    'text': (),
    'time_units': (),
    'bounded_yaml': ('errors', 'text'),
    'errors': (),
    'lazy': (),
    'signals': (),
}
# Modules beside the layers that every layer may import.
COMMON = ('text', 'time_units', 'bounded_yaml', 'errors', 'lazy', 'signals')

LOUD = re.compile('print|stdout|stderr')

LOAD = """
import importlib, sys
import numpy
before = set(sys.modules)
importlib.import_module(sys.argv[1])
print(*sorted(set(sys.modules) - before))
"""


def sources(*layers):
    return [path for layer in layers for path in sorted((HOUSE / layer).rglob('*.py'))]


def place(path) -> str:
    """Give the layer of a file, or its name if it stands beside them."""
    first, *rest = path.relative_to(HOUSE).parts
    return first if rest else path.stem


def statements(node):
    """Yield the statements in a node of a syntax tree, anywhere in it."""
    for field in ('body', 'orelse', 'handlers', 'finalbody', 'cases'):
        for each in getattr(node, field, ()):
            yield each
            yield from statements(each)


@lru_cache
def imported(path) -> frozenset[str]:
    """Collect what a file imports, anywhere in it: `a`, `a.b` or, of `from a import b`, also `a.b`."""
    package = '.'.join((PACKAGE, *path.parent.relative_to(HOUSE).parts))
    names = set()
    for node in statements(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = importlib.util.resolve_name('.' * node.level + (node.module or ''), package)
            names.update({module, *(f'{module}.{alias.name}' for alias in node.names)})
    return frozenset(names)


def test_every_directory_of_the_house_has_its_place():
    found = {path.relative_to(HOUSE).parts[0] for path in HOUSE.rglob('*.py') if path.parent != HOUSE}
    assert found == set(LAYERS)
    assert {path.stem for path in HOUSE.glob('*.py')} == set(DOORS)


@pytest.mark.parametrize(
    'path', sorted(HOUSE.rglob('*.py')), ids=lambda path: str(path.relative_to(HOUSE))
)
def test_imports_go_down_only(path):
    here = place(path)
    allowed = DOORS[here] if here in DOORS else (*COMMON, *LAYERS[: LAYERS.index(here) + 1])
    ours = {name.split('.')[1] for name in imported(path) if name.startswith(f'{PACKAGE}.')}
    assert ours & {*LAYERS, *DOORS} <= set(allowed)


@pytest.mark.parametrize('path', sources(*PURE), ids=lambda path: str(path.relative_to(HOUSE)))
def test_the_pure_half_names_nothing_but_numpy(path):
    outside = {name.split('.')[0] for name in imported(path)} - sys.stdlib_module_names
    assert outside <= {'numpy', PACKAGE}


@pytest.mark.parametrize('layer', [*PURE, 'calibration'])
def test_the_pure_half_loads_nothing_but_numpy(layer):
    """In an interpreter of its own: no rclpy, no message package, no rosbags, nothing from above."""
    run = subprocess.run(
        [sys.executable, '-c', LOAD, f'{PACKAGE}.{layer}'],
        cwd=HOUSE.parent,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    loaded = set(run.stdout.split())
    assert f'{PACKAGE}.{layer}' in loaded
    assert {name.split('.')[0] for name in loaded} - sys.stdlib_module_names <= {'numpy', PACKAGE}
    floors = {name.split('.')[1] for name in loaded if name.startswith(f'{PACKAGE}.')}
    assert floors <= {*COMMON, *LAYERS[: LAYERS.index(layer) + 1]}


@pytest.mark.parametrize('layer', WITHOUT_ROS)
def test_reading_and_drawing_load_nothing_of_ros(layer):
    """In an interpreter of its own, with every module of the layer."""
    modules = [f'{PACKAGE}.{layer}.{path.stem}' for path in sources(layer)]
    program = f'import sys\nimport {", ".join(one.removesuffix(".__init__") for one in modules)}\n'
    program += 'print(*sorted({name.split(".")[0] for name in sys.modules}))'
    run = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60
    )
    loaded = set(run.stdout.split())
    assert PACKAGE in loaded
    assert not loaded & {*ROS_MODULES, 'rpyutils', 'matplotlib', 'rich'}


@pytest.mark.parametrize('path', sources(*WITHOUT_ROS), ids=lambda path: str(path.relative_to(HOUSE)))
def test_reading_and_drawing_name_ros_only_where_it_is_optional(path):
    named = {name.split('.')[0] for name in imported(path)} & set(ROS_MODULES)
    checked_only = {'messages/conversion.py'}
    assert not named or str(path.relative_to(HOUSE)) in checked_only


def test_only_the_tools_print():
    """Neither `print` nor a standard stream is named below the tools."""
    loud = set()
    for path in HOUSE.rglob('*.py'):
        text = path.read_text(encoding='utf-8')
        for node in ast.walk(ast.parse(text)) if LOUD.search(text) else ():
            named = getattr(node, 'id', None) == 'print' or getattr(node, 'attr', None) in (
                'stdout',
                'stderr',
            )
            if isinstance(node, (ast.Name, ast.Attribute)) and named:
                loud.add(place(path))
    assert loud == {'tools'}
