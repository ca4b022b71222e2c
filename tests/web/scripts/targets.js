// Elements that are pressed or entered, each with the label that is pressed for it.
() => [...document.querySelectorAll("button, select, input, summary, [role=tab], a")]
  .filter(e => e.checkVisibility() && !e.hidden && !e.matches(".skip"))
  .map(e => [e.outerHTML.slice(0, 120), (e.type === "checkbox" ? e.closest("label") : e).getBoundingClientRect()])
  .filter(([, box]) => Math.min(box.width, box.height) < 24).map(([what, box]) => [what, box.width, box.height])
