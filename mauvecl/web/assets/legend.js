// @ts-check
// Legends: how each part of a picture is drawn, small, with its name.

import {element} from "./dom.js"

/** An entry: name, colour, form, and the tag that shows or hides the part.
 * @typedef {[string, string, string, string]} Entry */

const line = (/** @type {string} */ colour, /** @type {string} */ dashes) =>
  `<path d="M0 5h22" stroke="${colour}" stroke-width="2.5" stroke-dasharray="${dashes}"/>`
const swatch = (/** @type {string} */ shape) =>
  `<svg aria-hidden="true" class="swatch" viewBox="0 0 22 10">${shape}</svg>`

/** How a line is drawn, small.
 * @param {[string, string]} look colour and dashes */
export const dashed = look => swatch(line(...look))

/** @type {Record<string, (colour: string) => string>} */
const FORMS = {
  line: colour => line(colour, "none"),
  dash: colour => line(colour, "4 3"),
  band: colour => `<rect width="22" height="10" fill="${colour}" fill-opacity=".4"/>`,
  bars: colour => `<rect width="22" height="10" fill="${colour}" fill-opacity=".5"/>`,
  bar: colour => `<rect width="22" height="10" fill="${colour}"/>`,
  dot: colour => `<circle cx="11" cy="5" r="4" fill="${colour}"/>`,
}

/** Items of a legend.
 * @param {Entry[]} entries */
export const items = entries => entries.map(([called, colour, form, shows]) => {
  const item = element("li")
  item.innerHTML = swatch(FORMS[form](colour))
  item.append(called)
  Object.assign(item.dataset, {shows, called})
  return item
})

/** Give entries the names that they have in an answer, such as those of targets.
 * @param {any[]} entries
 * @param {Record<string, string>} names */
export function rename(entries, names) {
  for (const entry of entries) entry.lastChild.textContent = names[entry.dataset.called] ?? entry.dataset.called
}
