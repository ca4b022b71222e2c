// @ts-check
// Exports: tables, studies, pictures, commands, programs, and the link.

import {byId, every} from "./dom.js"

/** @typedef {import("./protocol.js").Live} Live */
/** @typedef {import("./routing.js").Routing} Routing */
/** @typedef {{question: string, command: string, python: string}} Taken */

/** Save content as a file.
 * @param {string} name
 * @param {Blob | ArrayBuffer} content */
export function give(name, content) {
  const link = document.createElement("a")
  link.href = URL.createObjectURL(content instanceof Blob ? content : new Blob([content]))
  link.download = name
  link.click()
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000)
}

/** @param {HTMLButtonElement} button */
async function copy(button) {
  const from = button.dataset.copy
  const text = from === "address" ? window.location.href : byId(from).textContent
  if (!navigator.clipboard) {
    // Browsers have it for this machine and for https alone.
    window.prompt("Copy with Ctrl-C:", text)
    return
  }
  await navigator.clipboard.writeText(text)
  const before = button.textContent
  button.textContent = "Copied"
  setTimeout(() => { button.textContent = before }, 1500)
}

export class Export {
  /**
   * @param {Live} live
   * @param {Routing} routing
   * @param {() => void} offer show again which buttons can be pressed
   * @param {(why: string) => void} refused it could not be made
   */
  constructor(live, routing, offer, refused) {
    this.live = live
    this.routing = routing
    this.offer = offer
    this.refused = refused
    /** @type {Taken[]} */
    this.taken = []
    byId("of").onchange = () => this.show()
    byId("study").onclick = () => this.take("", this.chosen.question, "study", byId("study"))
    for (const button of every("[data-file]")) {
      const tab = button.closest("[role=tabpanel]").id.replace("panel-", "")
      button.onclick = () => this.take(tab, button.dataset.file, button.dataset.ending, button)
    }
    for (const button of every("[data-copy]")) button.onclick = () => copy(button)
  }

  /**
   * @param {string} tab
   * @param {string} name
   * @param {string} ending
   * @param {HTMLButtonElement} button
   */
  take(tab, name, ending, button) {
    button.disabled = true
    const n = this.live.ask("file", {link: this.routing.link, tab, name, ending}, (message, content) => {
      this.live.done(n)
      this.offer()
      if (message.refused) this.refused(message.refused)
      else give(message.file, content)
    })
  }

  // Show what the open tab asks as commands and as programs.
  open() {
    const n = this.live.ask("export", {link: this.routing.link, tab: this.routing.seen.tab}, message => {
      this.live.done(n)
      if (message.refused) {
        this.refused(message.refused)
        return
      }
      this.taken = message.taken
      byId("of").replaceChildren(...this.taken.map(({command}) => new Option(command.split(" ", 2).join(" "))))
      byId("of").parentElement.hidden = this.taken.length === 1
      this.show()
      byId("export").showModal()
    })
  }

  /** The question of which command and program are shown. */
  get chosen() {
    return this.taken[byId("of").selectedIndex]
  }

  show() {
    byId("as-command").textContent = this.chosen.command
    byId("as-python").textContent = this.chosen.python
  }
}
