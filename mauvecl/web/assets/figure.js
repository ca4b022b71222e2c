// @ts-check
// A figure of BokehJS. It is filled before it is drawn: without data its ranges are unknown, of which BokehJS warns.

import {element} from "./dom.js"

/** @typedef {import("./protocol.js").Columns} Columns */
/** @typedef {import("./protocol.js").Drawn} Drawn */

const coarse = window.matchMedia("(pointer: coarse)").matches
//: Share of an axis by which a key moves it, and factor by which a key zooms.
const STEP = 0.1, ZOOM = 0.8

Bokeh.require("core/logging").logger.set_level("warn")

/** Numbers as they are sent: base64 of 32-bit floats.
 * @param {Columns[string]} column
 * @returns {any[] | Float32Array} */
export function flat(column) {
  if (Array.isArray(column)) return column
  const bytes = Uint8Array.from(atob(column.f4), c => c.charCodeAt(0))
  return new Float32Array(bytes.buffer)
}

/** Numbers as BokehJS takes them: an image is one entry.
 * @param {Columns[string]} column */
function unpacked(column) {
  const values = flat(column)
  if (Array.isArray(column) || column.shape.length === 1) return values
  const {ndarray} = Bokeh.require("core/util/ndarray")
  return [ndarray(values, {dtype: "float32", shape: column.shape.slice(1)})]
}

/** True if a picture has nothing to show yet.
 * @param {Drawn} drawn */
export const isEmpty = drawn =>
  Object.values(drawn.sources).every(columns => Object.values(columns).every(column => flat(column).length === 0))

export class Figure {
  /**
   * @param {any} item the figure as the server sends it
   * @param {string} pins the source that pinned scenarios have, too; empty if they are not drawn
   */
  constructor(item, pins) {
    const {Document} = Bokeh.require("document")
    this.pins = pins
    this.document = Document.from_json(item.doc)
    const [plot] = this.document.roots()
    this.plot = plot
    this.view = null
    /** Models by name.
     * @type {Map<string, any>} */
    this.models = new Map()
    for (const model of plot.references()) {
      if (model.name && model.type !== "GlyphRenderer") this.models.set(model.name, model)
    }
    // A finger scrolls the page; two of them zoom.
    if (coarse) plot.toolbar.active_drag = null
  }

  /** Enter data.
   * @param {Drawn} drawn
   * @param {(Columns | null)[]} pinned by slot
   * @param {number} slots */
  fill(drawn, pinned, slots) {
    for (const [name, columns] of Object.entries(drawn.sources)) this.columns(name, columns)
    if (this.pins) {
      /** @type {Columns} */
      const none = {}
      for (const column of Object.keys(drawn.sources[this.pins])) none[column] = []
      for (let slot = 0; slot < slots; slot++) this.columns(`pin ${slot}`, pinned[slot] ?? none)
    }
    for (const [name, props] of Object.entries(drawn.props)) this.models.get(name).setv(props)
    for (const tool of this.plot.toolbar.tools) {
      if (tool.type !== "HoverTool") continue
      const [, called] = /<b>(.*?)<\/b>/.exec(tool.tooltips) ?? []
      const shown = drawn.names[called]
      // What visitors type is text, not markup.
      if (shown) tool.tooltips = element("b", shown).outerHTML + tool.tooltips.slice(`<b>${called}</b>`.length)
    }
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

  /** Show the parts with these tags.
   * @param {Set<string>} wanted */
  reveal(wanted) {
    for (const model of this.plot.references()) {
      const [tag] = model.tags ?? []
      if (tag) model.visible = wanted.has(tag)
    }
  }

  /** Draw into an element.
   * @param {HTMLElement} box */
  async mount(box) {
    const {add_document_standalone} = Bokeh.require("embed/standalone")
    const views = await add_document_standalone(this.document, box)
    this.view = [...views][0]
    // The box is the one stop of the keyboard.
    this.view.canvas.events_el.tabIndex = -1
  }

  remove() {
    this.view?.remove()
  }

  /** Names of the parts that have no data. */
  get empty() {
    return this.plot.renderers
      .filter((/** @type {any} */ one) => one.data_source && one.name && one.data_source.get_length() === 0)
      .map((/** @type {any} */ one) => one.name)
  }

  // Zoom

  /** Let the wheel zoom alone, or with Ctrl only, so that it scrolls the page.
   * @param {boolean} alone */
  wheel(alone) {
    for (const tool of this.plot.toolbar.tools) {
      if (tool.type === "WheelZoomTool") tool.modifiers = alone ? {} : {ctrl: true}
    }
  }

  reset() {
    this.view.reset()
  }

  /** Do what a key asks for, and return true if it does.
   * @param {string} key */
  press(key) {
    const steps = {ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowDown: [0, -STEP], ArrowUp: [0, STEP]}[key]
    const zoom = {"+": ZOOM, "=": ZOOM, "-": 1 / ZOOM}[key]
    const {x_range, y_range, x_scale, y_scale} = this.plot
    if (key === "0") this.reset()
    else if (steps || zoom) {
      move(x_range, x_scale, steps?.[0] ?? 0, zoom ?? 1)
      move(y_range, y_scale, steps?.[1] ?? 0, zoom ?? 1)
    } else return false
    return true
  }
}

/** Move a range by a share of it, and zoom around its middle.
 * @param {any} range
 * @param {any} scale
 * @param {number} share
 * @param {number} zoom */
function move(range, scale, share, zoom) {
  // Categories have no ends.
  if (range.type === "FactorRange") return
  const log = scale.type === "LogScale"
  const [start, end] = [range.start, range.end].map(value => log ? Math.log10(value) : value)
  const middle = (start + end) / 2 + share * (end - start), half = zoom * (end - start) / 2
  const [low, high] = [middle - half, middle + half].map(value => log ? 10 ** value : value)
  const [least, most] = range.bounds ?? [-Infinity, Infinity]
  if (share && (low < least || high > most)) return
  range.setv({start: Math.max(low, least ?? low), end: Math.min(high, most ?? high)})
}
