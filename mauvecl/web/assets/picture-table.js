// @ts-check
// The data of a picture as tables, for who does not see it.

import {element} from "./dom.js"
import {flat} from "./figure.js"

/** @typedef {import("./protocol.js").Drawn} Drawn */

//: Rows of a table at most: more are left out evenly.
const MOST = 50

const short = (/** @type {any} */ value) => typeof value === "number" ? String(Number(value.toPrecision(4))) : String(value)

/** One table for each part that has data.
 * @param {Drawn} drawn
 * @param {Record<string, string>} axes labels of the axes x and y
 * @returns {Element[]} */
export function tables(drawn, axes) {
  const made = []
  for (const [name, columns] of Object.entries(drawn.sources)) {
    // An image or a contour has no rows.
    const flats = Object.entries(columns).filter(([, column]) =>
      Array.isArray(column) ? typeof column[0] !== "object" : column.shape.length === 1)
    const values = flats.map(([, column]) => flat(column))
    const count = values.length ? values[0].length : 0
    if (!count) continue
    const shown = Array.from({length: Math.min(count, MOST)}, (_, k) => Math.floor(k * count / Math.min(count, MOST)))
    const table = element("table")
    table.append(element("caption", shown.length < count ? `${name}: ${shown.length} of ${count} rows` : name))
    const head = table.insertRow()
    for (const [column] of flats) head.append(element("th", axes[column] ?? column, {scope: "col"}))
    for (const k of shown) {
      const row = table.insertRow()
      for (const column of values) row.append(element("td", short(column[k])))
    }
    made.push(table)
  }
  return made.length ? made : [element("p", "There are no data yet.")]
}
