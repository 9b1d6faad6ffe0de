// Sliders for the parameters of the nodes. A value that a node refuses goes back.

import { byId, element, leaveAfterPointer, math, parseNumber, plain, setText } from './dom.js';

const PERIOD = 120;
const REST = 900;

export class Settings {
  constructor(model, send, notices) {
    Object.assign(this, { model, send, notices });
    this.rows = new Map();
    this.shown = '';
    /** Groups that were opened. */
    this.opened = new Set();
    /** When each was sent last. */
    this.sent = new Map();
  }

  /** Show the values of the selected robot. */
  show(force = false) {
    const robot = this.model.selected, rows = (robot && this.model.settings[robot.name]) ?? [];
    byId('settings').hidden = !rows.length;
    setText(byId('settings').firstElementChild, this.model.recorded ? 'Parameters, as recorded' : 'Parameters');
    const layout = `${robot?.name} ${rows.map((row) => `${row.key} ${row.choices ?? ''} ${row.low} ${row.high}`).join(';')}`;
    if (layout !== this.shown) {
      this.shown = layout;
      this.rows.clear();
      byId('sliders').replaceChildren(...this.grouped(rows));
    }
    for (const row of rows) {
      const changed = this.sent.get(row.key) ?? -Infinity;
      if (force || performance.now() - changed > REST) this.rows.get(row.key)(row.value);
    }
  }

  /** Create rows; those of a group are folded away while none of them is in use. */
  grouped(rows) {
    const groups = new Map(), nodes = [];
    for (const row of rows) {
      const node = this.create(row);
      if (row.group && !groups.has(row.group)) {
        const open = rows.some((one) => one.group === row.group && one.used) || this.opened.has(row.group);
        const group = element('details', { open }, element('summary', {}, row.group));
        group.addEventListener('toggle', () => this.opened[group.open ? 'add' : 'delete'](row.group));
        groups.set(row.group, group);
        nodes.push(groups.get(row.group));
      }
      if (row.group) groups.get(row.group).append(node);
      else nodes.push(node);
    }
    return nodes;
  }

  create(row) {
    const id = `setting-${row.key.replace(/\W/g, '-')}`;
    const label = element('label', { htmlFor: id, title: row.hint }, ...math(row.label));
    const controls = { choice: this.choice, flag: this.flag }[row.kind] ?? this.number;
    const { nodes, set } = controls.call(this, row, id, label);
    for (const node of nodes) node.disabled = this.model.looking;
    this.rows.set(row.key, set);
    return element('div', { class: 'setting', 'data-key': row.key, title: row.hint }, label, ...nodes);
  }

  choice(row, id) {
    const select = element('select', { id }, ...row.choices.map((name) => element('option', { value: name }, name)));
    select.addEventListener('change', () => this.change(row, select.value));
    leaveAfterPointer(select);
    return { nodes: [select], set: (value) => { select.value = value; } };
  }

  flag(row, id) {
    const box = element('input', { id, type: 'checkbox' });
    box.addEventListener('change', () => this.change(row, box.checked));
    leaveAfterPointer(box);
    return { nodes: [box], set: (value) => { box.checked = value; } };
  }

  number(row, id, label) {
    const limit = row.kind === 'limit', step = (row.high - row.low) / 400;
    const slider = element('input', { id, type: 'range', min: row.low, max: row.high, step, 'aria-description': row.hint });
    const field = element('input', { type: 'text', inputMode: 'decimal', 'aria-label': `${label.textContent}, exact value${limit ? ', empty for none' : ''}`,
      placeholder: limit ? 'none' : '' });
    const write = (value) => { field.value = value === null ? '' : plain(value); };
    slider.addEventListener('input', () => { write(Number(slider.value)); this.change(row, Number(slider.value), true); });
    slider.addEventListener('change', () => this.change(row, Number(slider.value)));
    slider.addEventListener('pointerup', () => slider.blur());
    field.addEventListener('change', () => {
      const value = parseNumber(field.value);
      if (Number.isFinite(value)) this.change(row, value);
      else if (limit && field.value.trim() === '') this.change(row, null);
      else {
        this.notices.show('error', `${row.label} must be a number${limit ? ', or empty for none' : ''}, got "${field.value}"`);
        this.show(true);
      }
    });
    field.addEventListener('keydown', (event) => { if (event.key === 'Enter') field.blur(); });
    const set = (value) => {
      if (document.activeElement === field) return;
      slider.value = value ?? row.high;
      write(value);
    };
    return { nodes: [slider, field, element('span', { class: 'unit' }, row.unit.replace('^2', '²'))], set };
  }

  /** Send a value; of many in a row not every one. */
  change(row, value, moving = false) {
    const now = performance.now(), before = this.sent.get(row.key) ?? -Infinity;
    if (moving && now - before < PERIOD) return;
    this.sent.set(row.key, now);
    this.send({ do: 'set', robot: this.model.selected.name, parameter: row.key, value });
  }

  /** A node has refused something: show what it has. */
  refused() {
    this.sent.clear();
    this.show(true);
  }
}
