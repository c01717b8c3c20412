// Moves the line of the plots to where the time slider of the replay is, and shows its caption.
(() => {
  const lines = document.querySelectorAll('.curve .now');
  const caption = document.querySelector('.caption');
  const follow = () => {
    const slider = document.querySelector('[role=slider]');
    if (slider) {
      const share = slider.getAttribute('aria-valuenow') / slider.getAttribute('aria-valuemax');
      lines.forEach((line) => { line.setAttribute('x1', 100 * share); line.setAttribute('x2', 100 * share); });
      caption.textContent = captions[Math.min(captions.length - 1, Math.floor(share * captions.length))];
    }
    requestAnimationFrame(follow);
  };
  follow();
})();
