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

"""Write the API reference from the docstrings: `python doc/api.py [DIRECTORY]` (default: build/api).

Needs pdoc: `pip install '.[jazzy,plot,test,doc]'`. Every warning is an error.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import sys
import typing
import warnings
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Generic, TypeVar

import numpy.typing
import pdoc

PACKAGE = 'diffdrive_jacobian'
Scalar = TypeVar('Scalar', covariant=True)


class ArrayLike:
    """Stands for numpy.typing.ArrayLike, which is a union that fills a page."""


class NDArray(Generic[Scalar]):
    """Stands for numpy.typing.NDArray, which is written out as its parts otherwise."""


def abbreviate_numpy_types() -> None:
    """Have the types of NumPy written by their names. Call it before the package is imported."""
    for replacement in (ArrayLike, NDArray):
        replacement.__module__ = 'numpy.typing'
        setattr(numpy.typing, replacement.__name__, replacement)


def modules() -> list[ModuleType]:
    """Import and return all modules of the package."""
    package = importlib.import_module(PACKAGE)
    found = pkgutil.walk_packages(package.__path__, f'{PACKAGE}.')
    return [package, *(importlib.import_module(info.name) for info in found)]


def import_types(module: ModuleType) -> None:
    """Run what a module imports for type checkers only, so that its annotations can be resolved."""
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == 'TYPE_CHECKING':
            for statement in node.body:
                # Other packages have names that exist for type checkers only, too.
                with suppress(ImportError):
                    exec(compile(ast.Module([statement], []), module.__name__, 'exec'), vars(module))


def resolve_named_tuples(module: ModuleType) -> None:
    """Replace the annotations of named tuples, which are strings, by the types.

    pdoc evaluates them in the namespace of `collections`, where their names are unknown.
    """
    for _, member in inspect.getmembers(module, inspect.isclass):
        if hasattr(member, '_fields') and member.__module__ == module.__name__:
            hints = typing.get_type_hints(member)
            member.__new__.__annotations__ = {name: hints[name] for name in member._fields}


def main(directory: Path) -> None:
    """Write the pages."""
    abbreviate_numpy_types()
    package = modules()
    for prepare in (import_types, resolve_named_tuples):
        for module in package:
            prepare(module)
    warnings.simplefilter('error')
    # Private members, which are not in the reference.
    warnings.filterwarnings('ignore', message=rf'.* for {PACKAGE}[\w.]*\._\w+')
    pdoc.render.configure(docformat='google', show_source=True)
    pdoc.pdoc(PACKAGE, output_directory=directory)
    print(directory / 'index.html')


if __name__ == '__main__':
    main(Path(sys.argv[1] if len(sys.argv) > 1 else 'build/api'))
