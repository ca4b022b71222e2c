// @ts-check
// Simulations: one at a time, its progress, and those that are still wanted.

import {byId, every} from "./dom.js"

/** @typedef {import("./card.js").Card} Card */
/** @typedef {import("./protocol.js").Live} Live */
/** @typedef {import("./routing.js").Routing} Routing */

export class Simulations {
  /**
   * @param {Live} live
   * @param {Routing} routing
   * @param {Card} card
   * @param {{question(kind: string): string, lacks(kind: string): string, ready(): boolean, offer(): void, ended(): void, refused(why: string): void}} page
   *   what a simulation is asked; what must be entered for it; whether it has an answer; show which buttons can be pressed; a simulation's answer is there, or not
   */
  constructor(live, routing, card, page) {
    this.live = live
    this.routing = routing
    this.card = card
    this.page = page
    /** @type {number | null} */
    this.running = null
    // The running simulation.
    this.kind = "detection"
    this.question = ""
    /** @type {string[]} */
    this.wanted = []
    // Where the progress is shown unless another button was pressed.
    this.home = byId("standing").parentElement
    byId("simulate").onclick = () => this.press("detection")
    byId("cancel").onclick = () => this.drop()
    for (const button of every("[data-simulate]")) {
      button.onclick = () => this.press(button.dataset.simulate)
    }
  }

  /** Start a simulation, or when the answer to what is entered is there; or say why not.
   * @param {string} kind */
  press(kind) {
    if (this.running !== null) return
    const lacks = this.page.lacks(kind)
    if (!lacks && this.page.ready()) {
      this.start(kind)
      return
    }
    this.place(kind)
    this.wanted = lacks ? [] : [kind]
    this.card.ended(lacks || "starts when what is entered has an answer")
  }

  /** @param {string} kind */
  start(kind) {
    if (this.running !== null || !this.page.ready()) return
    const question = this.question = this.page.question(kind)
    this.kind = kind
    this.place(kind)
    this.card.progress(0, "waiting for its turn")
    const n = this.running = this.live.ask("simulate", {kind, link: this.routing.link}, message => {
      if (message.ended === undefined) {
        this.card.progress(message.progress, message.message)
        return
      }
      this.live.done(n)
      this.running = null
      this.card.ended(message.ended)
      this.page.offer()
      if (question !== this.page.question(kind)) return
      if (message.refused) this.page.refused(message.refused)
      else if (message.kind) this.page.ended()
    })
    this.page.offer()
  }

  /** Show the progress next to the button that was pressed.
   * @param {string} [kind] */
  place(kind) {
    const [button] = every(`[role=tabpanel]:not([hidden]) [data-simulate="${kind}"]`)
    const place = button?.parentElement ?? this.home
    if (byId("standing").parentElement !== place) place.append(byId("standing"))
  }

  /** Start the next one that a link wants and that is not here.
   * @param {string[]} simulated */
  next(simulated) {
    this.wanted = this.wanted.filter(kind => !simulated.includes(kind))
    if (this.wanted.length && this.running === null) this.start(this.wanted.shift())
  }

  stop() {
    if (this.running !== null) this.live.ask("cancel", {})
  }

  // Another question: want no other, stop what does not belong to it, and say no more that it is done.
  changed() {
    this.wanted = []
    if (this.question === this.page.question(this.kind)) return
    if (this.running === null) this.card.ended("")
    else this.stop()
  }

  // Stop, and want no other.
  drop() {
    this.wanted = []
    this.stop()
  }

  // The connection is lost, and what ran with it.
  lost() {
    this.running = null
  }
}
