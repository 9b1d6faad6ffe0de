// Small helpers for elements and numbers.

export const byId = (id) => document.getElementById(id);

/** Return a new element with properties and children. */
export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name === 'class') made.className = value;
    else if (name.includes('-') || name === 'role') made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children);
  return made;
}

/** Give up the focus after a change by mouse or finger, so that keys drive again; a keyboard goes on choosing. */
export function leaveAfterPointer(node) {
  let keys = false;
  node.addEventListener('keydown', () => { keys = true; });
  node.addEventListener('pointerdown', () => { keys = false; });
  node.addEventListener('change', () => { if (!keys) node.blur(); });
}

/** Set the text of an element if it is new. */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Return text as nodes in which `_{xyz}`, and `_x` at the end of a word, are subscripts. */
export function math(text) {
  return text.split(/(_\{[^}]*\}|_\w\b)/).map((part) => (part.startsWith('_') && part.length > 1
    ? element('sub', {}, part.replace(/[_{}]/g, '')) : part));
}

/** Set such text if it is new. */
export function setMath(node, text) {
  if (node.dataset.text === text) return;
  node.dataset.text = text;
  node.replaceChildren(...math(text));
}

/** Return a number as a person would type it. */
export function plain(value) {
  const small = value !== 0 && Math.abs(value) < 1e-3;
  return small ? value.toExponential(2).replace(/\.?0+e/, 'e') : String(Number(value.toPrecision(4)));
}

/** Return a number as text with a true minus sign; a dash if there is none. */
export function format(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return '–';
  const text = value.toFixed(digits);
  return (Number(text) === 0 ? (0).toFixed(digits) : text).replace('-', '−');
}

/** Return what a person typed as a number; NaN: it is none. */
export function parseNumber(text) {
  const plain = text.trim().replace('−', '-').replace(',', '.');
  // No other base, which Number would read.
  return /^[-+\d.e]+$/i.test(plain) ? Number(plain) : NaN;
}

/** Return a heading that a person typed (rad), as `--heading` and `--degrees` take it; null: none; NaN: it is invalid. */
export function parseHeading(text) {
  if (text.trim() === '') return null;
  const [, number, unit] = text.match(/^(.*?)\s*(°|deg|degrees|rad)?\s*$/s);
  const value = parseNumber(number) * (unit && unit !== 'rad' ? Math.PI / 180 : 1);
  return Math.abs(value) <= 2 * Math.PI ? value : NaN;
}

/** Make the canvas as sharp as the screen; return its context and its size in CSS pixels. */
export function prepared(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext('2d');
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/** Return 1, 2 or 5 times a power of ten, not below a value. */
export function niceStep(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= value * (1 - 1e-9));
}
