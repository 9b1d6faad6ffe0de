// The chain of matrices from the goal to the velocity in the world, with live numbers.

import { element, format, math, plain, setMath, setText } from './dom.js';

const LAWS = {
  __proto__: null,
  go_to_goal: ['v = K_v d cos e,  ω = K_p e', 'A (9)–(11)'],
  pose: ['v = K_v ρ cos α,  ω = K_p α + K_v cos α (sin α / α)(α + h φ)', 'Aicardi 1995'],
  offset_point: ['w = J_d⁻¹ k (p_{goal} − p_d)', 'B'],
};
const GOAL = 'd = |p_{goal} − p|,  e = ∠(p_{goal} − p) − θ';
const PATH_LAWS = {
  __proto__: null,
  pure_pursuit: ['v = v_r,  ω = 2 v y / l_d²', 'Coulter 1992'],
  kanayama: ['v = v_r cos e_{θ} + k_x e_x,  ω = ω_r + v_r (k_y e_y + k_{θ} sin e_{θ})', 'Kanayama 1990'],
  offset_point: ['w = J_d⁻¹ (ṗ_r + k (p_r − p_d))', 'B'],
  dynamic_feedback: ['u = p̈_r + k_d (ṗ_r − ṗ) + k_p (p_r − p),  ω = (u_2 cos θ − u_1 sin θ) / ξ', 'Oriolo 2002'],
};

/** A vector or matrix whose numbers change. `classes` has one name for each row. */
class Matrix {
  constructor(rows, columns, classes = [], digits = 3) {
    this.digits = digits;
    this.cells = Array.from({ length: rows * columns }, (_, k) => element('span', { class: classes[Math.floor(k / columns)] ?? '' }));
    this.node = element('span', { class: columns === 2 ? 'matrix two' : 'matrix' }, ...this.cells);
  }

  set(values) {
    values.flat().forEach((value, k) => setText(this.cells[k], format(value, this.digits)));
  }
}

/** A matrix of symbols. */
function symbols(name, columns, ...cells) {
  const matrix = element('span', { class: columns === 2 ? 'matrix two' : 'matrix' }, ...cells.map((cell) => element('span', {}, ...math(cell))));
  return element('span', { class: 'symbols numbers' }, element('span', {}, ...math(`${name} =`)), matrix);
}

function link(title, equation, source, symbolic, ...numbers) {
  const heading = element('h3', {}, element('span', {}, ...math(title)), element('span', { class: 'source', title: 'Document and equation: see doc/mathematics.md' }, source));
  const formula = element('p', { class: 'equation' });
  setMath(formula, equation);
  return { node: element('div', { class: 'link' }, heading,
    element('div', { class: 'formula' }, formula, symbolic), element('div', { class: 'numbers' }, ...numbers)), heading, formula };
}

const toGoal = (target, now) => `(${format(target[0], 2)}, ${format(target[1], 2)}) m   →   d = ${format(now.distance)} m,  e = ${format(now.bearing_error)} rad`
  + (now.goal_heading_error === null ? '' : `, heading at the goal: Δθ = ${format(now.goal_heading_error)} rad`);

const onPath = (now) => `${format(now.distance)} m to go; ${format(now.across === null ? null : Math.abs(now.across))} m ${now.across < 0 ? 'right' : 'left'} of it, turned by ${format(now.path_heading_error)} rad`
  + (now.late === null ? '' : `, ${format(Math.abs(now.along))} m ${now.along < 0 ? 'behind' : 'ahead of'} its times, ${format(now.late, 1)} s late`);

const unit = (text) => element('span', { class: 'unit' }, text);

export class Chain {
  constructor(section) {
    this.goal = element('span');
    this.law = element('span');
    const pair = ['v', 'omega'], sides = ['right', 'left'];
    this.command = new Matrix(2, 1, pair);
    this.inverse = new Matrix(2, 2, [], 2);
    this.commandAgain = new Matrix(2, 1, pair);
    this.wanted = new Matrix(2, 1, sides);
    this.forward = new Matrix(2, 2, [], 4);
    this.wheels = new Matrix(2, 1, sides);
    this.twist = new Matrix(2, 1, pair);
    this.unicycle = new Matrix(3, 2, [], 3);
    this.twistAgain = new Matrix(2, 1, pair);
    this.world = new Matrix(3, 1);
    this.links = {
      goal: link('Goal', GOAL, 'A (9)', '', this.goal),
      law: link('Control law', LAWS.go_to_goal[0], LAWS.go_to_goal[1], '', '[v, ω] =', this.command.node, unit('m/s, rad/s'), this.law),
      inverse: link('To the wheels', '[ω_R, ω_L] = J_w⁻¹ [v, ω]', 'A (8), E',
        symbols('J_w⁻¹', 2, '1/r', 'L/2r', '1/r', '−L/2r'), this.wanted.node, '=', this.inverse.node, this.commandAgain.node, unit('rad/s')),
      forward: link('From the wheels to the body', '[v, ω] = J_w [ω_R, ω_L]', 'A (8), E',
        symbols('J_w', 2, 'r/2', 'r/2', 'r/L', '−r/L'), this.twist.node, '=', this.forward.node, this.wheels.node),
      world: link('From the body to the world', 'q̇ = [ẋ, ẏ, θ̇] = S(θ) [v, ω]', 'A (4)–(7)',
        symbols('S', 2, 'cos θ', '0', 'sin θ', '0', '0', '1'), this.world.node, '=', this.unicycle.node, this.twistAgain.node),
    };
    this.note = element('p', { class: 'small' });
    section.append(element('h2', {}, 'From the goal to motion'), ...Object.values(this.links).map((one) => one.node), this.note);
  }

  show(robot, recorded) {
    const { chain, law, goal, now } = robot, active = now.distance !== null && goal.active;
    const target = active && goal.goals ? goal.goals[goal.index] : null, path = goal.path;
    setMath(this.links.goal.formula, path ? '[e_x, e_y] = R(θ)ᵀ (p_r − p),  e_{θ} = θ_r − θ' : GOAL);
    setText(this.goal, target && path ? onPath(now)
      : target ? toGoal(target, now)
      : robot.by_hand ? 'none: driven by hand' : recorded ? 'none' : 'none: click on the map');
    this.links.goal.node.classList.toggle('idle', !target);
    const [formula, source] = (robot.along_path ? PATH_LAWS : LAWS)[law.name] ?? ['[v, ω] = law(pose, goal)', law.name || 'not known'];
    setMath(this.links.law.formula, robot.by_hand ? 'your keys' : formula);
    setText(this.links.law.heading.lastChild, robot.by_hand ? '' : source);
    setMath(this.law, this.describe(robot));
    this.links.law.node.classList.toggle('idle', !robot.commanded);
    this.command.set(chain.command);
    this.commandAgain.set(chain.command);
    this.inverse.set(chain.inverse);
    this.wanted.set(chain.wanted);
    this.forward.set(chain.forward);
    this.wheels.set(chain.wheels);
    this.twist.set(chain.twist);
    this.twistAgain.set(chain.twist);
    this.unicycle.set(chain.unicycle);
    this.world.set(chain.world);
    const [r, L] = robot.geometry;
    setText(this.note, `q = (${format(robot.pose[0])} m, ${format(robot.pose[1])} m, ${format(robot.pose[2])} rad), r = ${format(r)} m, L = ${format(L)} m. `
      + (chain.measured ? 'The wheel speeds that move the body are those of joint_states.' : 'No joint_states: the wheels are taken to do as told.')
      + (robot.truth ? ` By ground truth (${format(robot.truth[0])} m, ${format(robot.truth[1])} m, ${format(robot.truth[2])} rad).` : ''));
  }

  /** Return the gains, and the factor by which limits scale what the law computes. */
  describe(robot) {
    const { law, chain } = robot;
    if (robot.by_hand || !robot.commanded) return '';
    const gains = Object.entries(law.gains).map(([name, value]) => `${name} = ${value === null ? '–' : plain(value)}`).join(', ');
    if (!law.twist) return gains;
    const factors = law.twist.map((value, k) => chain.command[k] / value).filter((_, k) => Math.abs(law.twist[k]) > 0.02);
    const limited = factors.length > 0 && Math.max(...factors) < 0.97 && Math.max(...factors) - Math.min(...factors) < 0.02;
    return limited ? `${gains}; the limits scale both by ${format(factors[0], 2)}` : gains;
  }
}
