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

"""Names of new files, and the directory in which a bag is written."""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress

from diffdrive_jacobian.bags.files import REPLACED, scratch_directory
from diffdrive_jacobian.plots import output_files
from diffdrive_jacobian.plots.output_files import free_stem


class Still(output_files.datetime):
    """A clock that stands still."""

    @classmethod
    def now(cls):
        return cls(2026, 1, 2, 3, 4, 5)


def test_a_free_stem_is_numbered_and_has_no_file_of_any_extension(tmp_path, monkeypatch):
    monkeypatch.setattr(output_files, 'datetime', Still)
    monkeypatch.chdir(tmp_path)
    stem = free_stem('a', ('png', 'csv'))
    assert stem == 'a_2026_01_02-03_04_05'
    (tmp_path / f'{stem}.csv').symlink_to('nowhere')
    assert free_stem('a', ('png', 'csv')) == f'{stem}__2'
    (tmp_path / f'{stem}__2.csv').touch()
    assert free_stem('a', ('png', 'csv')) == f'{stem}__3'
    assert free_stem('a', ('png',)) == stem


def test_remains_of_killed_processes_are_removed(tmp_path):
    made = {}
    for end in ('one', 'two', 'running', 'replacing', 'starting'):
        made[end] = tmp_path / f'.r[u]n.building-{end}'
        made[end].mkdir()
        if end != 'starting':
            (made[end] / 'r[u]n').mkdir()
            (made[end] / 'r[u]n' / 'r[u]n.mcap').write_bytes(b'data')
    (made['replacing'] / REPLACED).mkdir()
    (tmp_path / '.other.building-x' / 'other').mkdir(parents=True)
    (tmp_path / 'precious' / 'r[u]n').mkdir(parents=True)
    (tmp_path / '.r[u]n.building-link').symlink_to('precious')
    before = set(tmp_path.rglob('*'))
    running = os.open(made['running'], os.O_RDONLY)
    fcntl.flock(running, fcntl.LOCK_EX)
    with scratch_directory(tmp_path / 'r[u]n') as scratch:
        (scratch / 'r[u]n').mkdir()
        with scratch_directory(tmp_path / 'r[u]n') as second:
            assert second != scratch
        assert scratch.exists()
    os.close(running)
    # What stays is being written, has the bag that was replaced,
    # is about to be locked, or is of another bag.
    removed = made['one'], made['two']
    kept = {path for path in before if not any(path.is_relative_to(one) for one in removed)}
    assert set(tmp_path.rglob('*')) == kept


def test_the_directory_is_removed_also_after_an_error(tmp_path):
    with suppress(OSError), scratch_directory(tmp_path / 'run') as scratch:
        (scratch / 'run').mkdir()
        raise OSError('full')
    assert os.listdir(tmp_path) == []
