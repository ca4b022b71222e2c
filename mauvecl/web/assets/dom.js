// @ts-check
// Elements of the page: those that the template holds, and new ones; and keys that they share.

/** Steps of the arrow keys.
 * @type {Record<string, number>} */
export const STEPS = {ArrowUp: 1, ArrowDown: -1}

/** The element with this id; the template holds every one that is asked for.
 * @param {string} id
 * @returns {any} its kind is known where it is used */
export const byId = id => document.getElementById(id)

/** All elements that a selector finds, each of a kind that is known where they are used.
 * @param {string} selector
 * @param {ParentNode} [within]
 * @returns {any[]} */
export const every = (selector, within = document) => [...within.querySelectorAll(selector)]

/** A new element.
 * @param {string} tag
 * @param {string | null} [text]
 * @param {Record<string, any>} [more] properties
 * @returns {any} */
export function element(tag, text = null, more = {}) {
  const made = document.createElement(tag)
  if (text !== null) made.textContent = text
  return Object.assign(made, more)
}

/** A table of text, whose first row is its head.
 * @param {string[][]} rows
 * @returns {HTMLTableElement} */
export function tableOf(rows) {
  const table = document.createElement("table")
  rows.forEach((cells, k) => {
    const row = table.insertRow()
    for (const text of cells) row.append(element(k ? "td" : "th", text, k ? {} : {scope: "col"}))
  })
  return table
}
