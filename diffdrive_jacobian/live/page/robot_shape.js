// A robot to scale: body, wheels that turn, heading, uncertainty.

const TAU = 2 * Math.PI;

/** Return the radius of the body (m). */
export function bodyRadius(robot) {
  return 0.5 * robot.geometry[1];
}

/** Return where the handle that turns the robot is (m). */
export function handle(robot) {
  const [x, y, theta] = robot.pose, reach = 1.9 * bodyRadius(robot);
  return [x + reach * Math.cos(theta), y + reach * Math.sin(theta)];
}

/** Draw the region that contains the robot with 95 %. */
export function drawRegion(context, view, robot, colors) {
  if (!robot.region) return;
  const [px, py] = view.toScreen(robot.pose[0], robot.pose[1]);
  const { a, b, angle, heading } = robot.region;
  context.save();
  context.translate(px, py);
  context.fillStyle = context.strokeStyle = colors.region;
  context.beginPath();
  context.ellipse(0, 0, a * view.scale, b * view.scale, -angle, 0, TAU);
  context.globalAlpha = 0.16;
  context.fill();
  context.globalAlpha = 0.8;
  context.lineWidth = 1.5;
  context.stroke();
  const half = Math.min(heading, Math.PI), reach = 2.6 * bodyRadius(robot) * view.scale, theta = robot.pose[2];
  context.globalAlpha = 0.12;
  context.beginPath();
  context.moveTo(0, 0);
  context.arc(0, 0, reach, -theta - half, -theta + half);
  context.closePath();
  context.fill();
  context.restore();
}

/** Draw where the robot truly is: its outline and heading. */
export function drawTruth(context, view, robot, colors) {
  if (!robot.truth) return;
  const [x, y, theta] = robot.truth, [px, py] = view.toScreen(x, y), radius = Math.max(bodyRadius(robot) * view.scale, 5);
  context.save();
  context.translate(px, py);
  context.rotate(-theta);
  context.strokeStyle = colors.truth;
  context.lineWidth = 1.8;
  context.setLineDash([3, 3]);
  context.beginPath();
  context.arc(0, 0, radius, 0, TAU);
  context.moveTo(0, 0);
  context.lineTo(1.3 * radius, 0);
  context.stroke();
  context.restore();
}

/** Draw a robot at a pose; `angles` are those of the right and the left wheel (rad). */
export function drawRobot(context, view, robot, pose, angles, colors, { selected, ghost }) {
  const [r, L] = robot.geometry;
  const s = view.scale, [px, py] = view.toScreen(pose[0], pose[1]);
  const radius = bodyRadius(robot) * s;
  context.save();
  context.translate(px, py);
  if (radius < 7) {
    // Far away a marker shows where it is.
    context.strokeStyle = colors.path;
    context.lineWidth = 2;
    context.beginPath();
    context.arc(0, 0, 11, 0, TAU);
    context.stroke();
  }
  context.rotate(-pose[2]);
  context.globalAlpha = ghost ? 0.45 : robot.age > 1 ? 0.5 : 1;
  const width = Math.max(0.022, 0.55 * r) * s, length = 2 * r * s;
  for (const [side, angle, color] of [[1, angles[1], colors.left], [-1, angles[0], colors.right]]) {
    const y = -side * (L / 2) * s;
    context.fillStyle = colors.wheel;
    context.beginPath();
    context.roundRect(-length / 2, y - width / 2, length, width, width * 0.3);
    context.fill();
    // Treads move with the wheel.
    context.strokeStyle = color;
    context.lineWidth = Math.max(1, width * 0.16);
    for (let k = 0; k < 6; k += 1) {
      const phase = (angle + (k * TAU) / 6) % TAU;
      if (Math.cos(phase) < 0) continue;
      const x = Math.sin(phase) * r * s;
      context.beginPath();
      context.moveTo(x, y - width * 0.42);
      context.lineTo(x, y + width * 0.42);
      context.stroke();
    }
  }
  const body = radius - width * 0.75;
  context.fillStyle = colors.body;
  context.strokeStyle = selected ? colors['body-edge'] : colors.muted;
  context.lineWidth = Math.max(1.2, radius * 0.05);
  context.beginPath();
  context.arc(0, 0, Math.max(body, 2), 0, TAU);
  context.fill();
  context.stroke();
  context.fillStyle = selected ? colors.path : colors.muted;
  context.beginPath();
  context.moveTo(body * 0.78, 0);
  context.lineTo(-body * 0.3, body * 0.48);
  context.lineTo(-body * 0.08, 0);
  context.lineTo(-body * 0.3, -body * 0.48);
  context.closePath();
  context.fill();
  context.restore();
}

/** Draw the handle that turns the robot. */
export function drawHandle(context, view, robot, colors) {
  const [hx, hy] = view.toScreen(...handle(robot)), [px, py] = view.toScreen(robot.pose[0], robot.pose[1]);
  context.save();
  context.strokeStyle = context.fillStyle = colors.muted;
  context.globalAlpha = 0.8;
  context.setLineDash([3, 3]);
  context.beginPath();
  context.moveTo(px, py);
  context.lineTo(hx, hy);
  context.stroke();
  context.setLineDash([]);
  context.beginPath();
  context.arc(hx, hy, 5, 0, TAU);
  context.fill();
  context.restore();
}
