"""What README.md and doc/ say is true: commands, code, outputs, parameters, topics, options, links."""

from __future__ import annotations

import argparse
import importlib
import inspect
import re
from functools import lru_cache
from importlib.metadata import entry_points as installed_entry_points
from importlib.util import find_spec

import numpy as np
import pytest
import yaml
from documentation import pages
from documentation.pages import PAGES, PARAMETERS, ROOT, blocks, check_output, is_run, run_page
from rclpy.parameter import Parameter

from diffdrive_jacobian import kinematics, plots
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge

TEXTS = {name: path.read_text() for name, path in PAGES.items()}
NODES = {'virtual_robot': VirtualRobot, 'go_to_goal': GoToGoal, 'wheel_bridge': WheelBridge}
TOOLS = sorted(
    {
        one.name
        for one in installed_entry_points(group='console_scripts')
        if one.value.startswith('diffdrive_jacobian.tools.')
    }
    - set(NODES)
)
LINK = re.compile(r'\]\(([^)\s]+)\)')
MOST_SKIPPED = 9
"""Blocks in all pages that no test runs: those that need pip, a ROS installation, a network."""


def section(page, heading):
    """Return a section of a page, without its heading."""
    pattern = rf'^##+ `?{re.escape(heading)}`?\n(.*?)(?=^##? |^### |\Z)'
    return re.search(pattern, TEXTS[page], re.MULTILINE | re.DOTALL).group(1)


# --- Code


@pytest.mark.pages
@pytest.mark.process
@pytest.mark.parametrize('name', [name for name in PAGES if any(map(is_run, blocks(TEXTS[name])))])
def test_code_runs_and_prints_what_the_page_quotes(tmp_path, name):
    for quoted, printed in run_page(TEXTS[name], tmp_path):
        check_output(quoted, printed)


@pytest.mark.parametrize('part', ['', 'part, '])
def test_numbers_are_compared_in_exact_quotations_only(part):
    (loose, exact) = blocks(
        f'<!-- output: {part} -->\n```text\nat 1 s  x\n```\n'
        f'<!-- output: {part}exact -->\n```text\nat 1 s  x\n```\n'
    )
    for quoted in (loose, exact):
        check_output(quoted, 'at 1 s x')
    check_output(loose, 'at 1.02 s x')
    with pytest.raises(AssertionError):
        check_output(exact, 'at 1.02 s x')


@pytest.mark.parametrize(
    ('quoted', 'printed', 'agree'),
    [
        ('0.0', '-0.0', True),
        ('0.206 m', '0.207 m', True),
        ('0.206 m', '0.208 m', False),
        ('1.25e-06', '1.26e-06', True),
        ('1.25e-06', '1.25e-05', False),
        ('5 steps', '6 steps', False),
        ('0.206 m', '0.206 mm', False),
    ],
)
def test_numbers_that_processors_round_differently_agree(quoted, printed, agree):
    assert pages.agree(quoted, printed, exact=True) == agree


def test_few_blocks_are_not_run():
    skipped = [block for text in TEXTS.values() for block in blocks(text) if 'skip' in block.notes]
    assert all(block.notes['skip'] for block in skipped)
    assert len(skipped) <= MOST_SKIPPED


def test_every_note_belongs_to_a_block():
    for name, text in TEXTS.items():
        notes = re.findall(r'^<!-- (?:test|output)', text, re.MULTILINE)
        assert len(notes) == sum(len(block.notes) for block in blocks(text)), name


def test_the_first_example_gives_the_numbers_in_its_comments():
    code = next(block.code for block in blocks(TEXTS['README.md']) if 'q_dot =' in block.code)
    names = {}
    exec(code, names)
    comments = [
        [float(number) for number in re.findall(r'-?\d+\.\d{3}', line.split('#')[1])]
        for line in code.splitlines()
        if '#' in line
    ]
    got = [[names['v'], names['omega']], [names['omega_R'], names['omega_L']], [*names['q_dot']]]
    for numbers, values in zip(comments, got, strict=False):
        assert numbers == [round(float(value), 3) for value in values]


def test_two_commands_of_one_line_each():
    commands = re.findall(r'^python3 -m venv .*$', TEXTS['README.md'], re.MULTILINE)
    assert len(commands) == 2
    assert commands[0].endswith('drive_to 1 1')
    assert commands[1].endswith('pytest -n auto')


def test_workflow_is_valid_yaml():
    (code,) = [
        block.code
        for text in TEXTS.values()
        for block in blocks(text)
        if (block.file or '').startswith('.github/')
    ]
    assert yaml.safe_load(code)['jobs']


def examples():
    """Return the table from the documents to the code: what each example says and must give."""
    for row in (
        TEXTS['doc/library.md']
        .split('| document | function |', 1)[1]
        .split('\n\n', 1)[0]
        .splitlines()[2:]
    ):
        what, functions, _, example = (cell.strip() for cell in row.strip('|').split('|'))
        yield pytest.param(functions, *re.findall(r'`([^`]+)`', example), id=what)


@pytest.mark.parametrize(('functions', 'first', 'second'), list(examples()))
def test_examples_of_the_documents_methods(functions, first, second):
    names = {}
    exec(next(b.code for b in blocks(TEXTS['doc/library.md']) if 'inverse_velocity' in b.code), names)
    exec(first, names)
    expression, expected = second.split('  # ')
    np.testing.assert_allclose(eval(expression, names), eval(expected), rtol=0.0, atol=6e-4)
    # What the second column names is there.
    for function in re.findall(r'`([\w.]+)`', functions):
        assert function.split('.')[-1] in library(), function


@lru_cache
def library():
    """Return every public name of the packages without ROS, methods included."""
    names = set()
    for module in (
        *(importlib.import_module(f'diffdrive_jacobian.{layer}') for layer in ('control', 'simulation')),
        *(getattr(kinematics, name) for name in kinematics.__all__),
    ):
        for name in dir(module):
            value = getattr(module, name)
            names.add(name)
            if inspect.isclass(value):
                names.update(vars(value))
    return names


# --- Bodies of functions


@pytest.mark.parametrize('name', [name for name, text in TEXTS.items() if '<!-- body' in text])
def test_bodies_of_functions_are_as_in_the_source(name):
    text = TEXTS[name]
    assert text.count('<!-- body') == len(pages.BODY.findall(text)), 'a comment without its py block'
    assert text == pages.with_bodies(text), 'python test/documentation/pages.py bodies writes them'


def test_a_body_is_the_function_without_decorators_and_docstring():
    place, stale = '<!-- body: diffdrive_jacobian.{} -->\n```py\n', 'of yesterday\n'
    contact = place.format('kinematics.contact.wheel_contact_position')
    method = place.format('kinematics.planar_arm.PlanarArm.integrate')
    old = f'{contact}{stale}```\n\ntext\n\n{method}```\n'
    new = pages.with_bodies(old)
    position = """\
def wheel_contact_position(x: Number, phi: Number, r: Number) -> Entries:
    return [x + r * sin(phi), r + r * cos(phi), 0.0]
"""
    assert new.startswith(f'{contact}{position}```\n\ntext\n\n{method}def ')
    assert stale not in new
    assert pages.with_bodies(new) == new
    with pytest.raises(AttributeError):
        pages.body('diffdrive_jacobian.kinematics.contact.removed')


# --- The documents, item by item

ITEMS = 138
"""What the five documents say, by the list of their items."""


def test_each_item_of_the_documents_is_in_one_table_with_functions_and_tests_that_exist():
    text = '\n'.join(TEXTS[f'doc/document_{name}.md'] for name in 'abcde')
    rows = re.findall(r'^\| (\d+) [^|]*\|([^|]*)\|(.*)', text, re.MULTILINE)
    assert [int(number) for number, _, _ in rows] == list(range(1, ITEMS + 1))
    known = {*library(), *plots.__all__, *TOOLS, *NODES}
    tests = {path.name for path in (ROOT / 'test').rglob('test_*.py')}
    for number, functions, rest in rows:
        for function in re.findall(r'`([\w.]+)', functions):
            assert function.split('.')[-1] in known, (number, function)
        for test in re.findall(r'`(test_\w+\.py)', rest):
            assert test in tests, (number, test)


# --- Nodes and tools


def test_parameter_tables_are_as_generated():
    text = TEXTS['doc/nodes.md']
    assert all(f'<!-- parameters of {name} -->' in text for name in PARAMETERS)
    assert text == pages.with_parameter_tables(text), 'pages.py parameters writes them'


@pytest.mark.parametrize('name', NODES)
def test_topics_and_services(lockstep, name):
    # The topics of a robot that slips are those of a perfect one, and ground_truth.
    slip = [Parameter('simulate_slip', value=True)] * (name == 'virtual_robot')
    node = lockstep.add(NODES[name](parameter_overrides=slip))
    other = {'cmd_vel': 'joint_command'} if name == 'virtual_robot' else {}
    table = section('doc/nodes.md', name).split('| topic', 1)[1].split('\n\n', 1)[0]
    documented = {re.search(r'`/?(\w+)`', row).group(1) for row in table.splitlines()[2:]}
    if find_spec('tf2_ros') is None:
        documented -= {'tf'}
    names = (
        node.get_publisher_names_and_types_by_node(name, '/')
        + node.get_subscriber_names_and_types_by_node(name, '/')
        + node.get_service_names_and_types_by_node(name, '/')
    )
    own = {
        topic.strip('/')
        for topic, _ in names
        if topic.count('/') == 1 and topic not in ('/rosout', '/parameter_events', '/clock')
    }
    assert documented == own | {alternative for topic, alternative in other.items() if topic in own}


COMMON = {'-h', '--help', '--version'}
"""Options of every tool, which the rules for all of them mention."""


def options_of(tool):
    parser = importlib.import_module(f'diffdrive_jacobian.tools.{tool}')._parser()
    # Those without help only refuse what other programs have.
    shown = [action for action in parser._actions if action.help != argparse.SUPPRESS]
    return {option for action in shown for option in action.option_strings} - COMMON


def test_options_of_the_tools():
    for tool in TOOLS:
        rows = re.findall(r'^\| (`-.*?) \| ', section('doc/tools.md', tool), re.MULTILINE)
        texts = re.findall(r'`(-[^`]+)`', ' '.join(rows))
        documented = {word for text in texts for word in re.findall(r'--?[a-z][a-z-]*', text)}
        assert documented == options_of(tool), tool


def test_options_in_blocks_that_are_not_run():
    skipped = [block for text in TEXTS.values() for block in blocks(text) if 'skip' in block.notes]
    for block in skipped:
        for line in block.code.splitlines():
            command = line.split('#')[0].split('--ros-args')[0]
            words = command.replace('ros2 run diffdrive_jacobian', '').split()
            if words and words[0] in TOOLS:
                used = {word.split('=')[0] for word in words[1:] if re.match(r'--?[a-z]', word)}
                assert used <= options_of(words[0]), line


# --- Links


def anchors(text):
    """Return the anchors of the headings of a page, as GitHub makes them."""
    headings = re.findall(r'^#+ (.*)$', re.sub(r'```.*?```', '', text, flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def test_links_lead_somewhere():
    for name, text in TEXTS.items():
        for target in LINK.findall(re.sub(r'```.*?```', '', text, flags=re.DOTALL)):
            file, _, anchor = target.partition('#')
            path = (PAGES[name].parent / file).resolve() if file else PAGES[name]
            if not target.startswith(('http://', 'https://')):
                assert path.is_relative_to(ROOT), target
                assert path.exists(), target
                assert not anchor or anchor in anchors(path.read_text()), target


def test_every_page_is_reached_from_the_index():
    linked = set(LINK.findall(TEXTS['doc/index.md']))
    assert {name.removeprefix('doc/') for name in PAGES if name.startswith('doc/')} - {
        'index.md'
    } <= linked


def test_design_lists_every_package_and_files_that_exist():
    text = TEXTS['doc/design.md']
    package = ROOT / 'diffdrive_jacobian'
    rows = section('doc/design.md', 'Packages').split('| package', 1)[1].split('\n\n', 1)[0]
    listed = re.findall(r'^\| `(\w+)` \|', rows, re.MULTILINE)
    packages = {path.parent.name for path in package.glob('*/__init__.py')}
    assert packages <= set(listed) <= packages | {path.stem for path in package.glob('*.py')}
    for file in re.findall(r'`([\w/]+\.(?:py|rst))`', text):
        assert (package / file).exists() or (ROOT / file).exists(), file


@pytest.mark.slow
def test_the_page_of_public_names_is_as_generated():
    """To write it, every public name is imported."""
    assert pages.PAGES['doc/public.md'].read_text() == pages.public_page()
