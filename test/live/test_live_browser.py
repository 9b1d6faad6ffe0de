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

"""The live page in a real browser: chromium, headless. Skipped loudly where there is none."""

from __future__ import annotations

import io
import json
import math
import os
import re
import signal
import threading
import time

import numpy as np
import pytest
from chromium import Browser, find_chromium, until
from PIL import Image
from support import processes
from support.processes import open_world

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.live.page_drive import PageDrive
from diffdrive_jacobian.live.session import Share
from diffdrive_jacobian.live.value_page import drive_live
from diffdrive_jacobian.signals import Signals

pytestmark = [pytest.mark.browser, pytest.mark.process]

QUICK = ('--ros-args', '-p', 'go_to_goal:kp:=8.0', '-p', 'go_to_goal:kv:=4.0')

if find_chromium() is None and not os.environ.get('CHROMIUM_REQUIRED'):
    pytest.skip('chromium is not installed: the live page was not tested', allow_module_level=True)


@pytest.fixture(scope='module')
def live(tmp_path_factory):
    """A browser with the page of `drive_to --live --lockstep`."""
    with open_world(tmp_path_factory.mktemp('browser')) as world, pytest.MonkeyPatch.context() as patch:
        # All tests use it.
        patch.setattr(processes, 'LIMIT', 400.0)
        child = world.start('drive_to', '--live', '--lockstep', '--no-record', '--no-browser', *QUICK)
        browser = Browser()
        try:
            browser.size(1280, 800)
            yield Live(browser, child)
        finally:
            browser.close()


class Live:
    """The page as its user sees it."""

    def __init__(self, browser, child):
        self.browser, self.child = browser, child
        self.open(child)
        self.state('no goal')

    def open(self, child):
        """Open the page of a program."""
        child.until_says(r'page: http://\S+\n')
        self.browser.open(re.search(r'page: (\S+)', child.stdout)[1])
        self.browser.until('document.querySelector("#sliders input") !== null')

    def state(self, name):
        self.browser.until(f'document.getElementById("state").innerText === {json.dumps(name)}')

    def drive(self, code):
        """Hold a key until the robot is driven: again if the page was frozen, as on a busy machine."""

        def driven():
            self.browser.key('Up', code)
            self.browser.key('Down', code)
            end = time.monotonic() + 3.0
            while not (found := self.browser.text('#state') == 'by hand') and time.monotonic() < end:
                time.sleep(0.02)
            return found

        until(driven, f'{code} drives')

    def place(self, dx, dy):
        """Return a place on the screen, so far from the middle of the map (px)."""
        x, y = self.browser.center('#map')
        return [x + dx, y + dy]

    def pose(self):
        """Return x, y and theta as the page shows them."""
        text = self.browser.text('#chain > .small').replace('\u2212', '-')
        return [float(number) for number in re.findall(r'-?\d+\.\d{3}', text)[:3]]

    def settled(self):
        """Wait until the map follows a robot that stands."""
        until(lambda: self.pose() == self.pose(), 'the robot stands')


def test_a_click_sends_a_goal_and_the_robot_arrives(live):
    # 280 px are a metre, and the robot is in the middle.
    live.browser.click(live.place(140, -70))
    live.state('driving')
    live.state('arrived')
    x, y, _ = live.pose()
    assert math.dist((x, y), (0.5, 0.25)) < 0.03
    assert live.browser.errors == []


def test_a_heading_is_taken_as_typed_or_refused(live):
    """Nothing that is typed is taken for no heading."""
    taken = {' ': None, '1,5': 1.5, '-90°': -math.pi / 2, '180 deg': math.pi, '1 rad': 1.0}
    sent = """((typed) => {
        const before = WebSocket.prototype.send, sent = [];
        WebSocket.prototype.send = (text) => sent.push(JSON.parse(text).theta);
        document.getElementById('notices').replaceChildren();
        document.getElementById('goto-theta').value = typed;
        document.getElementById('goto').requestSubmit();
        document.getElementById('goto-theta').value = '';
        WebSocket.prototype.send = before;
        return sent; })"""
    for typed in (*taken, '90', 'pi/2', '400°', 'north'):
        found = live.browser.evaluate(f'{sent}({json.dumps(typed)})')
        notice = live.browser.text('#notices')
        if typed in taken:
            assert (found, notice) == ([pytest.approx(taken[typed])], ''), typed
        else:
            assert found == []
            words = f'in radians, from \u22122\u03c0 to 2\u03c0, or in degrees as 90°, got {typed}'
            assert words in notice
    live.browser.evaluate('document.getElementById("notices").replaceChildren()')


def test_a_slider_changes_the_gain_and_a_refused_value_goes_back(live):
    browser, kp = live.browser, '[data-key="controller/kp"] input'
    slider = browser.center(f'{kp}[type=range]')
    browser.click([slider[0] + 10, slider[1]])
    browser.until(f'document.querySelector({json.dumps(kp)}).value !== "8"')
    value = browser.evaluate(f'document.querySelector({json.dumps(kp + "[type=text]")}).value')
    field = f'document.querySelector({json.dumps(kp + "[type=text]")})'
    for typed, said in (('-3', 'kp refused'), ('2,5 m', 'must be a number, got "2,5 m"')):
        change = f'{field}.dispatchEvent(new Event("change"))'
        browser.evaluate(f'({field}.value = {json.dumps(typed)}, {change})')
        browser.until(f'document.getElementById("notices").innerText.includes({json.dumps(said)})')
        browser.until(f'{field}.value === {json.dumps(value)}')


def test_a_key_drives_and_letting_go_stops(live):
    browser = live.browser
    live.settled()
    x, y, theta = live.pose()
    live.drive('ArrowUp')

    def moved():
        if browser.text('#state') != 'by hand':
            live.drive('ArrowUp')
        return math.dist(live.pose()[:2], (x, y)) > 0.05

    until(moved, 'the robot moves')
    browser.key('Up', 'ArrowUp')
    browser.until('document.getElementById("state").innerText !== "by hand"')
    live.settled()
    moved = live.pose()
    assert moved[2] == pytest.approx(theta, abs=0.01)
    along = (moved[0] - x) * math.cos(theta) + (moved[1] - y) * math.sin(theta)
    assert along == pytest.approx(math.dist(moved[:2], (x, y)), abs=2e-3)


def test_a_frozen_page_drives_again_only_after_the_key_was_released(live):
    browser = live.browser

    def still():
        place = live.pose()
        time.sleep(0.5)
        return live.pose() == place

    live.drive('KeyW')
    try:
        browser.freeze(1.0)
        # It is back, the key is still held, and the page goes on asking.
        browser.until('document.getElementById("notices").innerText.includes("release the keys")')
        # The page first shows what it has missed. A robot that is driven stands never.
        until(still, 'the robot stands')
        assert still()
        browser.until('document.getElementById("state").innerText !== "by hand"')
    finally:
        browser.key('Up', 'KeyW')
    live.drive('KeyW')
    browser.key('Up', 'KeyW')
    live.settled()


@pytest.mark.parametrize('event', ['blur', 'hidden'])
def test_a_page_without_attention_stops_the_robot(live, event):
    browser = live.browser
    live.drive('KeyW')
    if event == 'blur':
        browser.evaluate('window.dispatchEvent(new Event("blur"))')
    else:
        browser.evaluate(
            'Object.defineProperty(document, "hidden", {value: true, configurable: true});'
            'document.dispatchEvent(new Event("visibilitychange")); delete document.hidden'
        )
    # The key is still held.
    browser.until('document.getElementById("state").innerText !== "by hand"')
    browser.key('Up', 'KeyW')


def test_the_robot_is_placed_by_dragging_it(live):
    live.browser.click('#reset')
    until(lambda: live.pose() == [0.0, 0.0, 0.0], 'the robot is at the origin')
    live.browser.until('document.getElementById("follow").getAttribute("aria-pressed") === "true"')
    browser = live.browser
    # The map follows gently.
    box = browser.evaluate('[map.clientWidth, map.clientHeight]')
    middle = ' '.join(str(math.floor(side / 2 + 0.5)) for side in box)
    browser.until(f'map.dataset.robot === {json.dumps(middle)}')
    browser.drag(live.place(0, 0), live.place(-140, 0))
    until(lambda: live.pose()[0] == pytest.approx(-0.5, abs=0.05), 'it is placed')


def test_pause_step_and_waypoints(live):
    browser = live.browser
    browser.click('#play')
    browser.until('document.getElementById("play").getAttribute("aria-label") === "Continue"')
    before = browser.text('#clock')
    browser.click('#step')
    browser.until(f'document.getElementById("clock").innerText !== {json.dumps(before)}')
    # Goals are taken while time stands.
    browser.click(live.place(200, 40))
    browser.click(live.place(200, 140), shift=True)
    live.state('accepted')
    browser.until('document.getElementById("summary").innerText.startsWith("waypoint 1 of 2")')
    # Time that does not pass makes no robot silent, which the page would say after a second.
    time.sleep(1.5)
    live.state('accepted')
    browser.key('Down', 'Escape')
    browser.key('Up', 'Escape')
    live.state('canceled')
    browser.click('#play')
    browser.until('document.getElementById("play").getAttribute("aria-label") === "Pause"')


def test_on_a_path_its_law_drives_and_is_chosen_and_tuned(live, tmp_path):
    """Each of the four laws by its choice, its formula and a slider that is dragged."""
    laws = {
        'kanayama': ('k_y', 'Kanayama 1990'),
        'offset_point': ('k_point', 'B'),
        'dynamic_feedback': ('k_position', 'Oriolo 2002'),
        'pure_pursuit': ('lookahead_distance', 'Coulter 1992'),
    }
    arguments = ('--live', '--lockstep', '--no-browser', '--path', 'circle:2.0')
    trajectory = ('--trajectory', '0.3', '--path-controller', 'kanayama', '-o', f'{tmp_path}/bag')
    browser = live.browser
    with open_world(tmp_path) as world:
        child = world.start('drive_to', *arguments, *trajectory)
        live.open(child)
        live.state('driving')
        choice = 'document.querySelector(\'[data-key="controller/path_controller"] select\')'
        browser.evaluate(
            f'globalThis.choose = (name) => {{ const one = {choice}; one.value = name;'
            'one.dispatchEvent(new Event("change")); }'
        )
        for law, (gain, source) in laws.items():
            browser.evaluate(f'choose({json.dumps(law)})')
            sources = '[...document.querySelectorAll("#chain .source")].map((node) => node.innerText)'
            browser.until(f'{sources}[1] === {json.dumps(source)}')
            row = f'[data-key="controller/{gain}"]'
            browser.until(f'document.querySelector({json.dumps(row)}).closest("details") === null')
            # A second, so that no later state of the node is shown in between.
            x, y = browser.center(f'{row} input[type=range]')
            value = f'document.querySelector({json.dumps(row + " input[type=text]")}).value'
            before = browser.evaluate(value)
            browser.drag([x, y], [x + 12, y])
            after = browser.evaluate(value)
            assert after != before
            # The chain shows what the node has.
            browser.until(f'document.getElementById("chain").innerText.includes("= {after}")')
        curves = '[...document.querySelectorAll(".strip:not([hidden]) .name")]'
        names = browser.evaluate(f'{curves}.map((node) => node.innerText)')
        assert names[-2:] == ['off the path m', 'heading to path rad']
        assert browser.evaluate('document.getElementById("timed").hidden') is False
        assert browser.errors == []
        # A list that was reached by keys keeps them: the robot goes on.
        browser.evaluate(f'{choice}.focus()')
        for _ in range(3):
            for kind in ('Down', 'Up'):
                browser.key(kind, 'ArrowUp')
        assert browser.evaluate(f'document.activeElement === {choice}')
        assert browser.text('#state') == 'driving'
        child.signal(signal.SIGINT)
        assert child.exit() == 0
    # Although the page was opened at once.
    assert len(read_run(tmp_path / 'bag').planned_path) > 10
    live.open(live.child)
    # The page of the program that has ended may have tried to connect again.
    browser.errors.clear()


def test_nothing_is_clipped_or_covered_on_usual_screens(live):
    browser = live.browser
    # A notice covers no legend.
    browser.evaluate('document.getElementById("goto-x").value = "x"')
    browser.evaluate('document.getElementById("goto").requestSubmit()')
    wrong = """[
        [...document.querySelectorAll('.strip p, #goto, #actions, #hint')].filter(
            (node) => node.scrollWidth > node.clientWidth).length,
        document.getElementById('goto').offsetHeight >= 40,
        (([a, b]) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom)(
            ['.notice', '#legend'].map((one) => document.querySelector(one).getBoundingClientRect())),
        innerWidth >= 1280 && ['controls', 'mathematics'].some((id) => {
            const node = document.getElementById(id);
            return node.scrollHeight > node.clientHeight; }),
    ]"""
    for width, height in ((1600, 900), (1400, 900), (1366, 768), (1000, 700), (420, 800)):
        browser.size(width, height)
        assert browser.evaluate(wrong) == [0, False, False, False], width
    browser.size(390, 844, mobile=True)
    browser.until('document.documentElement.scrollWidth <= 390')
    assert browser.evaluate('document.getElementById("map").clientWidth') > 300
    browser.evaluate('document.getElementById("goto-x").value = "1"')
    browser.size(1280, 800)


def test_a_still_and_a_film_of_the_map_are_saved(live, tmp_path):
    browser = live.browser
    browser.call('Browser.setDownloadBehavior', behavior='allow', downloadPath=str(tmp_path))

    def saved(*endings):
        """Return the content of a file. The browser first reserves its name with an empty one."""
        names = [one.suffix for one in tmp_path.iterdir()]
        found = [one for one in tmp_path.iterdir() if one.suffix in endings]
        return found[0].read_bytes() if found and '.crdownload' not in names else None

    browser.evaluate('document.getElementById("film").click()')
    live.drive('KeyW')
    # The map may become narrower at any time, as its film may not.
    size = browser.evaluate('document.getElementById("picture").click(), [map.width, map.height]')
    picture = Image.open(io.BytesIO(until(lambda: saved('.png'), 'the still is saved')))
    assert list(picture.size) == size
    # On the ground of the map, with something on it.
    assert picture.convert('RGBA').getextrema()[3] == (255, 255)
    assert len(picture.convert('RGB').getcolors(100_000)) > 10
    browser.key('Up', 'KeyW')
    live.settled()
    browser.evaluate('document.getElementById("film").click()')
    until(lambda: len(saved('.mp4', '.webm') or b'') > 2_000, 'the film is saved')
    assert browser.errors == []


@pytest.fixture
def shared():
    """A page of two robots without nodes, which guests may look at; and a browser of theirs."""
    signals, servers, browser = Signals(), [], Browser()
    how = {'lockstep': True, 'isolated': True, 'recording': None, 'ros_arguments': (), 'port': 0}
    how |= {'parameters': {'kp': 2.0}, 'robot_parameters': {}, 'nodes_created': lambda names: None}
    arguments = {**how, 'signals': signals, 'ready': servers.append, 'robots': 2}
    arguments |= {'goals': np.array([[50.0, 0.0, 0.0]]), 'share': Share('127.0.0.2')}
    driving = threading.Thread(target=drive_live, args=[PageDrive(**arguments)])
    driving.start()
    try:
        until(lambda: servers, 'the server runs')
        yield servers[0], browser
    finally:
        browser.close()
        signals.count = 1
        driving.join(20.0)


def test_guests_look_and_a_projector_shows_less_in_larger_type(shared):
    server, browser = shared

    def hidden(*names):
        chosen = ', '.join(f'#{name}' for name in names)
        return browser.evaluate(
            f'[...document.querySelectorAll("{chosen}")].every((one) => one.offsetHeight === 0)'
        )

    browser.size(1280, 800)
    browser.open(server.shared_url)
    browser.until('document.querySelector("#robots button") !== null')
    browser.until('document.querySelector("#sliders input") !== null')
    assert hidden('tools', 'actions', 'goto', 'hand', 'share', 'presets')
    assert browser.evaluate('document.querySelector("#sliders input").disabled')
    assert browser.evaluate('document.getElementById("play").disabled')
    assert browser.text('#hint').startswith('you may look')
    x, y = browser.center('#map')
    # Whoever sends a command is disconnected.
    browser.click([x + 40, y])
    browser.key('Down', 'KeyW')
    browser.key('Up', 'KeyW')
    browser.key('Down', 'Escape')
    browser.drag([x, y], [x + 60, y + 60])
    time.sleep(0.5)
    assert browser.text('#connection') == 'connected'
    assert browser.text('#state') == 'driving'

    # The page of this machine, for a projector, with the address of the guests.
    browser.open(server.url)
    browser.until('document.querySelector("#sliders input") !== null')
    size = 'parseFloat(getComputedStyle(document.querySelector(".numbers")).fontSize)'
    before = browser.evaluate(size)
    browser.evaluate('document.getElementById("projector").click()')
    browser.until('document.querySelector("#choices button") !== null')
    assert browser.evaluate(size) > 1.3 * before
    assert hidden('settings', 'hand', 'goto')
    browser.until(
        '[...document.querySelectorAll(".preset")].some((one) => one.innerText.startsWith("K"))'
    )
    browser.evaluate(
        '[...document.querySelectorAll(".preset")].find((one) => one.innerText.startsWith("K"))'
        '.querySelector("button:last-child").click()'
    )
    browser.until('document.querySelector("#chain").innerText.includes("= 6")')
    browser.evaluate('document.getElementById("share").click()')
    browser.until('document.getElementById("code").naturalWidth > 0')
    assert browser.text('#link') == server.shared_url
    assert browser.text('#rights') == 'Whoever opens it can look, not steer.'
    assert browser.errors == []


def test_the_page_says_when_the_connection_is_lost(live):
    """Last: the program ends. What was driven by hand has stopped before."""
    browser = live.browser
    live.drive('KeyW')
    live.child.signal(signal.SIGINT)
    assert live.child.exit() == 0
    browser.until('document.getElementById("connection").innerText.includes("lost")')
    assert browser.evaluate('document.querySelectorAll("#pad .held").length') == 0
    browser.key('Up', 'KeyW')
    # Also through a notice, which lies on the map.
    browser.evaluate('document.getElementById("goto-x").value = "?"')
    browser.evaluate('document.getElementById("goto").requestSubmit()')
    browser.click('.notice span')
    browser.until('document.getElementById("notices").innerText.includes("there is no connection")')
