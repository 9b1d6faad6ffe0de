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

"""The folder of a finding: which files in it an exploration has written, and so may remove."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

BAG, PICTURE = 'run', 'run.png'
"""Names of the bag and of the picture."""
CASE = 'counterexample.json'
"""Name of the file with the case."""
MARK = '.written_by_explore'
"""Name of the file that lists what was written into a folder, with SHA-256 sums."""
MARK_TITLE = '# written by explore into {folder}; it removes a file only if it has this SHA-256 sum'
"""First line of that file. A folder that was renamed or copied has another name."""


def is_free(folder: Path) -> bool:
    """Return whether a finding can be written into a folder without overwriting anything else."""
    if not os.path.lexists(folder):
        return True
    with suppress(OSError):
        return not folder.is_symlink() and (bool(own_files(folder)) or not any(folder.iterdir()))
    return False


def own_files(folder: Path) -> list[Path]:
    """Return the files that an exploration has written into a folder, which may be removed.

    Empty if one of them was changed, if the test was renamed, or if there is anything else in the bag or
    under the name of a file of a finding.
    """
    listed = folder / MARK
    if folder.is_symlink() or listed.is_symlink() or not listed.is_file():
        return []
    title, *lines = listed.read_text(encoding='utf-8', errors='replace').split('\n')
    if title != MARK_TITLE.format(folder=folder.name):
        return []
    written = {name: checksum for checksum, _, name in (line.partition('  ') for line in lines)}
    present = {str(path.relative_to(folder)): path for path in files_below(folder)}
    own = {
        name: path
        for name, path in present.items()
        if name in written and path.is_file() and not path.is_symlink()
        if written[name] == _checksum(path)
    }
    reserved = {CASE, path_of_test(folder).name, BAG, PICTURE, *written}
    others = {name.partition('/')[0] for name in present.keys() - own.keys()}
    return [] if path_of_test(folder).name not in own or others & reserved else [*own.values(), listed]


def remove(folder: Path) -> None:
    """Remove what an exploration has written into a folder, and the folder if nothing else is in it."""
    own = own_files(folder)
    cache = folder / '__pycache__'
    if own and not cache.is_symlink():
        # What pytest compiled.
        own += cache.glob(f'{path_of_test(folder).stem}.*.pyc')
    for file in own:
        file.unlink()
    for part in (folder / BAG, cache, folder) if own else ():
        if part.is_dir() and not part.is_symlink() and not any(part.iterdir()):
            part.rmdir()


def path_of_test(folder: Path) -> Path:
    """Return the path of the test in the folder of a finding."""
    return folder / f'test_{re.sub("(?<=[a-z0-9])(?=[A-Z])", "_", folder.name).lower()}.py'


def mark(folder: Path, files: Iterable[Path]) -> None:
    """Note that files were written into a folder."""
    with (folder / MARK).open('a', encoding='utf-8') as file:
        file.writelines(f'{_checksum(one)}  {one.relative_to(folder)}\n' for one in files)


def files_below(folder: Path) -> Iterator[Path]:
    """Yield all files below a folder, and the links, which are not followed."""
    for root, folders, files in os.walk(folder):
        for name in (*files, *folders):
            path = Path(root, name)
            if path.is_symlink() or not path.is_dir():
                yield path


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
