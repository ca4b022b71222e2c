// @ts-check
// The list of stars below their field, with the names that contain the typed text.

import {STEPS} from "./dom.js"

export class Stars {
  /**
   * @param {HTMLInputElement} field
   * @param {HTMLElement} list
   * @param {string[]} names
   * @param {() => void} chosen
   */
  constructor(field, list, names, chosen) {
    this.field = field
    this.list = list
    this.names = names
    this.chosen = chosen
    this.at = -1
    field.addEventListener("input", () => this.open(field.value))
    field.addEventListener("focus", () => field.select())
    field.addEventListener("click", () => { if (list.hidden) this.open("") })
    field.addEventListener("blur", () => this.close())
    field.addEventListener("keydown", event => this.key(event))
    // Before the field loses the focus.
    list.addEventListener("mousedown", event => {
      event.preventDefault()
      const item = /** @type {HTMLElement} */ (event.target)
      if (item.role === "option") this.choose(item)
    })
  }

  /** @param {string} text */
  open(text) {
    const wanted = text.trim().toLowerCase()
    const found = this.names.filter(name => name.toLowerCase().includes(wanted))
    this.list.replaceChildren(...found.map((name, k) => {
      const item = document.createElement("li")
      item.role = "option"
      item.id = `star-${k}`
      item.textContent = name
      item.setAttribute("aria-selected", "false")
      return item
    }))
    this.at = -1
    // A complete name needs no list, which would cover the fields below.
    this.show(found.length > 0 && !(found.length === 1 && found[0].toLowerCase() === wanted))
  }

  /** @param {boolean} open */
  show(open) {
    this.list.hidden = !open
    this.field.setAttribute("aria-expanded", String(open))
    if (!open) this.field.removeAttribute("aria-activedescendant")
  }

  close() { this.show(false) }

  /** @param {KeyboardEvent} event */
  key(event) {
    const step = -STEPS[event.key]
    if (step) {
      event.preventDefault()
      if (this.list.hidden) this.open("")
      const items = this.list.children
      items[this.at]?.setAttribute("aria-selected", "false")
      this.at = (this.at + step + items.length) % items.length
      const item = items[this.at]
      item.setAttribute("aria-selected", "true")
      item.scrollIntoView({block: "nearest"})
      this.field.setAttribute("aria-activedescendant", item.id)
    } else if (event.key === "Enter") {
      event.preventDefault()
      const item = this.list.hidden ? null : this.list.children[this.at]
      if (item) this.choose(item)
      else { this.close(); this.chosen() }
    } else if (event.key === "Escape") this.close()
  }

  /** @param {Element} item */
  choose(item) {
    this.field.value = item.textContent
    this.close()
    this.chosen()
  }
}
