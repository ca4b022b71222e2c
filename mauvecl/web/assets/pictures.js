// @ts-check
// The pictures of a tab: empty figures that are fetched once for each theme, and data that come with every answer.

import {byId, every} from "./dom.js"

/** @typedef {import("./protocol.js").Columns} Columns */
/** @typedef {import("./protocol.js").Drawn} Drawn */
/** @typedef {import("./protocol.js").Entered} Entered */
/** @typedef {import("./protocol.js").PictureWords} PictureWords */
/** @typedef {import("./protocol.js").Words} Words */

const coarse = window.matchMedia("(pointer: coarse)").matches

/** Numbers as they are sent: base64 of 32-bit floats.
 * @param {Columns[string]} column */
function unpacked(column) {
  if (Array.isArray(column)) return column
  const bytes = Uint8Array.from(atob(column.f4), c => c.charCodeAt(0))
  const values = new Float32Array(bytes.buffer)
  if (column.shape.length === 1) return values
  const {ndarray} = Bokeh.require("core/util/ndarray")
  return [ndarray(values, {dtype: "float32", shape: column.shape.slice(1)})]
}

const line = (/** @type {string} */ colour, /** @type {string} */ dashes) => `<path d="M0 5h22" stroke="${colour}" stroke-width="2.5" stroke-dasharray="${dashes}"/>`
const swatch = (/** @type {string} */ shape) =>
  `<svg aria-hidden="true" class="swatch" viewBox="0 0 22 10">${shape}</svg>`
/** How a line is drawn, small.
 * @param {[string, string]} look colour and dashes */
export const dashed = look => swatch(line(...look))

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
    /** BokehJS's view of the figure, and its model.
     * @type {any} */
    this.view = null
    /** @type {any} */
    this.plot = null
    /** Models by name.
     * @type {Map<string, any> | null} */
    this.models = null
    this.frame = byId(`figure-${name}`)
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
    this.frame.querySelector("[data-reset]").addEventListener("click", () => {
      for (const range of [this.plot?.x_range, this.plot?.y_range]) range?.reset()
    })
    for (const button of every("[data-save]", this.frame)) {
      button.addEventListener("click", () => this.save(button.dataset.save))
    }
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
    return this.draw()
  }

  async draw() {
    const wanted = `${document.documentElement.dataset.theme} ${[...this.logs].sort().join("")}`
    if (this.made !== wanted) {
      this.made = wanted
      await this.make(wanted)
    }
    if (this.made === wanted && this.models && this.drawn) this.fill()
  }

  /** @param {string} wanted theme and logarithmic axes */
  async make(wanted) {
    const [theme, logs] = wanted.split(" ")
    const answer = await fetch(`figures/${theme}/${this.name}.json?log=${logs}&v=${this.pictures.version}`)
    const {item, legend} = await answer.json()
    if (this.made !== wanted) return
    const box = byId(`plot-${this.name}`)
    this.view?.remove()
    box.replaceChildren()
    const views = await Bokeh.embed.embed_item(item, box.id)
    const [view] = views
    this.view = view
    this.plot = view.model
    this.models = new Map()
    for (const model of view.model.references()) {
      if (model.name && model.type !== "GlyphRenderer") this.models.set(model.name, model)
    }
    this.legend(legend)
    if (coarse) for (const tool of this.plot.toolbar.tools) if ("active" in tool) tool.active = tool.type === "HoverTool"
    const range = this.models.get("wavelength")
    if (range) this.pictures.link(range)
    if (this.sets) this.plot.on_event("tap", (/** @type {any} */ event) => this.pictures.clicked(this.sets, event))
    this.reveal()
  }

  fill() {
    for (const [name, columns] of Object.entries(this.drawn.sources)) this.columns(name, columns)
    if (this.pins) {
      /** @type {Columns} */
      const none = {}
      for (const column of Object.keys(this.drawn.sources[this.pins])) none[column] = []
      for (const slot of this.pictures.slots.keys()) this.columns(`pin ${slot}`, this.pinned[slot] ?? none)
    }
    for (const [name, props] of Object.entries(this.drawn.props)) this.models.get(name).setv(props)
    this.some()
  }

  /**
   * @param {string} name
   * @param {Columns} columns
   */
  columns(name, columns) {
    /** @type {Record<string, any>} */
    const data = {}
    for (const [column, values] of Object.entries(columns)) data[column] = unpacked(values)
    this.models.get(name).data = data
  }

  /** Pinned scenarios by slot: columns of each, or nothing.
   * @param {(Columns | null)[]} pinned */
  pin(pinned) {
    const same = pinned.every((columns, slot) => columns === (this.pinned[slot] ?? null))
    this.pinned = pinned
    if (!same && this.models && this.drawn) this.fill()
  }

  // Show the requested parts, and the marks that all pictures share.
  reveal() {
    if (!this.plot) return
    for (const model of this.plot.references()) {
      const [tag] = model.tags ?? []
      if (tag) model.visible = this.wanted.has(tag) || this.pictures.marks.has(tag)
    }
    this.some()
  }

  /** @param {[string, string, string, string][]} entries */
  legend(entries) {
    const svg = (/** @type {string} */ colour, /** @type {string} */ form) => {
      /** @type {Record<string, string>} */
      const shapes = {
        line: line(colour, "none"),
        dash: line(colour, "4 3"),
        band: `<rect width="22" height="10" fill="${colour}" fill-opacity=".4"/>`,
        bars: `<rect width="22" height="10" fill="${colour}" fill-opacity=".5"/>`,
        bar: `<rect width="22" height="10" fill="${colour}"/>`,
        dot: `<circle cx="11" cy="5" r="4" fill="${colour}"/>`,
      }
      return swatch(shapes[form])
    }
    this.frame.querySelector(".legend").replaceChildren(...entries.map(([called, colour, form, show]) => {
      const item = document.createElement("li")
      item.innerHTML = svg(colour, form)
      item.append(called)
      item.dataset.shows = show
      item.dataset.called = called
      return item
    }))
    this.some()
  }

  // The legend holds what is there to be seen; what is not there yet has its room, so that nothing jumps.
  some() {
    const empty = new Set()
    for (const renderer of this.plot?.renderers ?? []) {
      const source = renderer.data_source
      if (source && renderer.name && source.get_length() === 0) empty.add(renderer.name)
    }
    for (const item of every(".legend li", this.frame)) {
      const {shows, called} = item.dataset
      item.hidden = shows !== "" && shows !== "if any" && !this.wanted.has(shows)
      item.classList.toggle("absent", empty.has(called))
    }
  }

  /** @param {string} ending */
  async save(ending) {
    if (!this.view) return
    const blob = await this.view.export(ending).to_blob()
    this.pictures.give(`mauvecl-${this.name}.${ending}`, blob)
  }
}

export class Pictures {
  /**
   * @param {Words} words
   * @param {(given: Entered) => void} set enter the fields that a click on a picture sets
   * @param {(name: string, content: Blob) => void} give save a file
   */
  constructor(words, set, give) {
    this.version = words.version
    this.give = give
    this.set = set
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
      for (const picture of Object.values(this.all)) if (picture.made) picture.draw()
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
