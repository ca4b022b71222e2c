// @ts-check
// Scenarios that are pinned, side by side, and what was simulated; the browser's tab keeps them.

import {byId, element, tableOf} from "./dom.js"
import {dashed} from "./legend.js"

/** @typedef {import("./protocol.js").Entered} Entered */
/**
 * A question with its answer: its slot is how pictures draw it, and at is when it was simulated. The answer of a tab
 * without a chance is its table, in rows.
 * @typedef {{link: string, entered: Entered, files: string, shown: string, interval: string, words: string,
 *   facts: [string, string][], rows?: string[][], slot?: number, at?: string}} Scenario
 */

const MOST = 8
const KEY = "mauvecl-compare"
/** @type {[string, (entered: Entered) => string][]} */
const ROWS = [
  ["Star", e => e.star], ["Magnitude", e => `${e.band} = ${e.magnitude}`], ["Flare", e => `${e.amplitude_percent} %`],
  ["Flare's spectrum", e => spectrum(e)], ["Exposure", e => `${e.exposure_s} s`],
  ["Statistic", e => e.statistic], ["False-alarm probability", e => e.fap], ["Kind of answer", e => e.unknown],
]

/** The flare's light in a few words; scenarios that were kept before may lack fields.
 * @param {Entered} entered */
function spectrum(entered) {
  const second = entered.second_temperature_k
  const parts = [`${entered.flare_temperature_k} K`, entered.balmer_jump && `jump ${entered.balmer_jump}`,
    second && `${entered.second_area} of its area at ${second} K`, entered.lines]
  return parts.filter(Boolean).join(", ")
}

export class Compare {
  /**
   * @param {Record<string, [string, string][]>} pins how pinned scenarios are drawn, by theme
   * @param {(link: string) => void} open show a scenario again
   * @param {() => void} changed others are pinned
   */
  constructor(pins, open, changed) {
    this.pins = pins
    this.open = open
    this.changed = changed
    /** @type {{pinned: Scenario[], history: Scenario[]}} */
    this.kept = {pinned: [], history: []}
    window.addEventListener("mauvecl-theme", () => this.show())
    try {
      this.kept = JSON.parse(sessionStorage.getItem(KEY)) ?? this.kept
    } catch { /* not kept */ }
    this.show()
  }

  /** @param {Scenario} scenario */
  pin(scenario) {
    this.kept.pinned = [...this.kept.pinned.filter(one => one.link !== scenario.link), scenario].slice(-MOST)
    this.keep()
  }

  /** What is drawn how, in a few words, for a picture's reader.
   * @returns {Element[]} */
  key(theme = document.documentElement.dataset.theme) {
    const look = this.pins[theme]
    return this.drawn.flatMap((one, slot) => {
      if (!one) return []
      const {star, band, magnitude, amplitude_percent, exposure_s} = one.entered
      const message = element("span")
      message.innerHTML = dashed(look[slot])
      message.append(`${slot + 1}: ${star}, ${band} = ${magnitude}, ${amplitude_percent} %, ${exposure_s} s`)
      return message
    })
  }

  /** Those that pictures show, by their slots: a scenario keeps its colour as long as it is pinned.
   * @returns {(Scenario | undefined)[]} */
  get drawn() {
    const slots = this.pins.light.map((_, k) => this.kept.pinned.find(one => one.slot === k))
    const others = this.kept.pinned.filter(one => !slots.includes(one) && !one.rows)
    return slots.map((one, slot) => one ?? (others.length ? Object.assign(others.shift(), {slot}) : undefined))
  }

  /** @param {Scenario} scenario */
  ran(scenario) {
    this.kept.history = [scenario, ...this.kept.history.filter(one => one.link !== scenario.link)].slice(0, 20)
    this.keep()
  }

  keep() {
    try {
      sessionStorage.setItem(KEY, JSON.stringify(this.kept))
    } catch { /* not kept */ }
    this.show()
    this.changed()
  }

  /**
   * @param {string} text
   * @param {string} called
   * @param {() => void} act
   */
  button(text, called, act) {
    const made = element("button", text, {type: "button", className: "plain", onclick: act})
    made.setAttribute("aria-label", called)
    return made
  }

  /** Buttons of a pinned scenario.
   * @param {Scenario} one
   * @param {string} called */
  handles(one, called) {
    return [
      this.button("Open", `Open ${called}`, () => this.open(one.link)),
      this.button("Remove", `Remove ${called}`, () => {
        this.kept.pinned = this.kept.pinned.filter(other => other !== one)
        this.keep()
      }),
    ]
  }

  show() {
    const {history} = this.kept
    const pinned = this.kept.pinned.filter(one => !one.rows), tables = this.kept.pinned.filter(one => one.rows)
    const drawn = this.drawn, look = this.pins[document.documentElement.dataset.theme]
    const box = byId("pinned")
    if (pinned.length) {
      const table = element("table")
      table.append(element("caption", "Pinned scenarios", {className: "quiet"}))
      const row = (/** @type {string} */ head, /** @type {Element[]} */ cells) => {
        const made = element("tr")
        made.append(element("th", head, {scope: "row"}), ...cells)
        table.append(made)
      }
      row("Drawn as", pinned.map(one => {
        const slot = drawn.indexOf(one), cell = element("td", slot < 0 ? "not drawn" : `pinned ${slot + 1} `)
        if (slot >= 0) cell.insertAdjacentHTML("beforeend", dashed(look[slot]))
        return cell
      }))
      row("Detected", pinned.map(one => {
        const cell = element("td")
        cell.append(element("strong", one.shown))
        return cell
      }))
      row("Assumed", pinned.map(one => element("td", one.interval)))
      for (const [head, of] of ROWS) row(head, pinned.map(one => element("td", of(one.entered))))
      for (const [head] of pinned[0].facts) {
        row(head, pinned.map(one => element("td", Object.fromEntries(one.facts)[head] ?? "")))
      }
      row("Actions", pinned.map((one, k) => {
        const cell = element("td")
        cell.append(...this.handles(one, `scenario ${k + 1}`))
        return cell
      }))
      box.replaceChildren(table)
    } else box.replaceChildren()
    if (!this.kept.pinned.length) {
      box.append(element("p", "Nothing is pinned yet: Pin keeps the present question and its answer here."))
    }
    for (const [k, one] of tables.entries()) {
      const table = tableOf(one.rows ?? [])
      table.prepend(element("caption", `${one.shown}: ${one.words} `))
      table.caption.append(...this.handles(one, `table ${k + 1}`))
      box.append(table)
    }
    byId("no-history").hidden = history.length > 0
    byId("history").replaceChildren(...history.map((one, k) => {
      const item = element("li", `${one.at}: ${one.shown}${one.interval && ` (${one.interval})`}, ${one.words} `)
      item.append(this.button("Open", `Open run ${history.length - k}`, () => this.open(one.link)))
      return item
    }))
  }
}
