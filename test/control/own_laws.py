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

"""Controllers of other packages: the examples of doc/controllers.md."""

from __future__ import annotations

import re
from itertools import count
from pathlib import Path

from diffdrive_jacobian.control.controllers import ALL_PATH_CONTROLLERS, CONTROLLERS
from diffdrive_jacobian.live import settings

PAGE = (Path(__file__).parents[2] / 'doc' / 'controllers.md').read_text()
EXAMPLES = dict(re.findall(r'```python\n# (\w+)\.py\n(.*?)```', PAGE, re.DOTALL))
"""Source code by the name of its file."""
numbers = count()


def example(name):
    """Return the controller of an example."""
    namespace = {}
    exec(EXAMPLES[name], namespace)
    return namespace['CONTROLLER']


class Site:
    """A directory of installed packages, which is searched by this process during a test."""

    def __init__(self, path, monkeypatch):
        path.mkdir()
        self._path = path
        monkeypatch.syspath_prepend(str(path))
        for known in (CONTROLLERS, ALL_PATH_CONTROLLERS):
            monkeypatch.setattr(known, '_known', dict(known.built_in))
        settings._installed.cache_clear()
        settings._names.cache_clear()

    def install(self, name, source=None, *, package=None, version='1.2'):
        """Install a package that provides a controller; return the name of its module.

        It is the example of that name, or else that of `my_law` under this name.
        """
        if source is None:
            source = EXAMPLES.get(name, EXAMPLES['my_law'].replace("name='my_law'", f"name='{name}'"))
        module = f'provider_{next(numbers)}'
        entry_points = f'[diffdrive_jacobian.controllers]\n{name} = {module}:CONTROLLER\n'
        self.add(module, source, package or f'{name}-laws', version, entry_points)
        return module

    def add(self, module, source, package, version, entry_points):
        """Write a module and what describes its package."""
        (self._path / f'{module}.py').write_text(source)
        information = self._path / f'{package.replace("-", "_")}-{version}.dist-info'
        information.mkdir()
        description = f'Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n'
        (information / 'METADATA').write_text(description)
        (information / 'entry_points.txt').write_text(entry_points)
