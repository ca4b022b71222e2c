// The page sends the entered text to the server, and only shows the answer to it.

import {Card} from "./card.js"
import {Compare} from "./compare.js"
import {Fields} from "./fields.js"
import {Live} from "./live.js"
import {Pictures} from "./pictures.js"

const byId = id => document.getElementById(id)
const words = JSON.parse(byId("words").textContent)
//: Milliseconds without a change after which one exposure is drawn.
const DRAW_MS = 500
//: Tabs that show a drawn exposure.
const DRAWN = new Set(["detection", "spectrum"])

class Page {
  constructor() {
    this.seen = {...words.seen}
    this.files = {}
    this.answer = null
    this.faults = {}
    this.lacks = {}
    this.asking = this.dirty = false
    this.running = null
    this.wanted = []
    this.card = new Card()
    this.fields = new Fields(words, (name, last, other) => {
      // A changed question cancels the wait for a file.
      if (other) delete this.lacks[name]
      this.changed(last, other)
    }, (field, file) => this.upload(field, file))
    this.pictures = new Pictures(words, given => this.enter(given), (name, blob) => this.give(name, blob))
    this.pins = new Map()
    this.compare = new Compare(words.pins, link => { this.follow(link); this.changed(true, true) }, () => this.pinned())
    this.wire()
    this.follow(window.location.search)
    this.live = new Live(version => this.back(version), code => this.lost(code))
  }

  // The entered text as the query of a URL.

  get link() {
    const first = {...words.fields, ...words.seen}
    const pairs = Object.entries({...this.fields.entered, ...this.seen})
    return `?${new URLSearchParams(pairs.filter(([name, text]) => text !== "" || first[name] !== ""))}`
  }

  // The question alone, independent of the view.
  get question() {
    return JSON.stringify(this.fields.entered)
  }

  follow(link) {
    const given = new URLSearchParams(link)
    const stray = new URLSearchParams()
    const entered = {...words.fields}
    this.seen = {...words.seen}
    for (const [name, text] of given) {
      if (name in entered) entered[name] = text
      else if (name in this.seen) this.seen[name] = text
      else stray.append(name, text)
    }
    this.stray = stray.toString()
    if (!(this.seen.tab in words.tabs)) {
      this.stray += `&tab=${encodeURIComponent(this.seen.tab)}`
      this.seen.tab = words.seen.tab
    }
    Object.assign(this.fields.entered, entered)
    this.fields.show()
    this.showTab()
  }

  address(push) {
    if (this.link === window.location.search) return
    window.history[push ? "pushState" : "replaceState"]({}, "", window.location.pathname + this.link)
  }

  // A field was changed: `last` is true at the end of a change, `other` if the question changes.
  changed(last, other) {
    if (other) {
      this.seen.simulated = ""
      this.wanted = []
      this.stop()
      this.withdraw()
      this.ask()
    }
    // While something is being chosen the address follows; all of it is one step of the history.
    if (other) {
      this.address(!this.editing)
      this.editing = !last
    } else if (last) this.editing = false
  }

  enter(given) {
    for (const name of Object.keys(given)) delete this.lacks[name]
    this.fields.put(given)
    this.changed(true, true)
  }

  // The answer

  // The previous answer is invalid until there is one to these fields.
  withdraw() {
    this.answer = null
    clearTimeout(this.soon)
    this.card.fade()
    this.offer()
  }

  // The entered text has no answer.
  none(faults, refused) {
    this.withdraw()
    document.title = "No answer: mauvecl"
    this.fields.tell(faults)
    this.card.none(refused ?? Object.entries(faults).map(([name, why]) => `${this.fields.label(name)}: ${why}`).join("; "))
  }

  tell(answer) {
    this.answer = answer
    this.card.tell(answer)
    this.seen.simulated = answer.simulated.join(",")
    this.address(false)
    document.title = `${answer.shown}: mauvecl`
    this.offer()
    this.next()
  }

  ask() {
    if (this.asking) {
      this.dirty = true
      return
    }
    if (!this.live?.open) return
    const lacks = Object.entries(this.lacks)
    if (lacks.length) {
      this.none(this.faults = this.lacks)
      return
    }
    this.asking = true
    this.dirty = false
    const question = this.question
    const n = this.live.ask("answer", {link: this.link + (this.stray ? `&${this.stray}` : ""), tab: this.seen.tab}, message => {
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

  show(message) {
    this.faults = message.faults
    this.fields.tell(message.faults)
    // Without an answer the notes of the last one keep their room, unseen: nothing jumps while a number is typed.
    const stray = message.stray ? [[message.stray, "stray"]] : []
    if (message.answer || message.stray) this.card.notices([...stray, ...(message.answer?.notes ?? [])])
    if (message.answer) this.tell(message.answer)
    else this.none(message.faults, message.refused)
  }

  async draw(message) {
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
    const name = this.seen.tab, tab = words.tabs[name]
    // A pinned upload is drawn as long as it is the one that is here.
    const pins = this.compare.drawn.map(pin => pin && pin.files === this.filesOf(pin.entered) ? pin : undefined)
    for (const box of document.querySelectorAll(".pins")) {
      box.hidden = !pins.some(Boolean)
      box.replaceChildren(box.firstElementChild, ...this.compare.key())
    }
    if (!tab.pictures.some(picture => picture.pins)) return
    for (const pin of pins.filter(Boolean)) {
      const key = `${name} ${pin.link}`
      if (this.pins.has(key) || !this.live?.open) continue
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

  drawOne() {
    const question = this.question
    const n = this.live.ask("draw", {link: this.link, tab: this.seen.tab}, message => {
      this.live.done(n)
      if (question === this.question && message.tab === this.seen.tab) this.draw({...message, draws: true})
    })
  }

  // Actions that are available now.
  offer() {
    const ready = this.answer !== null
    const busy = this.running !== null
    const simulated = new Set(this.answer?.simulated ?? [])
    byId("simulate").disabled = !ready || busy
    byId("cancel").disabled = !busy
    byId("pin").disabled = !ready
    byId("study").disabled = !ready
    for (const button of document.querySelectorAll("[data-simulate]")) {
      const lacks = ["visible", "plan"].includes(button.dataset.simulate) && !this.fields.entered.see.trim()
      button.disabled = !ready || busy || lacks
    }
    for (const tab of Object.values(words.tabs)) {
      for (const [name, needs] of Object.entries(tab.files)) {
        for (const button of document.querySelectorAll(`[data-file="${name}"]`)) {
          button.disabled = !ready || (needs !== null && !simulated.has(needs))
        }
      }
    }
    for (const hint of document.querySelectorAll("[data-needs]")) {
      const lacking = hint.dataset.needs.split(" ").filter(kind => !simulated.has(kind))
      const buttons = lacking.map(kind => document.querySelector(`[data-simulate="${kind}"]`) ?? byId("simulate"))
      hint.textContent = lacking.length ? `after ${buttons.map(button => button.textContent).join(", ")}` : ""
    }
  }

  // Simulations

  simulate(kind) {
    if (this.running !== null || this.answer === null) return
    const question = this.question
    this.card.progress(0, "waiting for its turn")
    const n = this.running = this.live.ask("simulate", {kind, link: this.link}, message => {
      if (message.ended === undefined) {
        this.card.progress(message.progress, message.message)
        return
      }
      this.live.done(n)
      this.running = null
      this.card.ended(message.ended)
      this.offer()
      if (question !== this.question) return
      if (message.refused) this.card.notices([[message.refused, "danger"]])
      else if (message.kind) this.simulated()
    })
    this.offer()
  }

  // The answer again, now with what was simulated.
  simulated() {
    this.history = true
    this.card.busy(true)
    this.ask()
  }

  next() {
    if (this.history) {
      this.history = false
      this.compare.ran({...this.scenario(), at: new Date().toLocaleTimeString()})
    }
    this.wanted = this.wanted.filter(kind => !this.answer.simulated.includes(kind))
    if (this.wanted.length && this.running === null) this.simulate(this.wanted.shift())
  }

  stop() {
    if (this.running !== null) this.live.ask("cancel", {})
  }

  scenario() {
    const {shown, interval, facts, words: said} = this.answer
    const entered = {...this.fields.entered}
    return {link: this.link, entered, files: this.filesOf(entered), shown, interval, facts, words: said}
  }

  // Which files stand in fields.
  filesOf(entered) {
    const uploads = Object.entries(words.uploads).filter(([field, text]) => entered[field] === text)
    return uploads.map(([field]) => this.files[field]?.at ?? "gone").join()
  }

  // Files to the server and from it

  async upload(field, file) {
    this.fields.put({[field]: ""})
    delete this.files[field]
    this.lacks[field] = `${file.name} is being read`
    this.changed(false, true)
    this.none(this.lacks)
    if (file.size > words.most_uploaded) {
      const MiB = 2 ** 20
      this.lack(field, `upload of ${(file.size / MiB).toFixed(1)} MiB, expected at most ${words.most_uploaded / MiB} MiB`)
      return
    }
    const content = await file.arrayBuffer()
    this.send(field, file.name, content)
  }

  // The browser keeps the file: a server that has lost it gets it again.
  send(field, name, content) {
    const serial = this.serial = (this.serial ?? 0) + 1
    const n = this.live.ask("upload", {field, name}, message => {
      this.live.done(n)
      if (serial !== this.serial && field === this.field) return
      if (message.lacks) {
        if (field in this.lacks) this.lack(field, message.lacks)
        return
      }
      this.files[field] = {at: Date.now(), ...this.files[field], name, content}
      if (!(field in this.lacks)) return
      delete this.lacks[field]
      if (this.fields.entered[field] === message.entered) {
        // Sent again: the same question, and what was simulated for it.
        this.ask()
        return
      }
      this.fields.put({[field]: message.entered})
      this.changed(true, true)
    })
    this.field = field
    this.live.send(content)
  }

  lack(field, why) {
    this.lacks[field] = why
    this.none(this.lacks)
  }

  give(name, content) {
    const link = document.createElement("a")
    link.href = URL.createObjectURL(content instanceof Blob ? content : new Blob([content]))
    link.download = name
    link.click()
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000)
  }

  take(tab, name, ending, button) {
    button.disabled = true
    const n = this.live.ask("file", {link: this.link, tab, name, ending}, (message, content) => {
      this.live.done(n)
      this.offer()
      if (message.refused) this.card.notices([[message.refused, "danger"]])
      else this.give(message.file, content)
    })
  }

  export() {
    const n = this.live.ask("export", {link: this.link}, message => {
      this.live.done(n)
      byId("as-command").textContent = message.refused ?? message.command
      byId("as-python").textContent = message.refused ?? message.python
      byId("export").showModal()
    })
  }

  // Tabs

  showTab() {
    for (const name of Object.keys(words.tabs)) {
      const front = name === this.seen.tab
      const tab = byId(`tab-${name}`)
      tab.setAttribute("aria-selected", String(front))
      tab.tabIndex = front ? 0 : -1
      byId(`panel-${name}`).hidden = !front
    }
  }

  toTab(name) {
    if (name === this.seen.tab) return
    this.seen.tab = name
    this.showTab()
    this.address(true)
    this.editing = false
    this.ask()
  }

  // The connection

  back(version) {
    if (version !== words.version) {
      window.location.reload()
      return
    }
    byId("lost").hidden = true
    for (const part of document.body.children) if (part.id !== "lost") part.inert = false
    this.asking = false
    this.pins.clear()
    // What the server knew of this page is gone with the connection; the browser has it all.
    const kept = Object.entries(this.files).filter(([field]) => this.fields.entered[field] === words.uploads[field])
    this.wanted = this.seen.simulated.split(",").filter(Boolean)
    for (const [field, {name, content}] of kept) {
      this.lacks[field] = `${name} is being read`
      this.send(field, name, content)
    }
    if (!kept.length) this.ask()
  }

  lost(code) {
    const unused = code === words.unused
    this.running = null
    this.withdraw()
    this.card.ended("")
    byId("lost-message").textContent = unused
      ? "This page was not used for a long time, and the server let it go."
      : "The connection to the server is lost. The page comes back by itself as soon as the server answers."
    byId("lost").hidden = false
    for (const part of document.body.children) if (part.id !== "lost") part.inert = true
    byId("go-on").hidden = !unused
    if (unused) byId("go-on").focus()
    else this.live.again()
  }

  wire() {
    byId("simulate").onclick = () => this.simulate("detection")
    byId("cancel").onclick = () => { this.wanted = []; this.stop() }
    byId("pin").onclick = () => {
      this.compare.pin(this.scenario())
      this.card.ended("Pinned: see the tab Compare.")
    }
    byId("afresh").onclick = () => this.enter({...words.fields})
    byId("preset").onchange = event => {
      const given = words.presets[event.target.value]
      if (given) this.enter({...words.fields, ...given})
      event.target.value = ""
    }
    byId("study").onclick = event => this.take("", "study", "study", event.target)
    byId("go-on").onclick = () => this.live.connect()
    byId("theme").onclick = () => {
      const next = {system: "light", light: "dark", dark: null}
      window.chooseTheme(next[document.documentElement.dataset.chosen])
      const now = document.documentElement.dataset.chosen
      byId("theme").setAttribute("aria-label", `Colours: ${now === "system" ? "as the system has them" : now}`)
    }
    document.querySelector("form").onsubmit = event => event.preventDefault()
    for (const button of document.querySelectorAll("[data-simulate]")) {
      button.onclick = () => this.simulate(button.dataset.simulate)
    }
    for (const button of document.querySelectorAll("[data-file]")) {
      const tab = button.closest("[role=tabpanel]").id.replace("panel-", "")
      button.onclick = () => this.take(tab, button.dataset.file, button.dataset.ending, button)
    }
    for (const button of document.querySelectorAll("[data-opens]")) {
      button.onclick = () => button.dataset.opens === "export" ? this.export() : byId(button.dataset.opens).showModal()
    }
    for (const button of document.querySelectorAll("[data-closes]")) {
      button.onclick = () => button.closest("dialog").close()
    }
    for (const button of document.querySelectorAll("[data-copy]")) {
      button.onclick = async () => {
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
    }
    const names = Object.keys(words.tabs)
    for (const name of names) {
      byId(`tab-${name}`).onclick = () => this.toTab(name)
      byId(`tab-${name}`).onkeydown = event => {
        const at = names.indexOf(name)
        const next = {
          ArrowRight: (at + 1) % names.length, ArrowLeft: (at + names.length - 1) % names.length,
          Home: 0, End: names.length - 1,
        }[event.key]
        if (next === undefined) return
        event.preventDefault()
        byId(`tab-${names[next]}`).focus()
        this.toTab(names[next])
      }
    }
    window.addEventListener("popstate", () => {
      this.follow(window.location.search)
      this.wanted = this.seen.simulated.split(",").filter(Boolean)
      this.editing = false
      this.stop()
      this.withdraw()
      this.ask()
    })
    // On a phone the answer is first, and what can be changed is folded.
    const narrow = window.matchMedia("(max-width: 899px)")
    const fold = () => { byId("controls").open = !narrow.matches }
    narrow.addEventListener("change", fold)
    fold()
  }
}

window.page = new Page()
