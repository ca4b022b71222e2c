// Sizes of all text that can be seen, in pixels.
() => [...new Set([...document.querySelectorAll("body *")]
  .filter(e => e.checkVisibility() && [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim()))
  .map(e => parseFloat(getComputedStyle(e).fontSize).toFixed(2)))].sort().map(Number)
