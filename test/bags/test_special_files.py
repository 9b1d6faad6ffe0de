"""Named pipes and devices in the place of a bag or of its files: they are refused without reading."""

from __future__ import annotations

import os
import shutil

import pytest
from test_damaged_bags import COUNT, make_bag

from diffdrive_jacobian.bags import BagError, NotABagError, read_run, recover


@pytest.fixture(scope='module', params=['mcap', 'sqlite3'])
def whole(request, tmp_path_factory):
    return make_bag(tmp_path_factory.mktemp('bags') / 'bag', request.param)


@pytest.fixture
def bag(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / 'bag')


def replace(path, kind):
    path.unlink()
    if kind == 'pipe':
        os.mkfifo(path)
    elif kind == 'device':
        path.symlink_to('/dev/zero')
    else:
        path.mkdir()


@pytest.mark.parametrize('kind', ['pipe', 'device', 'directory'])
def test_metadata(bag, kind):
    replace(bag / 'metadata.yaml', kind)
    with pytest.raises(BagError, match=r'metadata\.yaml is not a regular file \(`recover_run'):
        read_run(bag)
    recovery = recover(bag)
    assert recovery.lost[0] == 'metadata.yaml: metadata.yaml is not a regular file'
    assert len(read_run(recovery.bag).odometry) == COUNT


@pytest.mark.parametrize('kind', ['pipe', 'device', 'directory'])
def test_data_file(bag, kind):
    (file,) = (one for one in bag.iterdir() if one.suffix != '.yaml')
    replace(file, kind)
    with pytest.raises(BagError, match=f'{file.name} is not a regular file'):
        read_run(bag)
    with pytest.raises(NotABagError, match=r'neither \.mcap nor \.db3 files'):
        recover(bag)


@pytest.mark.parametrize('name', ['run', 'run.mcap', 'run.db3', 'run.journal.mcap'])
def test_whole_bag(tmp_path, name):
    os.mkfifo(tmp_path / name)
    for function in (read_run, recover):
        with pytest.raises(
            (BagError, NotABagError), match=f'{name} is not a bag: it is not a regular file'
        ):
            function(tmp_path / name)


def test_journal_beside_a_missing_bag(tmp_path):
    os.mkfifo(tmp_path / 'run.journal.mcap')
    for function in (read_run, recover):
        with pytest.raises((BagError, NotABagError), match='there is no bag'):
            function(tmp_path / 'run')


def test_one_of_two_data_files_is_reported(bag):
    (file,) = (one for one in bag.iterdir() if one.suffix != '.yaml')
    text = (bag / 'metadata.yaml').read_text()
    other = f'other{file.suffix}'
    (bag / 'metadata.yaml').write_text(text.replace(file.name, other))
    os.mkfifo(bag / other)
    with pytest.raises(BagError, match=f'{other} is not a regular file'):
        read_run(bag)
    recovery = recover(bag)
    assert f'{other} is not a regular file' in recovery.lost
    assert len(read_run(recovery.bag).odometry) == COUNT
