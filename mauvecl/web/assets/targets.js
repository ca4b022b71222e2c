// @ts-check
// The table of targets: typed, pasted or from a file; its text, a list of names or CSV, stands in the field behind it.

import {byId, element, every} from "./dom.js"

/** @typedef {{about: string, spectral_type: string, V: string, distance_pc: string, coordinates: string, fault: string}} Known */
/** @typedef {Record<string, string>} Row */

/** Columns that are always there, with their headings. */
const COLUMNS = {
  name: "Target", spectral_type: "Type", V: "V", distance_pc: "Distance (pc)", coordinates: "Coordinates (deg)",
}

/** The cells of a line; quotes hold separators.
 * @param {string} line
 * @param {string} separator */
function cells(line, separator) {
  const found = [""]
  let quoted = false
  for (const mark of line) {
    if (mark === '"') quoted = !quoted
    else if (mark === separator && !quoted) found.push("")
    else found[found.length - 1] += mark
  }
  return found.map(cell => cell.trim())
}

/** The rows of a pasted or stored text: names, or a table whose first line names its columns.
 * @param {string} text
 * @param {Record<string, string[]>} headings names that tables have for columns, in lower case, the preferred first
 * @returns {Row[]} */
function rowsOf(text, headings) {
  const lines = text.split(/\r?\n/).map(line => line.trim()).filter(line => line && !line.startsWith("#"))
  if (!lines.length) return []
  const separator = text.startsWith("# %ECSV") ? " " : ["\t", ";", ","].find(mark => lines[0].includes(mark)) ?? ","
  const keys = cells(lines[0], separator)
  const lower = keys.map(name => name.toLowerCase())
  for (const [key, names] of Object.entries(headings)) {
    const first = names.find(name => lower.includes(name))
    if (first) keys[lower.indexOf(first)] = key
  }
  if (keys.includes("name")) {
    return lines.slice(1).map(line => {
      const values = cells(line, separator)
      return Object.fromEntries(keys.map((key, k) => [key, values[k] ?? ""]))
    })
  }
  // A comma before a number stands within coordinates.
  return lines.flatMap(line => line.split(/[\t;]|,(?!\s*[+-]?\d)/)).map(name => ({name: name.trim().replace(/^"(.*)"$/, "$1")})).filter(row => row.name)
}

/** The columns of a CSV table that are known, with their separator: tables of archives have many more.
 * @param {string} text
 * @param {string[]} known in lower case */
export function knownColumns(text, known) {
  const lines = text.split(/\r?\n/).filter(line => line.trim() && !line.startsWith("#"))
  // Units stand in the comments of ECSV: such a table goes to the server as it is, which says what it takes.
  if (!lines.length || text.startsWith("# %ECSV")) return text.trim()
  const separator = ["\t", ";", ","].find(mark => lines[0].includes(mark)) ?? ","
  const kept = cells(lines[0], separator).flatMap((name, k) => known.includes(name.toLowerCase()) ? [k] : [])
  if (!kept.length) return text.trim()
  const quoted = (/** @type {string} */ cell) => cell.includes(separator) ? `"${cell}"` : cell
  return lines.map(line => { const row = cells(line, separator); return kept.map(k => quoted(row[k] ?? "")).join(separator) }).join("\n")
}

/** The text of rows: names alone if there is nothing else.
 * @param {Row[]} rows */
export function textOf(rows) {
  const filled = rows.filter(row => Object.values(row).some(Boolean))
  const keys = [...new Set(filled.flatMap(row => Object.keys(row).filter(key => row[key])))]
  if (keys.every(key => key === "name")) return filled.map(row => row.name).join("\n")
  const order = ["name", ...keys.filter(key => key !== "name")]
  const quoted = (/** @type {string} */ cell) => cell.includes(",") ? `"${cell}"` : cell
  return [order.join(","), ...filled.map(row => order.map(key => quoted(row[key] ?? "")).join(","))].join("\n")
}

export class Targets {
  /**
   * @param {string} example what the button for an example enters
   * @param {Record<string, string[]>} headings see `rowsOf` */
  constructor(example, headings) {
    this.headings = headings
    this.field = byId("f-targets")
    this.body = byId("targets").tBodies[0]
    this.head = byId("targets").tHead
    /** @type {Row[]} */
    this.rows = []
    /** @type {Known[]} */
    this.known = []
    this.field.addEventListener("shown", () => this.read())
    const [file] = every("#targets-file")
    byId("targets-open").onclick = () => file.click()
    file.onchange = async () => {
      const [one] = file.files
      file.value = ""
      if (one) this.enter(rowsOf(await one.text(), this.headings))
    }
    byId("targets-example").onclick = () => this.enter(rowsOf(example, this.headings))
    byId("targets-clear").onclick = () => { this.enter([]); this.focus(0) }
    this.read()
  }

  // The text behind the table was changed by a link or an example.
  read() {
    if (this.field.value !== textOf(this.rows)) this.rows = rowsOf(this.field.value, this.headings)
    this.draw()
  }

  /** @param {Row[]} rows */
  enter(rows) {
    this.rows = rows
    this.draw()
    this.store(true)
  }

  /** @param {boolean} last */
  store(last) {
    this.field.value = textOf(this.rows)
    this.field.dispatchEvent(new Event(last ? "change" : "input"))
  }

  get columns() {
    return [...new Set([...Object.keys(COLUMNS), ...this.rows.flatMap(row => Object.keys(row))])]
  }

  draw() {
    const columns = this.columns
    this.rows = this.rows.filter(row => Object.values(row).some(Boolean))
    byId("targets-clear").hidden = this.rows.length === 0
    byId("targets-example").hidden = this.rows.length > 0
    const heads = columns.map(key => element("th", COLUMNS[/** @type {keyof COLUMNS} */ (key)] ?? key, {scope: "col"}))
    this.head.rows[0].replaceChildren(...heads, element("td"))
    this.body.replaceChildren(...[...this.rows, {}].map((row, k) => this.row(row, k, columns)))
    this.tell(this.known)
  }

  /**
   * @param {Row} row
   * @param {number} k
   * @param {string[]} columns */
  row(row, k, columns) {
    const made = element("tr")
    for (const key of columns) {
      const cell = made.insertCell()
      const input = element("input", null, {type: "text", value: row[key] ?? "", autocomplete: "off", spellcheck: false})
      input.setAttribute("aria-label", `${COLUMNS[/** @type {keyof COLUMNS} */ (key)] ?? key} of target ${k + 1}`)
      input.dataset.key = key
      if (key === "name") {
        input.setAttribute("list", "names")
        if (k === this.rows.length) input.placeholder = k ? "another one" : "AU Mic"
      }
      input.addEventListener("input", () => this.type(k, key, input.value, false))
      input.addEventListener("change", () => this.type(k, key, input.value, true))
      input.addEventListener("paste", (/** @type {ClipboardEvent} */ event) => this.paste(event, k))
      input.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
        if (event.key !== "Enter") return
        event.preventDefault()
        this.type(k, key, input.value, true)
        this.focus(k + 1)
      })
      cell.append(input)
    }
    const away = element("button", "×", {type: "button", className: "plain", hidden: k === this.rows.length})
    away.setAttribute("aria-label", `Remove target ${k + 1}`)
    away.onclick = () => {
      this.enter(this.rows.filter((_, other) => other !== k))
      this.focus(Math.min(k, this.rows.length))
    }
    made.insertCell().append(away)
    return made
  }

  /**
   * @param {number} k
   * @param {string} key
   * @param {string} value
   * @param {boolean} last */
  type(k, key, value, last) {
    if (k === this.rows.length) {
      if (!value.trim()) return
      // What is typed in the last row makes it one, and another empty one follows.
      this.rows.push({})
      this.body.rows[k].lastElementChild.firstElementChild.hidden = false
      this.body.append(this.row({}, k + 1, this.columns))
      byId("targets-clear").hidden = false
      byId("targets-example").hidden = true
    }
    this.rows[k][key] = value.trim()
    this.store(last)
  }

  /**
   * @param {ClipboardEvent} event
   * @param {number} k */
  paste(event, k) {
    const text = event.clipboardData?.getData("text") ?? ""
    if (!/[\n\t]|,(?!\s*[+-]?\d)/.test(text.trim())) return
    event.preventDefault()
    const rows = rowsOf(text, this.headings)
    this.enter([...this.rows.slice(0, k), ...rows, ...this.rows.slice(k)])
    this.focus(k + rows.length)
  }

  /** @param {number} k */
  focus(k) {
    this.body.rows[Math.min(k, this.body.rows.length - 1)]?.querySelector("input")?.focus()
  }

  /** Show what is known of each target in the cells where nothing is entered.
   * @param {Known[]} known */
  tell(known) {
    this.known = known
    for (const [k, row] of [...this.body.rows].entries()) {
      const {about = "", fault = "", ...values} = known[k] ?? {}
      for (const input of every("input", row)) {
        const {key} = input.dataset
        if (key === "name") {
          if (fault) input.setAttribute("aria-invalid", "true")
          else input.removeAttribute("aria-invalid")
          input.title = fault || about
        } else input.placeholder = /** @type {Row} */ (values)[key] ?? ""
      }
    }
  }
}
