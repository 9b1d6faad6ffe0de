"""Message types named by a bag: only packages whose share directory has the .msg are imported."""

from __future__ import annotations

import sys

import pytest
from std_msgs.msg import String

from diffdrive_jacobian.bags.message_definitions import UnknownTypeError, definition, message_class

INVALID = [
    '',
    'std_msgs',
    'std_msgs/String',
    'std_msgs/srv/String',
    'std_msgs/msg/string',
    'std_msgs/msg/String\n',
    'std_msgs/msg/../String',
    'std_msgs/msg/Strıng',
    'Std_msgs/msg/String',
    '../std_msgs/msg/String',
    'test.autotest.x/msg/X',
    'std_msgs.msg/msg/String',
    '_this/msg/X',
    'this/msg/',
    'a/b/msg/X',
]


@pytest.mark.parametrize('find', [definition, message_class])
@pytest.mark.parametrize('name', INVALID)
def test_invalid_names_are_refused(find, name):
    with pytest.raises(UnknownTypeError, match='must be named package/msg/Name'):
        find(name)


@pytest.mark.parametrize('find', [definition, message_class])
@pytest.mark.parametrize(
    'name', ['this/msg/X', 'antigravity/msg/Zen', 'std_msgs/msg/Nothing', 'sys/msg/X']
)
def test_modules_that_are_no_message_packages_are_not_imported(find, name, monkeypatch, capsys):
    package = name.split('/')[0]
    if package in ('this', 'antigravity'):
        monkeypatch.delitem(sys.modules, package, raising=False)
    before = set(sys.modules)
    with pytest.raises(UnknownTypeError, match=f'no installed package defines {name}'):
        find(name)
    assert capsys.readouterr().out == ''
    assert not {one for one in set(sys.modules) - before if one.split('.')[0] == package}


@pytest.mark.parametrize('find', [definition, message_class])
@pytest.mark.parametrize('entry', ['', '.', 'CWD'])
@pytest.mark.parametrize('place', ['.', 'lib'])
def test_code_beside_a_bag_is_not_imported(tmp_path, monkeypatch, find, entry, place):
    """Not even if a share directory lies there, too."""
    folder = tmp_path / place
    (folder / 'evil_msgs' / 'msg').mkdir(parents=True)
    (folder / 'evil_msgs' / '__init__.py').write_text('raise SystemExit("imported")')
    (folder / 'evil_msgs' / 'msg' / '__init__.py').write_text('class X: pass')
    (tmp_path / 'share' / 'evil_msgs' / 'msg').mkdir(parents=True)
    for ending in ('msg', 'json'):
        (tmp_path / 'share' / 'evil_msgs' / 'msg' / f'X.{ending}').write_text('')
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder) if entry == 'CWD' else entry)
    with pytest.raises(UnknownTypeError, match='no installed package defines evil_msgs/msg/X'):
        find('evil_msgs/msg/X')
    assert 'evil_msgs' not in sys.modules


def test_a_module_that_hides_a_message_package_is_not_imported(tmp_path, monkeypatch):
    """The .msg file is installed, but `import` would find other code of that name first."""
    (tmp_path / 'shape_msgs.py').write_text('raise SystemExit("imported")')
    prefix = tmp_path / 'opt'
    library = prefix / 'lib' / 'python3' / 'site-packages'
    (library / 'shape_msgs').mkdir(parents=True)
    (library / 'shape_msgs' / '__init__.py').write_text('')
    (prefix / 'share' / 'shape_msgs' / 'msg').mkdir(parents=True)
    (prefix / 'share' / 'shape_msgs' / 'msg' / 'Plane.msg').write_text('float64[4] coef\n')
    monkeypatch.syspath_prepend(str(library))
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UnknownTypeError):
        message_class('shape_msgs/msg/Plane')
    assert 'shape_msgs' not in sys.modules


GENERATED = """\
class Metaclass(type):
    _TYPE_SUPPORT = None

    @classmethod
    def __import_type_support__(cls):
        {statement}


class Mine(metaclass=Metaclass):
    pass
"""
"""Python code of a message type, reduced from what rosidl_generator_py generates."""


@pytest.fixture
def overlay(tmp_path, monkeypatch):
    """A function that installs `my_msgs/msg/Mine`, from its Python code and its description in JSON."""

    def install(code, described='{}'):
        library = tmp_path / 'lib' / 'python3.12' / 'site-packages'
        (library / 'my_msgs' / 'msg').mkdir(parents=True)
        (library / 'my_msgs' / '__init__.py').write_text('')
        (library / 'my_msgs' / 'msg' / '__init__.py').write_text(code)
        share = tmp_path / 'share' / 'my_msgs' / 'msg'
        share.mkdir(parents=True)
        (share / 'Mine.msg').write_text('int32 x\n')
        (share / 'Mine.json').write_text(described)
        monkeypatch.syspath_prepend(str(library))

    yield install
    for name in ('my_msgs', 'my_msgs.msg'):
        sys.modules.pop(name, None)
    for find in (definition, message_class):
        find.cache_clear()


def test_a_package_of_an_overlay_is_found(overlay):
    overlay(GENERATED.format(statement='cls._TYPE_SUPPORT = object()'))
    assert message_class('my_msgs/msg/Mine').__name__ == 'Mine'


@pytest.mark.parametrize(
    ('code', 'reason'),
    [
        (
            GENERATED.format(
                statement='from rosidl_generator_py import import_type_support\n'
                "        import_type_support('my_msgs')"
            ),
            'type support of my_msgs/msg/Mine cannot be loaded: UnsupportedTypeSupport',
        ),
        (GENERATED.format(statement='pass'), 'type support of my_msgs/msg/Mine is not installed'),
        ('class Mine: pass', 'type support of my_msgs/msg/Mine cannot be loaded: AttributeError'),
        ('invalid code', 'Python code of my_msgs/msg/Mine cannot be imported: SyntaxError'),
        ('', 'Python code of my_msgs/msg/Mine is not installed'),
    ],
)
def test_a_type_without_usable_python_code_is_unknown(overlay, code, reason):
    overlay(code)
    with pytest.raises(UnknownTypeError, match=reason):
        message_class('my_msgs/msg/Mine')


@pytest.mark.parametrize(
    'described', ['', '{', '[]', '{}', '{"type_hashes": []}', '{"type_hashes": [1]}', '[' * 100_000]
)
def test_a_type_with_an_invalid_description_is_unknown(overlay, described):
    overlay('', described)
    with pytest.raises(UnknownTypeError, match='definition of my_msgs/msg/Mine is invalid'):
        definition('my_msgs/msg/Mine')


def test_an_installed_message():
    assert message_class('std_msgs/msg/String') is String
    assert definition('std_msgs/msg/String').text.splitlines()[-1] == 'string data'
