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

"""What is public: each object has one path, which the pages use, and the rest is internal."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import subprocess
import sys
from collections import Counter

import pytest
from documentation import pages

import diffdrive_jacobian

PACKAGE = diffdrive_jacobian.__name__
PACKAGES = [one.name for one in pkgutil.iter_modules(diffdrive_jacobian.__path__) if one.ispkg]


def test_every_public_object_has_one_path_and_a_docstring():
    public = pages.public_names()
    assert all(pages.sentence(value, path) for path, value in public.items())
    objects = [value for value in public.values() if callable(value) or inspect.ismodule(value)]
    count = Counter(map(id, objects))
    assert len(count) > 200
    assert not [one for one in objects if count[id(one)] > 1]


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


def test_a_package_is_public_or_says_that_it_is_internal():
    for name in PACKAGES:
        package = importlib.import_module(f'{PACKAGE}.{name}')
        public = getattr(package, '__all__', [])
        assert (name in diffdrive_jacobian.__all__) == bool(public)
        assert bool(public) == ('Internal' not in package.__doc__)
        others = {one for one, value in vars(package).items() if not inspect.ismodule(value)}
        others = {one for one in others - {*public} if not one.startswith('_')}
        assert others <= {'annotations', 'TYPE_CHECKING'}, name


def test_pages_import_public_names():
    public = {PACKAGE, *(f'{PACKAGE}.{path}' for path in pages.public_names())}
    blocks = (block for path in pages.PAGES.values() for block in pages.blocks(path.read_text()))
    for block in (one for one in blocks if one.language == 'python' and PACKAGE in one.code):
        for node in ast.walk(ast.parse(block.code)):
            if isinstance(node, ast.Import):
                names = {one.name for one in node.names}
            elif isinstance(node, ast.ImportFrom):
                names = {f'{node.module}.{one.name}' for one in node.names}
            else:
                continue
            own = {name for name in names if name.partition('.')[0] == PACKAGE}
            assert own <= public, block.code
