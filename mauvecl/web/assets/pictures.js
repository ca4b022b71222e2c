// @ts-check
// The pictures of a tab: empty figures that are fetched once for each theme, and data that come with every answer.

import {byId, every} from "./dom.js"
import {Figure, isEmpty} from "./figure.js"
import {items, rename} from "./legend.js"
import {pictureFile} from "./picture-files.js"
import {tables} from "./picture-table.js"

/** @typedef {import("./protocol.js").Columns} Columns */
/** @typedef {import("./protocol.js").Drawn} Drawn */
/** @typedef {import("./protocol.js").Entered} Entered */
/** @typedef {import("./protocol.js").PictureWords} PictureWords */
/** @typedef {import("./protocol.js").Words} Words */

class Picture {
  /**
   * @param {Pictures} pictures
   * @param {PictureWords} words
   */
  constructor(pictures, {name, sets, logs, pins}) {
    this.pictures = pictures
    this.name = name
    this.sets = sets
    this.pins = pins
    /** @type {Figure | null} */
    this.figure = null
    this.frame = byId(`figure-${name}`)
    this.box = byId(`plot-${name}`)
    this.logs = new Set(logs.filter(axis => axis !== axis.toLowerCase()).map(axis => axis.toLowerCase()))
    this.wanted = new Set([""])
    /** Theme and logarithmic axes of the figure that is here, or comes.
     * @type {string | null} */
    this.made = null
    /** @type {Drawn | null} */
    this.drawn = null
    /** @type {(Columns | null)[]} */
    this.pinned = []
    for (const box of every("[data-log]", this.frame)) {
      box.addEventListener("change", () => {
        this.logs[box.checked ? "add" : "delete"](box.dataset.log)
        this.made = null
        this.draw()
      })
    }
    for (const box of every("[data-show]", this.frame)) {
      box.addEventListener("change", () => this.want(box.dataset.show, box.checked))
    }
    this.frame.querySelector("[data-reset]").addEventListener("click", () => this.figure?.reset())
    for (const button of every("[data-save]", this.frame)) {
      button.addEventListener("click", () => this.save(button.dataset.save))
    }
    const [data] = every("details.data", this.frame)
    data.addEventListener("toggle", () => this.tabulate())
    this.box.addEventListener("focusin", () => this.figure?.wheel(true))
    this.box.addEventListener("focusout", () => this.figure?.wheel(false))
    this.box.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      if (event.ctrlKey || event.altKey || event.metaKey || !this.figure?.press(event.key)) return
      event.preventDefault()
    })
  }

  /**
   * @param {string} tag
   * @param {boolean} wanted
   */
  want(tag, wanted) {
    this.wanted[wanted ? "add" : "delete"](tag)
    this.reveal()
  }

  /** New data; they are drawn when there is a figure.
   * @param {Drawn} drawn */
  put(drawn) {
    this.drawn = drawn
    this.frame.querySelector("figcaption p").textContent = drawn.text
    this.tabulate()
    return this.draw()
  }

  async draw() {
    if (!this.drawn) return
    const wanted = `${document.documentElement.dataset.theme} ${this.logged}`
    const empty = isEmpty(this.drawn)
    this.box.classList.toggle("nothing", empty)
    for (const button of every(".tools button", this.frame)) button.disabled = empty
    if (empty) {
      // How to have it drawn is said below.
      this.made = null
      this.figure?.remove()
      this.figure = null
      this.box.replaceChildren()
    } else if (this.made !== wanted) {
      this.made = wanted
      await this.make(wanted)
    } else if (this.figure) this.fill()
  }

  get logged() {
    return [...this.logs].sort().join("")
  }

  /** The figure in a theme, with its legend.
   * @param {string} theme */
  async fetched(theme) {
    const answer = await fetch(`figures/${theme}/${this.name}.json?log=${this.logged}&v=${this.pictures.version}`)
    const {item, legend} = await answer.json()
    return {figure: new Figure(item, this.pins), entries: items(legend)}
  }

  /** @param {string} wanted theme and logarithmic axes */
  async make(wanted) {
    const {figure, entries} = await this.fetched(wanted.split(" ")[0])
    if (this.made !== wanted) return
    this.figure?.remove()
    this.box.replaceChildren()
    this.figure = figure
    this.frame.querySelector(".legend").replaceChildren(...entries)
    const range = figure.models.get("wavelength")
    if (range) this.pictures.link(range)
    if (this.sets) figure.plot.on_event("tap", (/** @type {any} */ event) => this.pictures.clicked(this.sets, event))
    figure.reveal(this.shown)
    this.fill()
    await figure.mount(this.box)
  }

  fill() {
    this.figure.fill(this.drawn, this.pinned, this.pictures.slots.length)
    rename(every(".legend li", this.frame), this.drawn.names)
    this.some()
  }

  /** Pinned scenarios by slot: columns of each, or nothing.
   * @param {(Columns | null)[]} pinned */
  pin(pinned) {
    const same = pinned.every((columns, slot) => columns === (this.pinned[slot] ?? null))
    this.pinned = pinned
    if (!same && this.figure && this.drawn) this.fill()
  }

  /** Tags of the parts that are shown: those of this picture, and the marks that all of them share. */
  get shown() {
    return new Set([...this.wanted, ...this.pictures.marks])
  }

  reveal() {
    this.figure?.reveal(this.shown)
    this.some()
  }

  // The legend holds what is there to be seen. What is not there yet keeps its room at the end of the legend, and
  // stays at the end when it comes, so that the lines of the legend break at the same entries and nothing jumps.
  some() {
    const empty = new Set(this.figure?.empty ?? [])
    for (const item of every(".legend li", this.frame)) {
      const {shows, called} = item.dataset
      item.hidden = shows !== "" && shows !== "if any" && !this.wanted.has(shows)
      const absent = item.classList.toggle("absent", empty.has(called))
      if (absent) item.classList.add("late")
    }
  }

  // The data as tables, if they are open.
  tabulate() {
    const [data] = every("details.data", this.frame)
    if (!data.open) return
    const axis = (/** @type {string} */ of) => this.figure?.models.get(`${of} axis`)?.axis_label ?? of
    const [x, y] = [axis("x"), axis("y")]
    data.querySelector("div").replaceChildren(...this.drawn ? tables(this.drawn, {x, y, low: `${y}, low`, high: `${y}, high`}) : [])
  }

  /** @param {string} ending */
  async save(ending) {
    if (!this.drawn || !this.figure) return
    const {figure, entries} = await this.fetched("light")
    figure.reveal(this.shown)
    figure.fill(this.drawn, this.pinned, this.pictures.slots.length)
    for (const range of ["x_range", "y_range"]) {
      const {start, end} = this.figure.plot[range]
      if (this.figure.plot[range].type !== "FactorRange") figure.plot[range].setv({start, end})
    }
    const here = every(".legend li", this.frame)
    const {sentences, pins} = this.pictures.about()
    const legend = entries.filter((_, k) => !here[k].hidden && !here[k].classList.contains("absent"))
    rename(legend, this.drawn.names)
    if (this.pins && this.pictures.marks.has("pins")) legend.push(...pins)
    const [title] = every("h3", this.frame)
    const blob = await pictureFile(ending, figure, title.textContent, legend, [this.drawn.text, ...sentences])
    this.pictures.give(`mauvecl-${this.name}.${ending}`, blob)
  }
}

export class Pictures {
  /**
   * @param {Words} words
   * @param {(given: Entered) => void} set enter the fields that a click on a picture sets
   * @param {(name: string, content: Blob) => void} give save a file
   * @param {() => {sentences: string[], pins: Element[]}} about what was asked, in sentences, and the key of what is pinned
   */
  constructor(words, set, give, about) {
    this.version = words.version
    this.give = give
    this.set = set
    this.about = about
    this.marks = new Set(["marks", "pins"])
    this.slots = words.pins.light
    /** @type {Set<any>} */
    this.ranges = new Set()
    /** @type {{start: number, end: number} | null} */
    this.shown = null
    /** @type {Record<string, Picture>} */
    this.all = {}
    for (const tab of Object.values(words.tabs)) {
      for (const picture of tab.pictures) this.all[picture.name] = new Picture(this, picture)
    }
    for (const box of every("[data-marks]")) {
      box.addEventListener("change", () => {
        this.marks[box.checked ? "add" : "delete"](box.dataset.marks)
        for (const other of every(`[data-marks="${box.dataset.marks}"]`)) other.checked = box.checked
        for (const picture of Object.values(this.all)) picture.reveal()
      })
    }
    window.addEventListener("mauvecl-theme", () => {
      for (const picture of Object.values(this.all)) picture.draw()
    })
  }

  /** @param {Record<string, Drawn>} pictures */
  put(pictures) {
    return Promise.all(Object.entries(pictures).map(([name, drawn]) => this.all[name].put(drawn)))
  }

  /** Pinned scenarios by slot: the entered text of each, and columns for each picture.
   * @param {Words["tabs"][string]} tab
   * @param {({entered: Entered, columns: Record<string, Columns>} | undefined)[]} pinned
   * @param {Entered} entered */
  pin(tab, pinned, entered) {
    for (const {name, pins, alike} of tab.pictures) {
      if (!pins) continue
      const fits = (/** @type {typeof pinned[0]} */ one) => one && alike.every(field => one.entered[field] === entered[field])
      this.all[name].pin(pinned.map(one => (fits(one) ? one.columns[name] : null) ?? null))
    }
  }

  /** All pictures over wavelengths show the same ones.
   * @param {any} range */
  link(range) {
    if (this.shown) range.setv(this.shown)
    this.ranges.add(range)
    range.change.connect(() => {
      const {start, end} = range
      if (this.shown && this.shown.start === start && this.shown.end === end) return
      this.shown = {start, end}
      for (const other of this.ranges) if (other !== range) other.setv(this.shown)
    })
  }

  /** "magnitude=x,amplitude_percent=10^y": which fields a click sets, to three digits.
   * @param {string} sets
   * @param {{x: number, y: number}} at */
  clicked(sets, {x, y}) {
    /** @type {Entered} */
    const given = {}
    for (const part of sets.split(",")) {
      const [name, axis] = part.split("=")
      const value = axis === "x" ? x : axis === "y" ? y : 10 ** y
      given[name] = name === "magnitude" ? value.toFixed(2).replace(/\.?0+$/, "") : String(Number(value.toPrecision(3)))
    }
    this.set(given)
  }
}
