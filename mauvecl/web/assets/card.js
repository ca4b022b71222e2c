// @ts-check
// The answer card, the notices below it, and what fades where there is no answer.

import {byId, element, every, tableOf} from "./dom.js"

/** @typedef {import("./protocol.js").Answer} Answer */

export class Card {
  constructor() {
    this.box = byId("card")
    this.said = byId("words-of")
    this.parts = [this.said, ...every(".message, .below", this.box), byId("facts")]
    /** @type {Set<string>} */
    this.dismissed = new Set()
    this.unfolded = false
  }

  /** @param {boolean} busy */
  busy(busy) {
    this.box.setAttribute("aria-busy", String(busy))
  }

  // What is shown is no answer to what is entered.
  fade() {
    this.busy(true)
    for (const part of [...this.parts, ...every(".pictures, .rows")]) part.classList.add("dim")
  }

  /** Another tab is in front; what is said is not its answer.
   * @param {boolean} chance whether the chance stands below the sentence */
  front(chance) {
    this.said.classList.add("dim")
    for (const part of every(".message, .rest", this.box)) part.hidden = !chance
  }

  /** The pictures of a tab are those of the answer; other tabs may still hold an earlier one's.
   * @param {string} tab */
  fresh(tab) {
    for (const part of every(`#panel-${tab} :is(.pictures, .rows)`)) part.classList.remove("dim")
  }

  /** The numbers, or the words that there are none, in the same room; what is below stays where it is.
   * @param {boolean} empty */
  empty(empty) {
    this.box.classList.toggle("none", empty)
    byId("numbers").classList.toggle("absent", empty)
    byId("no-answer").hidden = !empty
    byId("facts").classList.toggle("absent", empty)
  }

  /** The limit of what is solved for, and the chances with other payloads.
   * @param {string | undefined} sentence
   * @param {string | undefined} payloads */
  solved(sentence, payloads) {
    if (sentence !== undefined) byId("solved").textContent = sentence
    if (payloads !== undefined) byId("payloads").textContent = payloads
  }

  /** Show the answer in a sentence, before it is simulated the question.
   * @param {Answer} answer */
  tell(answer) {
    this.said.textContent = answer.headline || answer.words
    this.said.classList.remove("dim")
    // The notes that an earlier refusal hid are shown again.
    this.box.classList.remove("none")
    if (answer.chance) this.chance(answer)
    this.busy(false)
  }

  /** @param {Answer} answer */
  chance(answer) {
    this.empty(false)
    for (const part of this.parts) part.classList.remove("dim")
    for (const {unknown, shown, interval} of answer.numbers) {
      const [number] = every(`#numbers [data-unknown="${unknown}"]`)
      number.querySelector(".chance").textContent = shown
      number.querySelector(".interval").textContent = interval
      number.setAttribute("aria-pressed", String(unknown === answer.chosen))
    }
    byId("facts").replaceChildren(...answer.facts.flatMap(([name, value]) => [element("dt", name), element("dd", value)]))
  }

  /** @param {string} why */
  none(why) {
    this.empty(true)
    for (const part of this.parts) part.classList.remove("dim")
    this.said.textContent = why
    this.solved("", "")
    this.ended("")
    this.busy(false)
  }

  /**
   * @param {number} share
   * @param {string} message
   */
  progress(share, message, idle = false) {
    byId("progress").value = share
    byId("progress").classList.toggle("idle", idle)
    byId("status").textContent = message
  }

  /** @param {string} text */
  ended(text) {
    this.progress(0, text, true)
  }

  /** The small table of a tab.
   * @param {string} tab
   * @param {string[][]} rows */
  rows(tab, rows) {
    const box = every(`#panel-${tab} .rows`)[0]
    if (!box) return
    box.hidden = rows.length === 0
    box.replaceChildren(tableOf(rows))
  }

  /** Sentences that can be put away; one that was stays away as long as it is the same.
   * @param {[string, string][]} message */
  notices(message) {
    const box = byId("notices")
    const shown = message.filter(([text]) => !this.dismissed.has(text))
    const key = JSON.stringify(shown)
    if (box.dataset.key === key) return
    box.dataset.key = key
    const item = (/** @type {[string, string]} */ [text, kind]) => {
      const made = element("li", "", {className: kind}), away = element("button", "×", {type: "button", className: "plain"})
      away.setAttribute("aria-label", `Put away: ${text.slice(0, 60)}`)
      away.onclick = () => { this.dismissed.add(text); made.remove() }
      const said = element("span", text)
      if (kind !== "info") said.setAttribute("role", "alert")
      made.append(said, away)
      return made
    }
    const grave = shown.filter(([, kind]) => kind !== "info")
    const others = shown.filter(([, kind]) => kind === "info")
    const parts = grave.map(item)
    if (others.length) {
      const fold = element("details", ""), list = element("ul", "")
      const head = element("summary", others.length === 1 ? "1 note on this answer" : `${others.length} notes on this answer`)
      list.append(...others.map(item))
      fold.append(head, list)
      fold.open = this.unfolded
      fold.ontoggle = () => { this.unfolded = fold.open }
      const whole = element("li", "")
      whole.append(fold)
      parts.push(whole)
    }
    box.replaceChildren(...parts)
  }
}
