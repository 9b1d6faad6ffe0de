"""What is public: each object has one path, which the pages use, and the rest is internal."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import subprocess
import sys
from collections import defaultdict

import pytest
from documentation import pages

import diffdrive_jacobian

PACKAGE = diffdrive_jacobian.__name__
PACKAGES = [one.name for one in pkgutil.iter_modules(diffdrive_jacobian.__path__) if one.ispkg]


def test_every_public_object_has_one_path():
    paths = defaultdict(list)
    for path, value in pages.public_names().items():
        if callable(value) or inspect.ismodule(value):
            paths[id(value)].append(path)
    assert len(paths) > 200
    assert not [several for several in paths.values() if len(several) > 1]


@pytest.mark.process
def test_every_public_name_is_an_attribute_of_its_package():
    code = f"""
import importlib
for name in {PACKAGES}:
    package = importlib.import_module(f'{PACKAGE}.{{name}}')
    for one in getattr(package, '__all__', []):
        exec(f'from {PACKAGE}.{{name}} import {{one}}')
"""
    subprocess.run([sys.executable, '-c', code], check=True)


def test_every_public_name_has_a_docstring():
    undocumented = [
        path for path, value in pages.public_names().items() if not pages.sentence(value, path)
    ]
    assert undocumented == []


def test_a_package_is_public_or_says_that_it_is_internal():
    for name in PACKAGES:
        package = importlib.import_module(f'{PACKAGE}.{name}')
        public = getattr(package, '__all__', [])
        assert (
            (name in diffdrive_jacobian.__all__) == bool(public) == ('Internal' not in package.__doc__)
        )
        others = {one for one, value in vars(package).items() if not inspect.ismodule(value)}
        others = {one for one in others - {*public} if not one.startswith('_')}
        assert others <= {'annotations', 'TYPE_CHECKING'}, name


def test_pages_import_public_names():
    public = pages.public_names()
    for block in (block for path in pages.PAGES.values() for block in pages.blocks(path.read_text())):
        if block.language != 'python' or PACKAGE not in block.code:
            continue
        for node in ast.walk(ast.parse(block.code)):
            if isinstance(node, ast.ImportFrom) and node.module.partition('.')[0] == PACKAGE:
                module = node.module.removeprefix(PACKAGE).removeprefix('.')
                for one in node.names:
                    assert f'{module}.{one.name}'.removeprefix('.') in public, block.line
            elif isinstance(node, ast.Import):
                named = [one.name for one in node.names if one.name.startswith(f'{PACKAGE}.')]
                assert {one.removeprefix(f'{PACKAGE}.') for one in named} <= public.keys()
