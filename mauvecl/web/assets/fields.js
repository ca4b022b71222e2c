// @ts-check
// Fields of the page: entered text, valid or not, with their sliders and files.

import {STEPS, byId, every} from "./dom.js"
import {Scale} from "./scale.js"
import {Stars} from "./stars.js"
import {Targets, knownColumns} from "./targets.js"

/** @typedef {import("./protocol.js").Entered} Entered */
/** @typedef {import("./protocol.js").Faults} Faults */
/** @typedef {import("./protocol.js").Words} Words */

export class Fields {
  /**
   * @param {Words} words
   * @param {(name: string, last: boolean, other: boolean) => void} changed a field was used; last says whether it is done
   *   with, other whether its text is another
   * @param {(field: string, file: File) => void} chosen
   */
  constructor(words, changed, chosen) {
    this.words = words
    this.changed = changed
    this.entered = {...words.fields}
    /** Fields on which the tab in front depends.
     * @type {Set<string>} */
    this.reads = new Set(Object.keys(words.fields))
    /** Fields that hold a file.
     * @type {Set<string>} */
    this.filed = new Set()
    // The number of realisations that was chosen, and a larger one that the false-alarm probability needs.
    this.wish = this.raised = words.fields.realisations
    // The star whose values are filled in once the server knows them.
    this.fresh = ""
    this.stars = new Stars(byId("f-star"), byId("stars"), words.stars, () => this.take("star", true))
    this.targets = new Targets(words.example, words.headings)
    /** @type {Record<string, Scale>} */
    this.scales = {}
    for (const name of Object.keys(words.fields)) this.wire(name)
    for (const button of every("[data-choose]")) {
      const [file] = every(`[data-upload="${button.dataset.choose}"]`)
      button.addEventListener("click", () => file.click())
      const box = button.closest(".field")
      box.addEventListener("dragover", (/** @type {DragEvent} */ event) => event.preventDefault())
      box.addEventListener("drop", (/** @type {DragEvent} */ event) => {
        const [one] = event.dataTransfer.files
        if (!one) return
        event.preventDefault()
        // A field may stand within that of another file.
        event.stopPropagation()
        chosen(button.dataset.choose, one)
      })
      file.addEventListener("change", () => {
        const [one] = file.files
        // The same file may be chosen again; its name is not shown for another star.
        file.value = ""
        if (one) chosen(button.dataset.choose, one)
      })
    }
    for (const button of every("[data-open-text]")) {
      const [file] = every(`[data-text="${button.dataset.openText}"]`), field = byId(`f-${button.dataset.openText}`)
      const put = (/** @type {string} */ text) => {
        field.value = knownColumns(text, words.columns)
        this.take(field.name, true)
      }
      button.addEventListener("click", () => file.click())
      file.addEventListener("change", async () => {
        const [one] = file.files
        file.value = ""
        if (one) put(await one.text())
      })
      field.addEventListener("paste", (/** @type {ClipboardEvent} */ event) => {
        const text = event.clipboardData?.getData("text") ?? ""
        if (field.value || !text.includes("\n")) return
        event.preventDefault()
        put(text)
      })
    }
    this.show()
  }

  /** @param {string} name */
  wire(name) {
    const field = byId(`f-${name}`)
    const isSelect = field.tagName === "SELECT"
    if (!isSelect) field.addEventListener("input", () => this.take(name, false))
    field.addEventListener("change", () => this.take(name, true))
    const [slider] = every(`[data-slider="${name}"]`)
    if (!slider) return
    const scale = this.scales[name] = new Scale(this.words.sliders[name])
    slider.max = String(scale.count)
    const move = (/** @type {boolean} */ last) => {
      field.value = scale.value(Number(slider.value))
      this.take(name, last)
    }
    slider.addEventListener("input", () => move(false))
    slider.addEventListener("change", () => move(true))
    field.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      const step = STEPS[event.key]
      const value = this.number(name)
      if (!step || !(Math.abs(value) >= 0)) return
      event.preventDefault()
      field.value = scale.value(scale.place(value) + step)
      this.take(name, true)
    })
  }

  /** @param {string} name
   * @returns {string} */
  label(name) {
    return document.querySelector(`label[for="f-${name}"]`)?.textContent ?? name
  }

  /** A sentence on a field, with the field's label.
   * @param {string} name
   * @param {string} why */
  said(name, why) {
    const label = this.label(name)
    return why.startsWith(label) ? why : `${label}: ${why}`
  }

  /**
   * @param {string} name
   * @param {boolean} last
   */
  take(name, last) {
    const text = byId(`f-${name}`).value
    const other = text !== this.entered[name]
    this.entered[name] = text
    if (name === "realisations") this.wish = text
    if (["fap", "realisations"].includes(name) && other) this.possible()
    if (name === "star" && last && text !== this.settled) this.fresh = this.settled = text
    if (other || last) this.changed(name, last, other)
    this.aside(name)
  }

  /** Enter several at once, as a preset, a link or a click on a picture does.
   * @param {Entered} given */
  put(given) {
    Object.assign(this.entered, given)
    this.possible()
    this.show()
  }

  show() {
    for (const name of Object.keys(this.words.fields)) {
      const field = byId(`f-${name}`)
      const text = this.entered[name]
      if (field.tagName === "SELECT" && ![...field.options].some(o => o.value === text)) {
        // A choice that a link holds and that does not exist is shown for what it is.
        field.add(new Option(text, text))
      }
      if (field.value !== text) field.value = text
      if (name === "targets") field.dispatchEvent(new Event("shown"))
      this.aside(name)
    }
    this.settled = this.entered.star
    // Nothing is known of a file that is being read.
    if (!this.entered.star) byId("k-star").textContent = ""
    if (this.entered.realisations !== this.raised) this.wish = this.entered.realisations
  }

  /** The number in a field; of an empty one, that with which its placeholder begins.
   * @param {string} name */
  number(name) {
    const {value, placeholder} = byId(`f-${name}`)
    return value.trim() ? Number(value) : Number.parseFloat(placeholder)
  }

  /** Elements that accompany a field: its slider, and fields that apply only with one text of it.
   * @param {string} name */
  aside(name) {
    const [slider] = every(`[data-slider="${name}"]`)
    if (slider) {
      const value = this.number(name)
      if (Number.isFinite(value)) {
        const place = this.scales[name].place(value)
        if (slider.value !== String(place)) slider.value = String(place)
      }
      const [unit] = every(`[data-field="${name}"] .unit`)
      const spoken = name === "magnitude" ? `${this.entered.band} = ${this.entered[name]}` : `${this.entered[name]} ${unit?.textContent ?? ""}`
      slider.setAttribute("aria-valuetext", this.entered[name] ? spoken.trim() : byId(`f-${name}`).placeholder)
    }
    if (Object.values(this.words.under).some(([other]) => other === name)) this.hide()
  }

  /** Show the fields on which a tab depends.
   * @param {string[]} reads */
  front(reads) {
    this.reads = new Set(reads)
    this.hide()
  }

  // Hide fields on which the tab does not depend, those that apply with another choice, and those of absent files.
  hide() {
    const fileless = new Set(Object.entries(this.words.withFile).flatMap(([field, names]) => this.filed.has(field) ? [] : names))
    for (const name of Object.keys(this.words.fields)) {
      const [other, text] = this.words.under[name] ?? []
      const [box] = every(`[data-field="${name}"]`)
      const excluded = this.reads.has(other) && !fileless.has(other) && this.entered[other] !== text
      if (box) box.hidden = !this.reads.has(name) || fileless.has(name) || excluded
    }
    for (const group of every("#advanced fieldset")) group.hidden = !every("[data-field]:not([hidden])", group).length
    byId("advanced").hidden = !every("#advanced fieldset:not([hidden])").length
    byId("begin").hidden = !this.reads.has("amplitude_percent")
  }

  // Realisations that can settle the false-alarm probability are offered, others are not. Where the chosen number
  // cannot, the next one that can stands in for it, and says so.
  possible() {
    const fap = Number(this.entered.fap)
    const field = byId("f-realisations")
    const settles = (/** @type {string} */ text) => text.endsWith("sampled") || Number(text) * fap >= 100 * (1 - 1e-9)
    for (const option of field.options) option.disabled = fap > 0 && !settles(option.value)
    const enough = !(fap > 0) || settles(this.wish)
    const stand = enough ? this.wish : [...field.options].find(option => !option.disabled).value
    this.entered.realisations = field.value = this.raised = stand
    const chosen = [...field.options].find(option => option.value === this.wish)?.textContent ?? this.wish
    byId("n-realisations").textContent = enough ? "" : `${chosen} are too few for this false-alarm probability; with a larger one they come back.`
  }

  /** Show what is known of the star and of the targets, and fill in what is known of a star that was just chosen.
   * @param {import("./protocol.js").Message["known"]} known
   * @param {(given: Entered, fills: boolean) => void} enter */
  facts(known, enter) {
    this.targets.tell(known.targets)
    const {about, given, offer} = known.star
    const other = Object.fromEntries(Object.entries(given).filter(([name, text]) => this.entered[name] !== text))
    byId("k-star").textContent = about
    const button = byId("o-star")
    button.hidden = !offer || !Object.keys(other).length
    button.textContent = offer
    button.onclick = () => enter(given, false)
    const fills = this.fresh === this.entered.star
    this.fresh = ""
    if (fills && Object.keys(other).length) enter(given, true)
  }

  /** Error messages at their fields; an invalid field is never hidden.
   * @param {Faults} faults */
  tell(faults) {
    for (const name of Object.keys(this.words.fields)) {
      const field = byId(`f-${name}`)
      const message = byId(`w-${name}`)
      const fault = faults[name] ?? ""
      if (message.textContent !== fault) message.textContent = fault
      message.hidden = !fault
      if (fault) {
        field.setAttribute("aria-invalid", "true")
        document.querySelector(`[data-field="${name}"]`)?.removeAttribute("hidden")
        if (byId("advanced").contains(field)) byId("advanced").open = true
      } else field.removeAttribute("aria-invalid")
    }
  }
}
