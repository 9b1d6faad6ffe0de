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

"""A headless chromium, driven by its DevTools protocol. It needs no library beside websockets."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from websockets.sync.client import connect

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
PATIENCE = 30.0
"""How long anything may take (s)."""
KEYS = {'ArrowUp': 38, 'ArrowDown': 40, 'ArrowLeft': 37, 'ArrowRight': 39, 'KeyW': 87, 'Escape': 27}


def find_chromium():
    """Return the path of a chromium; None: there is none."""
    return next((found for found in map(shutil.which, NAMES) if found), None)


class Browser:
    """A browser with one tab."""

    def __init__(self, width=1280, height=800):
        self._profile = tempfile.mkdtemp(prefix='chromium')
        self._process = subprocess.Popen(
            [
                *(find_chromium(), '--headless=new', '--remote-debugging-port=0', '--no-first-run'),
                *('--disable-gpu', '--hide-scrollbars', '--mute-audio', '--disable-extensions'),
                *('--disable-background-networking', '--disable-component-update', '--no-proxy-server'),
                *('--no-sandbox',) * (os.geteuid() == 0),
                *(f'--user-data-dir={self._profile}', f'--window-size={width},{height}', 'about:blank'),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # As the parent of its own processes it ends them.
            start_new_session=True,
        )
        self._ids = itertools.count(1)
        self.errors = []
        """What the page reported on its console as errors, and refused requests."""
        port_file = Path(self._profile, 'DevToolsActivePort')
        until(lambda: port_file.exists() and len(port_file.read_text().split()) == 2, 'chromium starts')
        port, path = port_file.read_text().split()
        # Without compression, and for as long as the browser lives.
        self._closing = ExitStack()
        self._socket = self._closing.enter_context(
            connect(f'ws://127.0.0.1:{port}{path}', max_size=1 << 26, compression=None, proxy=None)
        )
        self._session = None
        target = self.call('Target.createTarget', url='about:blank')['targetId']
        attached = self.call('Target.attachToTarget', targetId=target, flatten=True)
        self._session = attached['sessionId']
        for domain in ('Page', 'Runtime', 'Log'):
            self.call(f'{domain}.enable')

    def freeze(self, seconds):
        """Stop all its processes for a time (s)."""
        os.killpg(self._process.pid, signal.SIGSTOP)
        try:
            time.sleep(seconds)
        finally:
            os.killpg(self._process.pid, signal.SIGCONT)

    def call(self, method, **parameters):
        """Call a method of the protocol; return its result."""
        number = next(self._ids)
        message = {'id': number, 'method': method, 'params': parameters}
        if self._session:
            message['sessionId'] = self._session
        self._socket.send(json.dumps(message))
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            self._note(answer)
            if answer.get('id') == number:
                assert 'error' not in answer, (method, answer['error'])
                return answer['result']
        raise AssertionError(f'not within {PATIENCE} s: {method}')

    def _note(self, event):
        method, values = event.get('method'), event.get('params', {})
        if method == 'Runtime.exceptionThrown':
            details = values['exceptionDetails']
            self.errors.append(details.get('exception', {}).get('description', details['text']))
        elif method == 'Log.entryAdded' and values['entry']['level'] == 'error':
            self.errors.append(f'{values["entry"]["text"]} {values["entry"].get("url", "")}')

    def open(self, url):
        """Go to an address, and wait for the page."""
        self.call('Page.navigate', url=url)
        self.until('document.readyState === "complete" && location.href !== "about:blank"')

    def evaluate(self, expression):
        """Return the value of an expression in the page."""
        result = self.call(
            'Runtime.evaluate', expression=expression, returnByValue=True, awaitPromise=True
        )
        assert 'exceptionDetails' not in result, result['exceptionDetails']
        return result['result'].get('value')

    def text(self, selector):
        """Return the text of an element."""
        return self.evaluate(f'document.querySelector({json.dumps(selector)}).innerText')

    def until(self, expression, patience=PATIENCE):
        """Wait until an expression in the page is true; return its value."""
        return until(lambda: self.evaluate(expression), expression, patience)

    def size(self, width, height, *, mobile=False):
        """Give the page a size, as of a window or of a phone."""
        self.call(
            'Emulation.setDeviceMetricsOverride',
            width=width,
            height=height,
            deviceScaleFactor=2 if mobile else 1,
            mobile=mobile,
        )
        self.call('Emulation.setTouchEmulationEnabled', enabled=mobile)

    def center(self, selector):
        """Return the middle of an element on the screen (px)."""
        return self.evaluate(
            f'(() => {{ const node = document.querySelector({json.dumps(selector)});'
            'node.scrollIntoView({block: "nearest"}); const box = node.getBoundingClientRect();'
            'return [box.x + box.width / 2, box.y + box.height / 2]; })()'
        )

    def mouse(self, kind, x, y, *, buttons=1, modifiers=0):
        """Send one event of the mouse: Pressed, Moved or Released."""
        self.call(
            'Input.dispatchMouseEvent',
            type=f'mouse{kind}',
            x=x,
            y=y,
            button='left' if buttons else 'none',
            buttons=buttons,
            clickCount=1,
            modifiers=modifiers,
        )

    def drag(self, start, end, *, modifiers=0):
        """Press the mouse at one place and release it at another (px)."""
        self.mouse('Moved', *start, buttons=0)
        self.mouse('Pressed', *start, modifiers=modifiers)
        if end != start:
            for share in (0.5, 1.0):
                self.mouse(
                    'Moved',
                    *(a + share * (b - a) for a, b in zip(start, end, strict=True)),
                    modifiers=modifiers,
                )
        self.mouse('Released', *end, modifiers=modifiers)

    def click(self, place, *, shift=False):
        """Click an element, or a place on the screen (px)."""
        place = self.center(place) if isinstance(place, str) else place
        self.drag(place, place, modifiers=8 * shift)

    def key(self, kind, code):
        """Send one event of a key: Down or Up."""
        self.call('Input.dispatchKeyEvent', type=f'key{kind}', code=code, key=code.removeprefix('Key'),
                  windowsVirtualKeyCode=KEYS[code])  # fmt: skip

    def close(self):
        """End the browser."""
        self._session = None
        try:
            self.call('Browser.close')
        except Exception:
            self._process.kill()
        self._closing.close()
        self._process.wait(PATIENCE)
        shutil.rmtree(self._profile, ignore_errors=True)


def until(condition, what, patience=PATIENCE):
    """Wait until a condition holds; return its value."""
    deadline = time.monotonic() + patience
    while not (value := condition()):
        assert time.monotonic() < deadline, f'not within {patience} s: {what}'
        time.sleep(0.02)
    return value
