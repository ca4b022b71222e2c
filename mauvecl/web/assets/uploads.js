// @ts-check
// Files of the visitor: they go to the server, and the browser keeps them for one that has lost them.

import {byId, every} from "./dom.js"

/** @typedef {import("./protocol.js").Entered} Entered */
/** @typedef {import("./protocol.js").Faults} Faults */
/** @typedef {import("./protocol.js").Words} Words */
/** @typedef {import("./protocol.js").Live} Live */
/** @typedef {import("./fields.js").Fields} Fields */

const MIB = 2 ** 20

export class Uploads {
  /**
   * @param {Words} words
   * @param {Fields} fields
   * @param {Live} live
   * @param {{changed(last: boolean): void, none(): void, again(): void}} then the question is another; it has no answer
   *   now; ask it again
   */
  constructor(words, fields, live, then) {
    this.words = words
    this.fields = fields
    this.live = live
    this.then = then
    /** @type {Record<string, {at: number, name: string, content: ArrayBuffer}>} */
    this.files = {}
    /** Fields whose file is not read, with the reason.
     * @type {Faults} */
    this.lacks = {}
    /** @type {Record<string, number>} */
    this.serials = {}
  }

  /**
   * @param {string} field
   * @param {File} file
   */
  async choose(field, file) {
    this.fields.put({[field]: ""})
    delete this.files[field]
    this.lacks[field] = `${file.name} is being read`
    this.then.changed(false)
    this.then.none()
    if (file.size > this.words.most_uploaded) {
      this.lack(field, `upload of ${(file.size / MIB).toFixed(1)} MiB, expected at most ${this.words.most_uploaded / MIB} MiB`)
      return
    }
    this.send(field, file.name, await file.arrayBuffer())
  }

  /**
   * @param {string} field
   * @param {string} name
   * @param {ArrayBuffer} content
   */
  send(field, name, content) {
    const serial = this.serials[field] = (this.serials[field] ?? 0) + 1
    const n = this.live.ask("upload", {field, name}, message => {
      this.live.done(n)
      // Another file was chosen since.
      if (serial !== this.serials[field]) return
      if (message.lacks) {
        if (field in this.lacks) this.lack(field, message.lacks)
        return
      }
      this.files[field] = {at: Date.now(), ...this.files[field], name, content}
      if (!(field in this.lacks)) return
      delete this.lacks[field]
      if (this.fields.entered[field] === message.entered) {
        // Sent again: the same question, and what was simulated for it.
        this.then.again()
        return
      }
      this.fields.put({[field]: message.entered})
      this.then.changed(true)
    })
    this.live.send(content)
  }

  // Send the files that stand in fields again, and return true if there are any.
  resend() {
    const kept = Object.entries(this.files).filter(([field]) => this.fields.entered[field] === this.words.uploads[field])
    for (const [field, {name, content}] of kept) {
      this.lacks[field] = `${name} is being read`
      this.send(field, name, content)
    }
    return kept.length > 0
  }

  /**
   * @param {string} field
   * @param {string} why
   */
  lack(field, why) {
    this.lacks[field] = why
    this.then.none()
  }

  /** These fields are changed: nobody waits for their files.
   * @param {string[]} names */
  forget(names) {
    for (const name of names) delete this.lacks[name]
  }

  // Name the files that stand in fields, and say that a link does not hold them.
  mention() {
    let any = false
    for (const name of every("[data-uploaded]")) {
      const field = name.dataset.uploaded
      const here = this.fields.entered[field] === this.words.uploads[field]
      name.textContent = here ? this.files[field]?.name ?? "" : ""
      any ||= here
    }
    byId("link-lacks").hidden = !any
  }

  /** Which files stand in fields, for the comparison of two questions.
   * @param {Entered} entered */
  of(entered) {
    const uploads = Object.entries(this.words.uploads).filter(([field, text]) => entered[field] === text)
    return uploads.map(([field]) => this.files[field]?.at ?? "gone").join()
  }
}
