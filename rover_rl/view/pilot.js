// Keys press the buttons of the pad, and the buttons lie as the arrows of a keyboard do.
(() => {
  const keys = {KeyW: '▲', KeyA: '◀', KeyS: '▼', KeyD: '▶'};
  Object.assign(keys, {ArrowUp: '▲', ArrowLeft: '◀', ArrowDown: '▼', ArrowRight: '▶'});
  const find = (label) => [...document.querySelectorAll('button')].find((one) => one.textContent.trim() === label);
  const held = new Set();
  const send = (label, kind) => {
    const button = find(label);
    if (button) button.dispatchEvent(new PointerEvent(kind, {bubbles: true, button: 0}));
  };
  const release = () => { held.forEach((code) => send(keys[code], 'pointerup')); held.clear(); };
  const listen = (kind, act) => window.addEventListener(kind, (event) => {
    const writes = ['INPUT', 'TEXTAREA'].includes(event.target.tagName) && event.target.type !== 'checkbox';
    if (!keys[event.code] || writes || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    act(event.code);
  }, true);
  if (!window.roverKeys) {
    window.roverKeys = true;
    listen('keydown', (code) => { if (!held.has(code)) { held.add(code); send(keys[code], 'pointerdown'); } });
    listen('keyup', (code) => { held.delete(code); send(keys[code], 'pointerup'); });
    window.addEventListener('blur', release);
    document.addEventListener('visibilitychange', release);
  }
  const arrange = () => {
    const buttons = ['▲', '◀', '▼', '▶'].map(find);
    if (buttons.some((one) => !one)) return setTimeout(arrange, 200);
    buttons.forEach((one, i) => {
      one.parentElement.style.display = 'inline-block';
      one.parentElement.style.width = 'calc(33% - 8px)';
      one.parentElement.style.margin = i ? '0 4px' : '0 33%';
    });
  };
  arrange();
})()
