"""Names of new files, and checks before they are written."""

from __future__ import annotations

from itertools import islice

import pytest

from diffdrive_jacobian.plots import output_files
from diffdrive_jacobian.plots.output_files import free_stem, names_by_time, new_file


class Still(output_files.datetime):
    """A clock that stands still."""

    @classmethod
    def now(cls):
        return cls(2026, 1, 2, 3, 4, 5)


def test_names_by_time_are_numbered(monkeypatch):
    monkeypatch.setattr(output_files, 'datetime', Still)
    stem = 'run_2026_01_02-03_04_05'
    assert list(islice(names_by_time('run'), 3)) == [stem, f'{stem}__2', f'{stem}__3']


def test_a_free_stem_has_no_file_of_any_extension(tmp_path, monkeypatch):
    monkeypatch.setattr(output_files, 'datetime', Still)
    monkeypatch.chdir(tmp_path)
    stem = free_stem('a', ('png', 'csv'))
    (tmp_path / f'{stem}.csv').symlink_to('nowhere')
    assert free_stem('a', ('png', 'csv')) == f'{stem}__2'
    assert free_stem('a', ('png',)) == stem


def test_a_new_file_is_checked(tmp_path):
    assert new_file(str(tmp_path / 'a.PNG'), ('png',), 'picture') == tmp_path / 'a.PNG'
    with pytest.raises(ValueError, match=r"the table must end in \.csv, got 'a.png'"):
        new_file('a.png', ('csv',), 'table')
    with pytest.raises(FileNotFoundError) as missing:
        new_file(str(tmp_path / 'no' / 'a.csv'), ('csv',), 'table')
    assert missing.value.filename == str(tmp_path / 'no' / 'a.csv')
    (tmp_path / 'a.csv').touch()
    with pytest.raises(FileExistsError, match='exists already; it is not overwritten'):
        new_file(str(tmp_path / 'a.csv'), ('csv',), 'table')
