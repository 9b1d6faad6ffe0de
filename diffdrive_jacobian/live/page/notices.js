// Notices that come and go. What is wrong stays longer.

import { element } from './dom.js';

const LIFE = { info: 4000, warning: 8000, error: 12000 };
const MOST = 4;

export class Notices {
  constructor(section) {
    this.section = section;
  }

  show(level, text) {
    for (const other of [...this.section.children]) if (other.dataset.text === text) other.remove();
    const close = element('button', { type: 'button', 'aria-label': 'Close' }, '✕');
    const notice = element('div', { class: `notice ${level}` }, element('span', {}, text), close);
    notice.dataset.text = text;
    close.addEventListener('click', () => notice.remove());
    setTimeout(() => notice.remove(), LIFE[level] ?? LIFE.info);
    this.section.append(notice);
    while (this.section.children.length > MOST) this.section.firstChild.remove();
  }
}
