// Messages of faults that can be seen, as pairs with what they lie over, and those that do not span their form.
() => [...document.querySelectorAll(".wrong")].filter(e => e.textContent && e.checkVisibility({opacityProperty: true}))
  .flatMap(message => {
    const at = message.getBoundingClientRect(), form = message.closest("form, .form")
    const others = [...form.querySelectorAll("label, input, select, textarea, button")].filter(e => {
      const box = e.getBoundingClientRect()
      const apart = box.bottom <= at.top + 1 || box.top >= at.bottom - 1 || box.right <= at.left || box.left >= at.right
      return e.checkVisibility() && !apart
    })
    const narrow = form.matches("form") && at.width < 0.9 * form.clientWidth ? ["narrow"] : []
    return [...others.map(e => e.outerHTML.slice(0, 80)), ...narrow].map(what => [message.id, what])
  })
