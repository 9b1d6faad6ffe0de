"""Controllers that this package does not contain: given in Python, or installed with other packages."""

from __future__ import annotations

import math
import os
import re
import sys
from dataclasses import fields, replace
from functools import partial
from itertools import count
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from fork_server import forked
from support.lockstep_nodes import ABORTED, SUCCEEDED, Controller, Topics, arrives, change, make
from support.ros_messages import goal, twists

from diffdrive_jacobian import control
from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.control import KP, KV, OFFSET, ControllerError, LawError, find_controller
from diffdrive_jacobian.control.controllers import BUILT_IN, Controllers
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.parameters.declaration import ParameterError
from diffdrive_jacobian.parameters.nodes import GoToGoalParameters
from diffdrive_jacobian.plots.sweep_figure import figure
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.simulation import SweepSetup, closed_loops, sweep
from diffdrive_jacobian.tools import drive_to, sweep_gains
from diffdrive_jacobian.tools.run_node import run_node

PAGE = Path(__file__).parents[2] / 'doc' / 'controllers.md'
SOURCE = '''
import numpy as np
from diffdrive_jacobian.control import Controller

def law(poses, goals, kp, kv):
    """Drive with a speed that has an upper bound."""
    dx, dy = goals[..., 0] - poses[..., 0], goals[..., 1] - poses[..., 1]
    theta = poses[..., 2]
    error = np.arctan2(np.sin(np.arctan2(dy, dx) - theta), np.cos(np.arctan2(dy, dx) - theta))
    return 0.7 * np.tanh(kv * np.hypot(dx, dy)) * np.cos(error), kp * error

CONTROLLER = Controller(name='{name}', law=law, summary='tanh speed')
'''


def defined(source, name):
    """Run a module's source; return what it calls by a name."""
    namespace = {}
    exec(source, namespace)
    return namespace[name]


MINE = defined(SOURCE.replace('{name}', 'mine'), 'CONTROLLER')
law = MINE.law


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A directory of installed packages, which is searched by this process."""
    path = tmp_path / 'site'
    path.mkdir()
    monkeypatch.syspath_prepend(str(path))
    return path


numbers = count()


@pytest.fixture
def install(site):
    """Install a package that provides a controller; return the name of its module.

    The module writes a file named `imported` beside it when it is imported.
    """

    def install(name, source=SOURCE, *, package=None, version='1.2'):
        module = f'provider_{next(numbers)}_{os.getpid()}'
        package = package or module.replace('_', '-')
        mark = 'from pathlib import Path\nPath(__file__).with_name("imported").touch()\n'
        (site / f'{module}.py').write_text(mark + source.replace('{name}', name))
        entry = f'[diffdrive_jacobian.controllers]\n{name} = {module}:CONTROLLER\n'
        register(site, package, version, entry)
        return module

    return install


def register(site, package, version, entry_points):
    """Write what describes an installed package."""
    information = site / f'{package.replace("-", "_")}-{version}.dist-info'
    information.mkdir()
    description = f'Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n'
    (information / 'METADATA').write_text(description)
    (information / 'entry_points.txt').write_text(entry_points)


def run(site, program, *arguments):
    """Run a command of this package in a process of its own that finds the packages in `site`."""
    environment = {**os.environ, 'PYTHONPATH': str(site), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}
    code = (
        f'import sys\nfrom diffdrive_jacobian.tools.entry_points import {program}\nsys.exit({program}())'
    )
    return forked.run(code, arguments, cwd=site.parent, env=environment, timeout=120)


# --- An installed package


def test_an_installed_controller_is_chosen_at_the_start_and_live(lockstep, install):
    install('chosen')
    controller = Controller(lockstep, controller='chosen', kp=4.0)
    controller.send(goal(1.0, 0.4))
    pose, target = np.array([0.2, 0.1, 0.3]), np.array([1.0, 0.4])
    expected = law(pose, target, 4.0, 0.5)
    assert controller.at(*pose) == pytest.approx(expected, rel=1e-12)
    assert change(controller.node, controller='go_to_goal').successful
    assert controller.at(*pose) == pytest.approx(control.go_to_goal(pose, target, 4.0, 0.5))
    assert change(controller.node, controller='chosen').successful
    assert controller.at(*pose) == pytest.approx(expected, rel=1e-12)


@pytest.mark.process
def test_an_installed_controller_drives_in_a_process_and_its_bag_is_read_without_it(
    site, install, monkeypatch
):
    """First with a package whose import would raise, then without the package."""
    module = install('driven')
    arguments = ('0.4', '0.2', '--lockstep', '-o', 'bag', '--no-plot', '--ros-args', '-p', 'kv:=4.0')
    ended = run(site, 'drive_to', *arguments, '-p', 'controller:=driven')
    assert ended.returncode == 0, ended.stderr
    (site / 'imported').unlink()
    mark = 'from pathlib import Path\nPath(__file__).with_name("imported").touch()\n'
    (site / f'{module}.py').write_text(f'{mark}raise RuntimeError')
    for path in (site, site / 'nowhere'):
        monkeypatch.syspath_prepend(str(path))
        read = timeline(read_run(site.parent / 'bag'))
        assert read.run.of_node('go_to_goal')['controller'] == 'driven'
        expected = law(read.run.odometry.values[0, :3], np.array([0.4, 0.2]), 3.0, 4.0)
        assert read.run.cmd_vel.values[0] == pytest.approx(expected, rel=1e-9)
        # Its driven point is not known, so the distance is that of the axle centre.
        distance = math.dist(read.run.odometry.values[-1, :2], (0.4, 0.2))
        assert read.distance[-1] == pytest.approx(distance)
        assert distance <= 0.021
    for program in (('plot_run', 'bag', '-o', 'run.png'), ('replay_run', 'bag', '--verify')):
        ended = run(site, *program)
        assert ended.returncode == 0, ended.stderr
    assert not (site / 'imported').exists()


def test_names_are_listed_and_checked_without_an_import(site, install, capsys):
    install('named')
    # A user may have installed others.
    assert {*BUILT_IN, 'named'} <= {*control.controller_names()}
    assert list(control.controller_names()) == sorted(control.controller_names())
    assert 'named' in Controllers()
    assert 'unnamed' not in Controllers()
    with pytest.raises(ParameterError, match=r"one of 'go_to_goal', 'named', .*, got 'other'"):
        GoToGoalParameters(controller='other')
    for main in (drive_to.main, sweep_gains.main, partial(run_node, 'go_to_goal')):
        with pytest.raises(SystemExit) as ended:
            main(['--help'], Signals())
        assert ended.value.code == 0
        assert 'named' in capsys.readouterr().out
    assert not (site / 'imported').exists()
    assert find_controller('named').summary == 'tanh speed'
    assert (site / 'imported').exists()


def test_built_in_controllers_are_used_without_a_search_and_cannot_be_replaced(install, monkeypatch):
    install('pose')
    assert control.controller_names() == tuple(BUILT_IN)
    monkeypatch.setattr('importlib.metadata.entry_points', None)
    for name in BUILT_IN:
        assert GoToGoalParameters(controller=name).chosen_controller() is BUILT_IN[name]


BROKEN = {
    'raises': ('raise RuntimeError("no\\nlicence")', 'cannot be loaded: RuntimeError: no licence'),
    'exits': ('raise SystemExit(0)', 'cannot be loaded: SystemExit: 0'),
    'empty': ('', "cannot be loaded: AttributeError: module 'provider_"),
    'law-only': ('def CONTROLLER(): pass', 'must be a Controller, got <function CONTROLLER at'),
    'misnamed': (SOURCE.replace('{name}', 'else'), "name of its entry point, 'misnamed', got 'else'"),
    'invalid': (SOURCE.replace('summary', 'gains'), 'ValueError: gains must be a tuple'),
}


def test_a_broken_controller_is_refused_with_package_and_reason(lockstep, install):
    controller = Controller(lockstep)
    controller.send(goal(1.0, 0.4))
    before = controller.at(0.0, 0.0)
    for name, (source, reason) in BROKEN.items():
        module = install(name, source, package=f'{name}-laws', version='0.3')
        words = f"controller '{name}' of {name}-laws 0.3 ({module}:CONTROLLER) "
        with pytest.raises(ParameterError) as caught:
            make(GoToGoal, controller=name)
        assert words in str(caught.value)
        assert reason in str(caught.value)
        assert '\n' not in str(caught.value)
        result = change(controller.node, controller=name)
        assert not result.successful
        assert words in result.reason
        assert controller.node.get_parameter('controller').value == 'go_to_goal'
        assert controller.at(0.0, 0.0) == before


def test_a_broken_controller_ends_the_program_with_one_line(install, capfd):
    install('broken', 'raise RuntimeError("no licence")', package='broken-laws')
    arguments = ['--ros-args', '-p', 'controller:=broken']
    assert run_node('go_to_goal', arguments, Signals()) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "controller 'broken' of broken-laws 1.2" in line
    assert 'cannot be loaded: RuntimeError: no licence' in line


def test_unknown_and_ambiguous_names_are_refused(install):
    for bad in ('', 'other', 'a\nb', 3, None, []):
        with pytest.raises(ControllerError) as caught:
            find_controller(bad)
        assert str(caught.value) == (
            f"controller must be one of 'go_to_goal', 'offset_point', 'pose', got {bad!r}"
        )
    install('twice', package='first-laws')
    install('twice', package='second-laws', version='4')
    several = r"'twice' is provided by several packages: first-laws 1\.2 and second-laws 4"
    with pytest.raises(ControllerError, match=several):
        find_controller('twice')


# --- A controller given in Python


def test_a_given_controller_is_the_default_and_drives_to_the_goal(lockstep):
    topics = Topics(lockstep)
    lockstep.add(make(VirtualRobot))
    node = lockstep.add(GoToGoal(controller=MINE))
    assert node.get_parameter('controller').value == 'mine'
    lockstep.publish('goal_pose', goal(0.4, 0.2))
    arrives(lockstep, topics)
    assert topics.statuses[-1] == SUCCEEDED
    expected = law(np.zeros(3), np.array([0.4, 0.2]), 3.0, 0.5)
    assert twists(topics.commands)[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.lockstep(args=['--ros-args', '-p', 'controller:=pose'])
def test_the_user_can_choose_another_than_the_given_controller(lockstep):
    node = lockstep.add(GoToGoal(controller=MINE))
    assert node.get_parameter('controller').value == 'pose'
    assert change(node, controller='mine').successful
    assert node.parameters.chosen_controller() is MINE
    assert change(node, controller='offset_point').successful
    result = change(node, controller='other')
    assert "one of 'go_to_goal', 'mine', 'offset_point', 'pose', got 'other'" in result.reason
    # Another node has another one of that name, or none.
    other = replace(MINE, law=control.go_to_goal)
    second = lockstep.add(GoToGoal(controller=other, namespace='second'))
    assert change(second, controller='mine').successful
    assert second.parameters.chosen_controller() is other
    assert not change(lockstep.add(make(GoToGoal, 'third')), controller='mine').successful


def test_only_controllers_with_a_name_of_their_own_can_be_given(lockstep):
    for bad in ('pose', law, None, 3):
        with pytest.raises(ValueError, match='controller must be of class Controller'):
            GoToGoalParameters.with_controller(bad)
    with pytest.raises(ValueError, match="name of its own, got 'pose', which is built in"):
        GoToGoal(controller=replace(MINE, name='pose'))
    assert GoToGoal(controller=BUILT_IN['pose']).get_parameter('controller').value == 'pose'


def test_heading_and_driven_point_of_a_given_controller_count(lockstep):
    controller = replace(BUILT_IN['offset_point'], name='point', takes_heading=True)
    controller = replace(controller, law=lambda pose, to, k, d: control.offset_point(pose, to[:2], k, d))
    node = lockstep.add(GoToGoal(controller=controller))
    assert (node.arrival.offset, node.arrival.use_heading) == (0.1, True)
    assert change(node, offset=-0.4).successful
    assert node.arrival.offset == -0.4


def test_advice_is_logged_and_its_failure_does_no_harm(lockstep, capfd):
    def advice(gains, limits):
        if gains.kp > 5.0:
            raise KeyError('kp')
        yield f'kp {gains.kp:g} with {limits.max_v:g} m/s'

    node = lockstep.add(GoToGoal(controller=replace(MINE, advice=advice)))
    assert 'kp 3 with 1000 m/s' in capfd.readouterr().err
    assert change(node, kp=6.0).successful
    assert "the advice of controller 'mine' failed: KeyError: 'kp' (test_own_" in capfd.readouterr().err
    parameters = GoToGoalParameters()
    assert MINE.warnings(parameters, parameters.limits) == []
    failing = replace(MINE, slope=lambda gains: 1.0 / 0.0)
    (warning,) = failing.rate_warnings(parameters, 50.0, turns=False)
    assert "the slope of controller 'mine' failed: ZeroDivisionError" in warning


NUMBERS = 'must return (v, omega), two numbers, got'
FAILURES = {
    'raises': (lambda *_: 1.0 / 0.0, "controller 'mine' failed: ZeroDivisionError: float division"),
    'nan': (lambda *_: (math.nan, 0.0), 'must return finite (v, omega), got (nan, 0)'),
    'one': (lambda *_: 0.5, f'{NUMBERS} 0.5'),
    'three': (lambda *_: (1.0, 2.0, 3.0), f'{NUMBERS} (1.0, 2.0, 3.0)'),
    'arrays': (lambda *_: ([1.0], [2.0]), NUMBERS),
    'text': (lambda *_: ('1', None), NUMBERS),
}


def test_a_law_that_fails_is_an_error_with_its_cause():
    for kind, (fails, words) in FAILURES.items():
        bound = replace(MINE, law=fails).bind(GoToGoalParameters())
        with pytest.raises(LawError, match=re.escape(words)) as caught:
            bound(np.zeros(3), np.ones(3))
        assert isinstance(caught.value.__cause__, ZeroDivisionError) == (kind == 'raises')


def test_a_law_that_fails_stops_the_robot_and_aborts_the_goal(lockstep, capfd):
    broken, topics = [], Topics(lockstep)
    lockstep.add(make(VirtualRobot))
    node = lockstep.add(
        GoToGoal(controller=replace(MINE, law=lambda *given: (broken or [law])[-1](*given)))
    )
    for fails, words in FAILURES.values():
        broken.clear()
        lockstep.publish('goal_pose', goal(20.0, 0.5))
        lockstep.run_for(0.1)
        assert twists(topics.commands)[-1] != (0.0, 0.0)
        broken.append(fails)
        lockstep.run_for(0.1)
        assert twists(topics.commands)[-1] == (0.0, 0.0)
        assert topics.statuses[-1] == ABORTED
        assert node.waypoint is None
        assert words in capfd.readouterr().err
    # The node goes on with a law that works.
    assert change(node, controller='go_to_goal', kp=24.0, kv=12.0).successful
    lockstep.publish('goal_pose', goal(0.5, 0.2))
    arrives(lockstep, topics)


def test_gains_are_passed_in_the_order_of_the_controller():
    parameters = GoToGoalParameters(kp=2.0, kv=3.0, offset=5.0)
    for gains in ((), (KV,), (OFFSET, KP), (OFFSET, KP, KV)):
        own = replace(MINE, gains=gains, law=lambda pose, goal, *values: (len(values), sum(values)))
        values = tuple(getattr(parameters, gain.name) for gain in gains)
        assert own.bind(parameters)(np.zeros(3), np.ones(3)) == (len(gains), sum(values))
        assert own.values(parameters) == values


# --- Sweeps

SMALL = SweepSetup(
    gains={'kp': (2.0, 4.0), 'kv': (0.5, 1.0)}, grid=2, starts=2, rate=20.0, controller=MINE
)


@pytest.mark.slow
def test_a_given_controller_is_swept_and_drawn():
    swept = sweep(SMALL)
    assert swept.complete.all()
    alone = closed_loops(law, SMALL.poses(), [0.0, 0.0], 4.0, 0.5, rate=20.0, turning_gain=4.0)
    np.testing.assert_array_equal(swept.outcomes.time[0, 1], alone.time)
    drawn = figure(swept)
    assert drawn.get_suptitle().startswith('mine: ')
    # It has no boundary, and the grid contains the defaults.
    defaults, entry = drawn.axes[3].get_legend().get_texts()
    assert defaults.get_text() == 'defaults: kp 3, kv 0.5'
    assert entry.get_text().startswith('fastest: ')


def test_an_installed_controller_is_swept_by_the_tool(install, tmp_path, monkeypatch, capsys):
    install('swept')
    monkeypatch.chdir(tmp_path)
    small = ['--grid', '2', '--starts', '2', '--kp', '2', '4', '--kv', '0.5', '1', '--csv', 'a.csv']
    assert sweep_gains.main(['--controller', 'swept', *small], Signals()) == 0
    assert len((tmp_path / 'a.csv').read_text().splitlines()) == 5
    install('unswept', 'raise RuntimeError("no licence")')
    assert sweep_gains.main(['--controller', 'unswept', '--csv', 'a.csv'], Signals()) == 2
    assert 'cannot be loaded: RuntimeError: no licence' in capsys.readouterr().err


def test_a_driven_point_is_swept_with_its_offset():
    controller = control.Controller(
        name='point',
        law=lambda poses, goals, kp, kv, d: control.offset_point(poses, goals, kv, d),
        gains=(KP, KV, OFFSET),
        offset='offset',
    )
    swept = sweep(replace(SMALL, controller=controller, gains={**SMALL.gains, 'offset': -0.3}))
    assert swept.complete.all()
    x, y = swept.outcomes.pose[..., 0], swept.outcomes.pose[..., 1]
    assert np.hypot(x, y) == pytest.approx(0.3, abs=0.021)


def test_what_cannot_be_swept_is_refused():
    with pytest.raises(ValueError, match="two gains to be swept, but 'mine' has kv"):
        replace(SMALL, controller=replace(MINE, gains=(KV,)))
    scalar = replace(MINE, law=lambda pose, to, kp, kv: (math.hypot(to[0] - pose[0], 0.0), 0.0))
    words = r"'mine' must accept poses of shape \(2, 3\) to be swept, but failed: "
    with pytest.raises(ValueError, match=words):
        sweep(replace(SMALL, controller=scalar))


# --- The page on controllers


def blocks(language):
    """Return the code blocks of a language in the page, by the name of their file, else by number."""
    found = re.findall(rf'```{language}\n(.*?)```', PAGE.read_text(), re.DOTALL)
    names = [re.match(r'# (\w+)\.py\n', block) for block in found]
    return {
        name[1] if name else f'block_{number}': block
        for number, (name, block) in enumerate(zip(names, found, strict=True))
    }


def test_the_example_of_a_test_passes(lockstep, robot_at, monkeypatch):
    """The other blocks are run with those of all pages."""
    modules = {name: ModuleType(name) for name in ('my_law', 'test_my_law')}
    monkeypatch.setitem(sys.modules, 'my_law', modules['my_law'])
    for name, module in modules.items():
        exec(blocks('python')[name], module.__dict__)
    modules['test_my_law'].test_my_law_reaches_the_goal(lockstep, robot_at)


@pytest.mark.pages
def test_the_example_is_installed(site):
    (declared,) = blocks('toml').values()
    group, entry = re.search(r'entry-points\."(.*?)"\]\n(.*)', declared).groups()
    assert f"{group}': ['{entry.replace(chr(34), '')}']" in PAGE.read_text()
    (site / 'my_law.py').write_text(blocks('python')['my_law'])
    register(site, 'my-laws', '1.0', f'[{group}]\n{entry.replace(chr(34), "")}\n')
    arguments = ['0.2', '0', '--controller', 'my_law', '--lockstep', '--no-record']
    assert drive_to.main(arguments, Signals()) == 0
    assert find_controller('my_law').summary == 'bounded speed'


def test_every_field_is_described():
    tables = PAGE.read_text().split('## Fields')[1].split('A `Gain` has')
    for table, described in zip(tables, (control.Controller, control.Gain), strict=True):
        assert re.findall(r'^\| `(\w+)`', table, re.MULTILINE) == [
            field.name for field in fields(described)
        ]


# --- The object

INVALID_CONTROLLERS = [
    ({'name': ''}, "letter, then letters, digits, '_', '.' or '-', at most 64, got ''"),
    ({'name': 'two words'}, "got 'two words'"),
    ({'name': 3}, 'got 3'),
    ({'law': 'law'}, 'law must be a function'),
    ({'gains': ('kp', 'ki')}, 'gains must be a tuple of Gain'),
    ({'gains': [KP, KV]}, 'gains must be a tuple of Gain'),
    ({'gains': (KP, KP)}, 'gains must have different names, got kp, kp'),
    ({'state': (math.nan,)}, 'state must be finite'),
    ({'state': 'x'}, 'state must be an array of real numbers'),
    ({'offset': 'd'}, "offset must be '' or one of kp, kv, got 'd'"),
    ({'takes_heading': 1}, 'takes_heading must be True or False'),
    ({'advice': ()}, 'advice must be a function'),
    ({'slope': 1.0}, 'slope must be a function'),
    ({'boundary': (1.0, '')}, 'boundary must be of class Boundary'),
    ({'summary': None}, 'summary must be a string'),
]
INVALID_GAINS = [
    ({'name': 'K'}, 'name of a gain must be a lower-case letter, then lower-case letters, digits or _'),
    ({'name': 'lambda'}, "got 'lambda'"),
    ({'default': math.nan}, 'default must be finite'),
    ({'default': 5.0}, 'ki must be in [-1, 2], got 5'),
    ({'above': 1.0}, 'ki must be in (1, 2], got 1'),
    ({'bounds': (1.0,)}, 'bounds must have shape (..., 2)'),
    ({'usual': (1.0, 1.0)}, 'usual must be (first, last) with first < last'),
    ({'usual': (0.0, 3.0)}, 'ki must be in [-1, 2], got 3'),
    ({'usual': (-2.0, 0.0)}, 'ki must be in [-1, 2], got -2'),
    ({'above': 'x'}, 'above must be a number'),
    ({'unit': None}, 'unit must be a string'),
]


def test_invalid_controllers_and_gains_are_refused():
    for changes, words in INVALID_CONTROLLERS:
        with pytest.raises(ValueError, match=re.escape(words)):
            replace(MINE, **changes)
    for changes, words in INVALID_GAINS:
        with pytest.raises(ValueError, match=re.escape(words)):
            control.Gain(**{'name': 'ki', 'default': 1.0, 'bounds': (-1.0, 2.0)} | changes)
