// @ts-check
// Menus of the columns of a file of frames that is not understood; what is chosen is its mapping.

import {byId, every} from "./dom.js"

/** @typedef {import("./protocol.js").Faults} Faults */
/** @typedef {import("./protocol.js").Live} Live */
/** @typedef {import("./uploads.js").Uploads} Uploads */

export class Columns {
  /**
   * @param {Live} live
   * @param {Uploads} uploads
   */
  constructor(live, uploads) {
    this.live = live
    this.uploads = uploads
    this.box = byId("columns")
    this.menus = every("select", this.box)
    // The file whose columns are offered, by the time at which it was chosen.
    this.at = 0
    for (const menu of this.menus) menu.onchange = () => this.map()
  }

  /** Offer the columns of the frames, once they have a fault, until there is another file.
   * @param {Faults} faults */
  tell(faults) {
    const at = this.uploads.stands("frames") && this.uploads.files.frames?.at || 0
    if (at !== this.at) {
      this.at = 0
      this.box.hidden = true
    }
    if (!at || this.at || !faults.frames) return
    this.at = at
    const n = this.live.ask("columns", {}, message => {
      this.live.done(n)
      if (at === this.at) this.offer(message.columns)
    })
  }

  /** @param {string[]} names */
  offer(names) {
    for (const menu of this.menus) {
      if ("columns" in menu.dataset) menu.replaceChildren(menu.options[0], ...names.map(name => new Option(name, name)))
      menu.value = ""
    }
    this.box.hidden = names.length === 0
  }

  // Strings of JSON are strings of TOML as well.
  map() {
    const chosen = this.menus.filter(menu => menu.value)
    if (this.menus.some(menu => menu.required && !menu.value)) return
    const lines = chosen.map(menu => `${menu.name} = ${JSON.stringify(menu.value)}\n`)
    this.uploads.choose("mapping", new File(lines, "columns.toml"))
  }
}
