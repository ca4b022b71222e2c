// @ts-check
// The address of the page: its question, the tab in front, and what was simulated, as the query of a link.

import {byId} from "./dom.js"

/** @typedef {import("./protocol.js").Entered} Entered */
/** @typedef {import("./protocol.js").Words} Words */

export class Routing {
  /**
   * @param {Words} words
   * @param {Entered} entered the text of the fields
   * @param {() => void} moved the browser's history has led elsewhere
   * @param {() => void} turned another tab is in front
   */
  constructor(words, entered, moved, turned) {
    this.words = words
    this.entered = entered
    this.turned = turned
    this.seen = {...words.seen}
    this.stray = ""
    this.editing = false
    this.wireTabs()
    window.addEventListener("popstate", () => {
      this.editing = false
      moved()
    })
  }

  // The entered text as the query of a URL.
  get link() {
    /** @type {Entered} */
    const first = {...this.words.fields, ...this.words.seen}
    const pairs = Object.entries({...this.entered, ...this.seen})
    return `?${new URLSearchParams(pairs.filter(([name, text]) => text !== "" || first[name] !== ""))}`
  }

  // Simulations whose answers are seen.
  get simulated() {
    return this.seen.simulated.split(",").filter(Boolean)
  }

  /** Enter what a link holds; what is no field here is kept for the server, which says so.
   * @param {string} link */
  follow(link) {
    const stray = new URLSearchParams()
    const entered = {...this.words.fields}
    this.seen = {...this.words.seen}
    for (const [name, text] of new URLSearchParams(link)) {
      if (name in entered) entered[name] = text
      else if (name === "tab" || name === "simulated") this.seen[name] = text
      else stray.append(name, text)
    }
    if (!(this.seen.tab in this.words.tabs)) {
      stray.append("tab", this.seen.tab)
      this.seen.tab = this.words.seen.tab
    }
    this.stray = stray.toString()
    Object.assign(this.entered, entered)
    this.showTab()
  }

  /** @param {boolean} push whether it is a step of the history */
  show(push) {
    if (this.link === window.location.search) return
    window.history[push ? "pushState" : "replaceState"]({}, "", window.location.pathname + this.link)
  }

  /** The question has changed. While something is being chosen the address follows; all of it is one step of the history.
   * @param {boolean} last */
  step(last) {
    this.show(!this.editing)
    this.editing = !last
  }

  // Tabs

  showTab() {
    for (const name of Object.keys(this.words.tabs)) {
      const front = name === this.seen.tab
      const tab = byId(`tab-${name}`)
      tab.setAttribute("aria-selected", String(front))
      tab.tabIndex = front ? 0 : -1
      byId(`panel-${name}`).hidden = !front
    }
  }

  /** @param {string} name */
  toTab(name) {
    if (name === this.seen.tab) return
    this.seen.tab = name
    this.showTab()
    this.show(true)
    this.editing = false
    this.turned()
  }

  wireTabs() {
    const names = Object.keys(this.words.tabs)
    for (const name of names) {
      byId(`tab-${name}`).onclick = () => this.toTab(name)
      byId(`tab-${name}`).onkeydown = (/** @type {KeyboardEvent} */ event) => {
        const at = names.indexOf(name)
        /** @type {Record<string, number>} */
        const keys = {
          ArrowRight: (at + 1) % names.length, ArrowLeft: (at + names.length - 1) % names.length,
          Home: 0, End: names.length - 1,
        }
        const next = keys[event.key]
        if (next === undefined) return
        event.preventDefault()
        byId(`tab-${names[next]}`).focus()
        this.toTab(names[next])
      }
    }
  }
}
