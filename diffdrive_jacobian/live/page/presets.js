// For a projector: larger type, fewer panels, and gains as buttons that can be hit from afar.

import { byId, element, math, plain } from './dom.js';

const KEY = 'projector';
const SHARES = [0, 0.25, 1];

export class Presets {
  constructor(model, send, onChange) {
    /** The values that were found first: one must come back to them. */
    this.first = new Map();
    Object.assign(this, { model, send, onChange, shown: '' });
    byId('projector').addEventListener('click', () => {
      try { localStorage.setItem(KEY, this.on ? '' : '1'); } catch { /* It is not kept. */ }
      this.apply(!this.on);
      byId('projector').blur();
    });
    let kept = '';
    try { kept = localStorage.getItem(KEY); } catch { /* Nothing is kept. */ }
    this.apply(kept === '1');
  }

  get on() {
    return document.documentElement.dataset.projector === 'on';
  }

  apply(on) {
    document.documentElement.dataset.projector = on ? 'on' : 'off';
    byId('projector').setAttribute('aria-pressed', String(on));
    this.onChange();
  }

  /** Show the law and its gains. */
  show() {
    const robot = this.model.selected, rows = (robot && this.model.settings[robot.name]) ?? [];
    const gains = rows.filter((row) => row.kind === 'number' && !row.group && row.label in (robot?.law.gains ?? {}));
    const laws = rows.filter((row) => row.kind === 'choice' && !row.group);
    byId('presets').hidden = !this.on || this.model.looking || !(gains.length + laws.length);
    if (byId('presets').hidden) return;
    const layout = JSON.stringify([robot.name, laws, gains]);
    if (layout === this.shown) return;
    this.shown = layout;
    byId('choices').replaceChildren(
      ...laws.map((row) => this.row(row, row.choices.map((name) => [name, name]))),
      ...gains.map((row) => {
        const id = `${robot.name} ${row.key}`;
        if (!this.first.has(id)) this.first.set(id, row.value);
        const values = SHARES.map((share) => Number((row.low + share * (row.high - row.low)).toPrecision(2)));
        const all = [...new Set([...values, this.first.get(id)])].sort((a, b) => a - b);
        return this.row(row, all.map((value) => [value, plain(value)]));
      }),
    );
  }

  row(row, choices) {
    return element('div', { class: 'preset', role: 'group', 'aria-label': row.label }, element('span', {}, ...math(row.label)),
      ...choices.map(([value, text]) => {
        const button = element('button', { type: 'button', 'aria-pressed': String(value === row.value) }, text);
        button.addEventListener('click', () => {
          this.send({ do: 'set', robot: this.model.selected.name, parameter: row.key, value });
          button.blur();
        });
        return button;
      }));
  }
}

/** Show the address of a shared page, as a code that phones read. */
export function prepareShare(model) {
  byId('share').addEventListener('click', () => {
    byId('sharing').hidden = !byId('sharing').hidden;
    if (byId('sharing').hidden) return;
    byId('code').src = 'share.svg';
    byId('link').textContent = model.may.shared;
    byId('rights').textContent = model.may.guests_steer ? 'Whoever opens it can steer the robots.' : 'Whoever opens it can look, not steer.';
  });
}
