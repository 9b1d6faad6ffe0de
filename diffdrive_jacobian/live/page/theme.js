// Light or dark: as the system has it, until the reader chooses.

const KEY = 'theme';

/** Follow the theme, and call a function when it changes. */
export function followTheme(button, onChange) {
  const system = matchMedia('(prefers-color-scheme: dark)');
  const stored = () => { try { return localStorage.getItem(KEY); } catch { return null; } };
  const apply = () => {
    document.documentElement.dataset.theme = stored() ?? (system.matches ? 'dark' : 'light');
    onChange();
  };
  system.addEventListener('change', apply);
  button.addEventListener('click', () => {
    const next = document.documentElement.dataset.theme === 'dark' ? 'light' : 'dark';
    try { localStorage.setItem(KEY, next); } catch { document.documentElement.dataset.theme = next; }
    apply();
    button.blur();
  });
  apply();
}
