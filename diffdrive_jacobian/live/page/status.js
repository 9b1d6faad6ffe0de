// The state of the goal, in words.

import { byId, format, setText } from './dom.js';

const STATES = {
  unknown: ['no goal', ''],
  accepted: ['accepted', 'active'],
  executing: ['driving', 'active'],
  canceling: ['canceling', 'active'],
  succeeded: ['arrived', 'good'],
  canceled: ['canceled', ''],
  aborted: ['aborted', 'bad'],
};

/** Return badge, its class and one sentence for a robot. */
function described(robot, recorded) {
  const { goal, age } = robot;
  const [badge, kind] = robot.by_hand ? ['by hand', 'hand'] : STATES[goal.state] ?? STATES.unknown;
  if (age > 1) return ['silent', 'bad', `no odometry for ${format(age, 0)} s`];
  if (robot.by_hand) return [badge, kind, 'release to stop'];
  if (goal.active && !robot.controlled && !recorded) return ['lost', 'bad', 'nobody publishes goal_status any more: the controller has ended'];
  const { distance, across, late } = robot.now;
  const truly = robot.true_distance === null ? '' : `, truly ${format(robot.true_distance)} m`;
  if (goal.state === 'succeeded' && distance !== null) return [badge, kind, `now ${format(distance)} m from the goal${truly}`];
  if (!goal.active) return [badge, kind, goal.state === 'unknown' && !recorded ? 'click on the map to send one' : ''];
  if (!goal.goals) return [badge, kind, 'the goal was sent before this page listened'];
  if (goal.path) {
    const side = across < 0 ? 'right' : 'left', behind = late > 0.05 ? `, ${format(late, 1)} s late` : '';
    return [badge, kind, `${format(distance)} m to go, ${format(Math.abs(across) * 100, 1)} cm ${side} of the path${behind}`];
  }
  const many = goal.goals.length > 1 ? `waypoint ${goal.index + 1} of ${goal.goals.length}, ` : '';
  return [badge, kind, `${many}${format(distance)} m to go${truly}`];
}

export function showStatus(model, open) {
  const robot = model.selected, empty = byId('empty');
  empty.hidden = Boolean(robot);
  if (!robot) {
    setText(empty, open ? 'Waiting for a robot: no odometry has arrived. Start one, for example with virtual_robot and go_to_goal.'
      : 'No connection to the program that serves this page. Is it still running?');
    byId('status').hidden = true;
    return;
  }
  byId('status').hidden = false;
  const [badge, kind, sentence] = described(robot, model.looking);
  setText(byId('state'), badge);
  byId('state').className = `badge ${kind}`;
  setText(byId('summary'), sentence);
  byId('cancel').disabled = !robot.goal.active;
}
