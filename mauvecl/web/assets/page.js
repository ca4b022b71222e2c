// @ts-check
// The page sends the entered text to the server, and only shows the answer to it.

import {Card} from "./card.js"
import {Columns} from "./columns.js"
import {Compare} from "./compare.js"
import {byId, every} from "./dom.js"
import {Export, give} from "./export.js"
import {Fields} from "./fields.js"
import {lacks, offer} from "./offers.js"
import {Pictures} from "./pictures.js"
import {Live} from "./protocol.js"
import {Routing} from "./routing.js"
import {Simulations} from "./simulations.js"
import {Uploads} from "./uploads.js"

/** @typedef {import("./protocol.js").Answer} Answer */
/** @typedef {import("./protocol.js").Entered} Entered */
/** @typedef {import("./protocol.js").Faults} Faults */
/** @typedef {import("./protocol.js").Message} Message */
/** @typedef {import("./protocol.js").Words} Words */

/** @type {Words} */
const words = JSON.parse(byId("words").textContent)
//: Milliseconds without a change after which one exposure is drawn.
const DRAW_MS = 500
//: Milliseconds without a change after which the limits are computed.
const SOLVE_MS = 300
//: Tabs that show a drawn exposure.
const DRAWN = new Set(["detection", "spectrum"])

class Page {
  constructor() {
    /** @type {Answer | null} */
    this.answer = null
    this.asking = this.dirty = this.history = false
    // The simulation that answers an example, once its file is read.
    this.tried = ""
    /** Table of the tab in front.
     * @type {string[][]} */
    this.rows = []
    this.card = new Card()
    this.fields = new Fields(words, (name, last, other) => {
      // A changed question cancels the wait for a file.
      if (other) this.tried = ""
      if (other) this.uploads.forget([name])
      if (other) this.uploads.changed(name, last)
      this.changed(last, other)
    }, (field, file) => {
      this.tried = ""
      this.uploads.choose(field, file)
    })
    this.routing = new Routing(words, this.fields.entered, () => this.moved(), () => { this.front(); this.ask() })
    this.live = new Live(version => this.back(version), code => this.lost(code))
    const refused = (/** @type {string} */ why) => this.card.notices([[why, "notice"]])
    this.simulations = new Simulations(this.live, this.routing, this.card, {
      question: kind => this.asked(words.asks[kind]), ready: () => this.answer !== null, offer: () => this.offer(),
      lacks: kind => lacks(kind, this.fields.entered, words.needs) ? "a field that it needs is empty" : "",
      ended: () => this.simulated(), refused,
    })
    this.uploads = new Uploads(words, this.fields, this.live, {
      changed: last => this.changed(last, true), none: () => this.none(this.uploads.lacks), again: () => this.ask(),
      link: () => this.routing.link,
    })
    this.columns = new Columns(this.live, this.uploads)
    this.export = new Export(this.live, this.routing, () => this.offer(), refused)
    this.pictures = new Pictures(words, given => this.enter(given), give, () => this.about())
    this.pins = new Map()
    this.compare = new Compare(words.pins, link => { this.follow(link); this.changed(true, true) }, () => this.pinned())
    this.wire()
    this.follow(window.location.search)
  }

  // The question alone, independent of the view.
  get question() {
    return JSON.stringify(this.fields.entered)
  }

  /** What is entered in some fields, and which files stand in them.
   * @param {string[]} names */
  asked(names) {
    const entered = Object.fromEntries(names.map(name => [name, this.fields.entered[name]]))
    return JSON.stringify([entered, this.uploads.of(entered)])
  }

  get tab() {
    return words.tabs[this.routing.seen.tab]
  }

  /** @param {string} link */
  follow(link) {
    this.routing.follow(link)
    this.fields.show()
    this.front()
  }

  // The tab in front shows the fields on which it depends.
  front() {
    const {reads, chance} = this.tab
    this.fields.front(reads)
    this.card.front(chance)
    for (const form of every("[data-form]")) {
      form.hidden = !reads.includes(form.dataset.form)
      if (!form.hidden) byId(`panel-${this.routing.seen.tab}`).querySelector(".about").after(form)
    }
    if (this.simulations.running === null) this.simulations.place()
  }

  // The browser's history has led to another question or tab.
  moved() {
    this.follow(window.location.search)
    this.simulations.changed()
    this.simulations.wanted = this.routing.simulated
    this.simulations.stop()
    this.discardAnswer()
    this.ask()
  }

  /** A field was changed.
   * @param {boolean} last whether the change has ended
   * @param {boolean} other whether the question is another */
  changed(last, other) {
    if (other) {
      this.routing.seen.simulated = ""
      this.simulations.changed()
      this.discardAnswer()
      this.ask()
      this.routing.step(last)
    } else if (last) {
      this.routing.editing = false
      // The star is chosen after the answer to its name has come: ask again for what is known of it.
      if (this.fields.fresh) this.ask()
    }
  }

  /** @param {Entered} given */
  enter(given) {
    this.uploads.forget(Object.keys(given))
    this.fields.put(given)
    this.changed(true, true)
  }

  // The answer

  // The previous answer is invalid until there is one to these fields.
  discardAnswer() {
    this.answer = null
    // A simulation without an answer is not a run of the next question.
    this.history = false
    clearTimeout(this.soon)
    clearTimeout(this.later)
    this.card.fade()
    this.offer()
  }

  /** The entered text has no answer.
   * @param {Faults} faults
   * @param {string} [refused] */
  none(faults, refused) {
    this.discardAnswer()
    document.title = "No answer: mauvecl"
    this.fields.tell(faults)
    this.card.none(refused ?? Object.entries(faults).map(([name, why]) => this.fields.said(name, why)).join("; "))
  }

  /** @param {Answer} answer */
  tell(answer) {
    this.answer = answer
    this.card.tell(answer)
    this.routing.seen.simulated = answer.simulated.join(",")
    this.routing.show(false)
    document.title = `${answer.shown}: mauvecl`
    this.offer()
    if (this.history) {
      this.history = false
      this.compare.ran({...this.scenario(), at: new Date().toLocaleTimeString()})
    }
    clearTimeout(this.later)
    if (answer.chance) this.later = setTimeout(() => this.solve(), SOLVE_MS)
    if (this.tried && !lacks(this.tried, this.fields.entered, words.needs)) {
      this.simulations.press(this.tried)
      this.tried = ""
    } else this.simulations.next(answer.simulated)
  }

  ask() {
    if (this.asking) {
      this.dirty = true
      return
    }
    if (!this.live.open) return
    if (Object.keys(this.uploads.lacks).length) {
      this.none(this.uploads.lacks)
      return
    }
    this.asking = true
    this.dirty = false
    const question = this.question
    const {link, stray, seen} = this.routing
    const n = this.live.ask("answer", {link: link + (stray ? `&${stray}` : ""), tab: seen.tab}, message => {
      if (message.pictures) {
        this.live.done(n)
        if (question === this.question) this.draw(message)
        return
      }
      this.asking = false
      if (this.dirty || question !== this.question) {
        this.ask()
        return
      }
      this.show(message)
    })
  }

  /** @param {Message} message */
  show(message) {
    const question = this.question
    this.fields.tell(message.faults)
    this.columns.tell(message.faults)
    this.fields.facts(message.known, (given, fills) => {
      // What is filled in belongs to the same step of the history as the star.
      if (fills) this.routing.editing = true
      this.enter(given)
    })
    // What was filled in made it another question, which has been asked; this answer is not shown.
    if (question !== this.question) return
    // Without an answer the notes of the last one keep their room, unseen: nothing jumps while a number is typed.
    /** @type {[string, string][]} */
    const stray = message.stray ? [[message.stray, "notice"]] : []
    if (message.answer || message.stray) this.card.notices([...stray, ...(message.answer?.notes ?? [])])
    if (message.answer) this.tell(message.answer)
    else this.none(message.faults, message.refused)
  }

  /** @param {Message} message */
  async draw(message) {
    this.rows = message.rows
    this.card.rows(message.tab, message.rows)
    this.pinned()
    await this.pictures.put(message.pictures)
    if (this.answer === null) return
    this.card.fresh(message.tab)
    clearTimeout(this.soon)
    if (DRAWN.has(message.tab) && !message.draws) this.soon = setTimeout(() => this.drawOne(), DRAW_MS)
  }

  // Pinned scenarios in the pictures of this tab; their data are requested once.
  pinned() {
    const name = this.routing.seen.tab, tab = words.tabs[name]
    // A pinned upload is drawn as long as it is the one that is here.
    const pins = this.compare.drawn.map(pin => pin && pin.files === this.uploads.of(pin.entered) ? pin : undefined)
    for (const box of every(".pins")) {
      box.hidden = !pins.some(Boolean)
      box.replaceChildren(box.firstElementChild, ...this.compare.key())
    }
    if (!tab.pictures.some(picture => picture.pins)) return
    for (const pin of pins.filter(Boolean)) {
      const key = `${name} ${pin.link}`
      if (this.pins.has(key) || !this.live.open) continue
      this.pins.set(key, {})
      const n = this.live.ask("pinned", {link: pin.link, tab: name}, message => {
        this.live.done(n)
        this.pins.set(key, message.pins ?? {})
        this.pinned()
      })
    }
    const known = pins.map(pin => pin && {entered: pin.entered, columns: this.pins.get(`${name} ${pin.link}`) ?? {}})
    this.pictures.pin(tab, known, this.fields.entered)
  }

  // What is solved for takes longer than the answer.
  solve() {
    const question = this.question
    const n = this.live.ask("solve", {link: this.routing.link, tab: this.routing.seen.tab}, message => {
      if (message.solved !== undefined) this.live.done(n)
      if (question === this.question && this.answer) this.card.solved(message.solved, message.payloads)
    })
  }

  drawOne() {
    const question = this.question
    const n = this.live.ask("draw", {link: this.routing.link, tab: this.routing.seen.tab}, message => {
      this.live.done(n)
      if (question === this.question && message.tab === this.routing.seen.tab) this.draw({...message, draws: true})
    })
  }

  // Actions that are available now.
  offer() {
    this.uploads.mention()
    offer(this.answer, this.simulations.running !== null, this.fields.entered, words.needs)
  }

  // The answer again, now with what was simulated.
  simulated() {
    this.history = true
    this.card.busy(true)
    this.ask()
  }

  scenario() {
    const {shown, interval, words: said} = this.answer
    /** @type {[string, string][]} */
    const facts = [...this.answer.facts]
    for (const one of this.answer.numbers) facts.push([one.title, one.shown])
    const entered = {...this.fields.entered}
    // Where there is no chance, the table is what is compared.
    const rows = this.tab.chance ? undefined : this.rows
    return {link: this.routing.link, entered, files: this.uploads.of(entered), shown, interval, facts, words: said, rows}
  }

  // What a saved picture says of the question.
  about() {
    const others = Object.entries(this.fields.entered)
      .filter(([name, text]) => text !== words.fields[name] && this.tab.reads.includes(name))
    const entered = others.map(([name, text]) => `${this.fields.label(name)}: ${text}`).join("; ")
    const sentences = [this.answer && `${this.answer.shown} ${this.answer.words}.`, entered && `Entered: ${entered}.`]
    return {sentences: [...sentences.filter(Boolean), `mauvecl ${words.version}`], pins: this.compare.key("light")}
  }

  /** Read an example in place of a visitor's file, without what was entered on an earlier one, and answer it.
   * @param {HTMLElement} button */
  async example(button) {
    const {example, asset} = button.dataset
    const file = new File([await (await fetch(`assets/${asset}`)).blob()], asset)
    const form = every("[data-field]", button.closest(".form")).map(box => box.dataset.field)
    this.enter(Object.fromEntries(form.map(name => [name, words.fields[name]])))
    this.tried = Object.keys(words.needs).find(kind => words.needs[kind] === example) ?? ""
    this.uploads.choose(example, file)
  }

  // The connection

  /** @param {string} version */
  back(version) {
    if (version !== words.version) {
      window.location.reload()
      return
    }
    byId("lost").hidden = true
    for (const part of every("body > :not(#lost)")) part.inert = false
    this.asking = false
    this.pins.clear()
    // What the server knew of this page is gone with the connection; the browser has it all.
    this.simulations.wanted = this.routing.simulated
    this.uploads.resend().then(any => { if (!any) this.ask() })
  }

  /** @param {number} code */
  lost(code) {
    const unused = code === words.unused
    this.simulations.lost()
    this.discardAnswer()
    this.card.ended("")
    byId("lost-message").textContent = unused
      ? "This page was not used for a long time, and the server let it go."
      : "The connection to the server is lost. The page comes back by itself as soon as the server answers."
    byId("lost").hidden = false
    for (const part of every("body > :not(#lost)")) part.inert = true
    byId("go-on").hidden = !unused
    if (unused) byId("go-on").focus()
    else this.live.again()
  }

  wire() {
    byId("pin").onclick = () => {
      this.compare.pin(this.scenario())
      this.card.ended("Pinned: see the tab Compare.")
    }
    for (const number of every("#numbers [data-unknown]")) {
      number.onclick = () => this.enter({unknown: number.dataset.unknown})
    }
    byId("afresh").onclick = () => this.enter({...words.fields})
    byId("preset").onchange = () => {
      const given = words.presets[byId("preset").value]
      if (given) this.enter({...words.fields, ...given})
      byId("preset").value = ""
    }
    for (const button of every("[data-example]")) button.onclick = () => this.example(button)
    byId("go-on").onclick = () => this.live.connect()
    byId("theme").onclick = () => {
      /** @type {Record<string, string | null>} */
      const next = {system: "light", light: "dark", dark: null}
      window.chooseTheme(next[document.documentElement.dataset.chosen])
      const now = document.documentElement.dataset.chosen
      byId("theme").setAttribute("aria-label", `Colours: ${now === "system" ? "as the system has them" : now}`)
    }
    document.querySelector("form").onsubmit = event => event.preventDefault()
    for (const button of every("[data-opens]")) {
      const {opens} = button.dataset
      button.onclick = () => opens === "export" ? this.export.open() : byId(opens).showModal()
    }
    for (const button of every("[data-closes]")) {
      button.onclick = () => button.closest("dialog").close()
    }
    // On a phone the answer is first, and what can be changed is folded.
    const narrow = window.matchMedia("(max-width: 899px)")
    const fold = () => { byId("controls").open = !narrow.matches }
    narrow.addEventListener("change", fold)
    fold()
  }
}

window.page = new Page()
