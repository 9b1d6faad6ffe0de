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
        (made[end] / 'r[u]n').mkdir(parents=True)
        (made[end] / 'r[u]n' / 'r[u]n.mcap').write_bytes(b'data')
    (made['replacing'] / REPLACED).mkdir()
    (made['starting'] / 'r[u]n' / 'r[u]n.mcap').unlink()
    (made['starting'] / 'r[u]n').rmdir()
    other = tmp_path / '.other.building-x' / 'other'
    other.mkdir(parents=True)
    (tmp_path / 'precious' / 'r[u]n').mkdir(parents=True)
    (tmp_path / '.r[u]n.building-link').symlink_to('precious')
    running = os.open(made['running'], os.O_RDONLY)
    fcntl.flock(running, fcntl.LOCK_EX)
    with scratch_directory(tmp_path / 'r[u]n') as scratch:
        (scratch / 'r[u]n').mkdir()
        with scratch_directory(tmp_path / 'r[u]n') as second:
            assert second != scratch
        assert scratch.exists()
    os.close(running)
    # Being written, with the bag that was replaced, about to be locked, a link, of another bag.
    kept = [made[end] for end in ('running', 'replacing', 'starting')]
    assert sorted(tmp_path.iterdir()) == sorted(
        [*kept, tmp_path / '.r[u]n.building-link', tmp_path / 'precious', other.parent]
    )
    assert (tmp_path / 'precious' / 'r[u]n').exists()


def test_the_directory_is_removed_also_after_an_error(tmp_path):
    with suppress(OSError), scratch_directory(tmp_path / 'run') as scratch:
        (scratch / 'run').mkdir()
        raise OSError('full')
    assert os.listdir(tmp_path) == []
