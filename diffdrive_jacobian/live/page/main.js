// The page: puts its parts together and draws.

import { Capture } from './capture.js';
import { Chain } from './chain.js';
import { Connection } from './connection.js';
import { byId, element, parseHeading, parseNumber, setText } from './dom.js';
import { HandDriving } from './hand.js';
import { MapDrawing, themeColors } from './map.js';
import { Model } from './model.js';
import { Notices } from './notices.js';
import { MapPointer } from './pointer.js';
import { Presets, prepareShare } from './presets.js';
import { Settings } from './settings.js';
import { showStatus } from './status.js';
import { Strips } from './strips.js';
import { followTheme } from './theme.js';
import { Transport } from './transport.js';
import { View } from './view.js';

const HINTS = {
  goal: 'click: goal · drag: with heading · shift-click: waypoint · drag the robot: place it · WASD or arrow keys: drive',
  waypoint: 'click: a further place after the present goal · drag: with heading',
  move: 'drag: move the map · wheel or pinch: zoom',
  look: 'you may look: drag: move the map · wheel or pinch: zoom',
  bag: 'drag: move the map · wheel or pinch: zoom · click a curve: go to that time · space: pause',
};

/** Size of the letters on the map (px). */
const presetSize = () => (document.documentElement.dataset.projector === 'on' ? 17 : 11);

let changed = true;
const model = new Model(), view = new View(), notices = new Notices(byId('notices'));
const drawing = new MapDrawing(byId('map'), view, model);
const send = (command) => {
  const sent = connection.send(command);
  if (!sent && command.do !== 'release' && command.do !== 'drive') notices.show('error', 'there is no connection: nothing was sent');
  return sent;
};
const showFollow = () => byId('follow').setAttribute('aria-pressed', String(view.follow));
const pointer = new MapPointer(byId('map'), view, drawing, model, send, showFollow);
const hand = new HandDriving(model, send), chain = new Chain(byId('chain'));
const settings = new Settings(model, send, notices), transport = new Transport(model, send);
const strips = new Strips(byId('strips'), model, (time) => transport.seek(time));
const capture = new Capture(byId('map'), model, notices);
const presets = new Presets(model, send, () => { drawing.fontSize = presetSize(); changed = true; });
prepareShare(model);
followTheme(byId('theme'), () => { drawing.colors = themeColors(); changed = true; });

const connection = new Connection((frame) => {
  model.take(frame);
  for (const notice of frame.notices ?? []) {
    notices.show(notice.level, notice.text);
    if (notice.level === 'error') settings.refused();
  }
  changed = true;
}, (open) => {
  byId('connection').className = open ? 'open' : 'lost';
  setText(byId('connection'), open ? 'connected' : 'connection lost');
  if (open) model.reconnected(); else hand.stop();
});

/** Show the tabs of the robots, if there are several. */
function showRobots() {
  const names = [...model.robots.keys()], bar = byId('robots');
  bar.hidden = names.length < 2;
  if (bar.dataset.names !== names.join(' ')) {
    bar.dataset.names = names.join(' ');
    bar.replaceChildren(...names.map((name) => {
      const tab = element('button', { type: 'button' }, name);
      tab.addEventListener('click', () => { hand.stop(); model.selectedName = name; changed = true; });
      return tab;
    }));
  }
  for (const tab of bar.children) tab.setAttribute('aria-pressed', String(tab.textContent === model.selected?.name));
}

function showPanels() {
  const robot = model.selected, { recorded, looking } = model;
  showRobots();
  showStatus(model, connection.open);
  transport.show();
  settings.show();
  presets.show();
  byId('hand').hidden = looking || !robot;
  byId('tools').hidden = byId('actions').hidden = byId('goto').hidden = looking;
  byId('share').hidden = !model.may.shared;
  byId('chain').hidden = byId('legend').hidden = !robot;
  byId('truth').hidden = !robot?.truth;
  byId('planned').hidden = !robot?.goal.path;
  byId('timed').hidden = !robot?.goal.reference;
  setText(byId('title'), model.bag || 'diffdrive_jacobian');
  setText(byId('notes'), model.notes.join('; '));
  byId('notes').title = model.notes.join('\n');
  setText(byId('hint'), HINTS[recorded ? 'bag' : looking ? 'look' : pointer.tool]);
  byId('map').classList.toggle('grab', looking || pointer.tool === 'move');
  if (robot) chain.show(robot, looking);
}

for (const button of byId('tools').children) {
  button.addEventListener('click', () => {
    pointer.tool = button.dataset.tool;
    for (const other of byId('tools').children) other.setAttribute('aria-pressed', String(other === button));
    button.blur();
    changed = true;
  });
}
const onSelected = (id, command) => byId(id).addEventListener('click', () => {
  if (model.selected) send({ do: command, robot: model.selected.name });
  byId(id).blur();
});
onSelected('cancel', 'cancel');
onSelected('reset', 'reset');
onSelected('clear', 'clear_path');
byId('follow').addEventListener('click', () => { view.follow = !view.follow; changed = true; showFollow(); byId('follow').blur(); });
byId('fit').addEventListener('click', () => {
  const points = [...model.paths.values(), ...model.truePaths.values()].flat().filter((point) => point !== null);
  for (const robot of model.robots.values()) points.push(robot.pose, ...(robot.goal.goals ?? []), ...(robot.goal.path ?? []));
  view.fit(points.map(([x, y]) => [x, y]));
  showFollow();
  changed = true;
});
byId('in').addEventListener('click', () => { view.zoom(1.3); changed = true; });
byId('out').addEventListener('click', () => { view.zoom(1 / 1.3); changed = true; });
byId('map').addEventListener('wheel', () => { changed = true; }, { passive: true });
byId('map').addEventListener('pointerup', () => { changed = true; });
byId('goto').addEventListener('submit', (event) => {
  event.preventDefault();
  const [x, y] = ['x', 'y'].map((name) => parseNumber(byId(`goto-${name}`).value)), heading = byId('goto-theta').value;
  const theta = parseHeading(heading);
  if (!Number.isFinite(x) || !Number.isFinite(y)) notices.show('error', 'x and y of the goal must be numbers, in metres');
  else if (Number.isNaN(theta)) notices.show('error', `the heading must be in radians, from −2π to 2π, or in degrees as 90°, got ${heading}`);
  else if (model.selected) send({ do: 'goal', robot: model.selected.name, x, y, theta, append: false });
});
addEventListener('keydown', (event) => {
  if (event.code === 'Escape' && model.selected && !model.looking) send({ do: 'cancel', robot: model.selected.name });
});

const STRIP_PERIOD = 80;
let before = performance.now(), stripped = 0, stale = false, moving = false, fitted = false;
function draw(now) {
  requestAnimationFrame(draw);
  const fresh = changed, [x, y, scale] = [view.x, view.y, view.scale];
  if (fresh) {
    changed = false;
    showPanels();
  }
  stale ||= fresh;
  if (stale && now - stripped > STRIP_PERIOD) {
    stripped = now;
    stale = false;
    strips.draw(drawing.colors);
  }
  if (model.recorded && !fitted && model.paths.size) { fitted = true; drawing.draw(0); byId('fit').click(); }
  // Without news there is nothing to draw.
  if (fresh || pointer.action || moving) {
    drawing.draw((now - before) / 1000);
    capture.drawn();
  }
  before = now;
  moving = Math.hypot(view.x - x, view.y - y) * view.scale > 0.2 || view.scale !== scale;
}
addEventListener('resize', () => { changed = true; });
requestAnimationFrame(draw);
