// @ts-check
// Files of the visitor: they go to the server, and the browser keeps them for one that has lost them.

import {byId, element, every} from "./dom.js"
import {keep, kept} from "./kept-files.js"

/** @typedef {import("./protocol.js").Entered} Entered */
/** @typedef {import("./protocol.js").Faults} Faults */
/** @typedef {import("./protocol.js").Words} Words */
/** @typedef {import("./protocol.js").Live} Live */
/** @typedef {import("./fields.js").Fields} Fields */
/** @typedef {import("./kept-files.js").Kept} Kept */

const MIB = 2 ** 20
//: Milliseconds without a change of how a file is read after which it is read again.
const AGAIN_MS = 600

export class Uploads {
  /**
   * @param {Words} words
   * @param {Fields} fields
   * @param {Live} live
   * @param {{changed(last: boolean): void, none(): void, again(): void, link(): string}} then the question is another;
   *   it has no answer now; ask it again; the question as a link
   */
  constructor(words, fields, live, then) {
    this.words = words
    this.fields = fields
    this.live = live
    this.then = then
    /** @type {Record<string, Kept>} */
    this.files = {}
    /** Fields whose file is not read, with the reason.
     * @type {Faults} */
    this.lacks = {}
    /** What a field's file was last read with.
     * @type {Record<string, string>} */
    this.read = {}
    /** @type {Record<string, number>} */
    this.serials = {}
    for (const button of every("[data-remove]")) {
      button.onclick = () => {
        const nothing = this.without(button.dataset.remove)
        this.forget(Object.keys(nothing))
        this.fields.put(nothing)
        this.then.changed(true)
      }
    }
    this.before = kept().then(files => { this.files = {...files, ...this.files} })
  }

  /** Fields whose files are here and are read as a field says.
   * @param {string} name */
  owners(name) {
    return Object.keys(this.words.uploads).filter(field => this.words.uploads[field].options.includes(name) && this.holds(field))
  }

  /** The first texts of a field and of those that apply only with its file.
   * @param {string} field
   * @returns {Entered} */
  without(field) {
    return Object.fromEntries([field, ...this.words.withFile[field] ?? []].map(name => [name, this.words.fields[name]]))
  }

  /** Whether a field's file stands in it, is being read, or was refused.
   * @param {string} field */
  holds(field) {
    return this.files[field] !== undefined && (field in this.lacks || this.stands(field))
  }

  /** @param {string} field
   * @param {Entered} [entered] */
  stands(field, entered = this.fields.entered) {
    return entered[field] === this.words.uploads[field].entered
  }

  /**
   * @param {string} field
   * @param {File} file
   */
  async choose(field, file) {
    // Another file may have other units.
    const nothing = {...this.without(field), [field]: ""}
    this.forget(Object.keys(nothing))
    this.fields.put(nothing)
    delete this.files[field]
    this.lacks[field] = `${file.name} is being read`
    this.propose(field, [])
    this.then.changed(false)
    this.then.none()
    const {most} = this.words.uploads[field]
    if (file.size > most) {
      this.lack(field, `the upload has ${(file.size / MIB).toFixed(1)} MiB, but may have at most ${most / MIB} MiB`)
      return
    }
    const chosen = this.files[field] = {at: Date.now(), name: file.name, content: await file.arrayBuffer()}
    this.send(field)
    await keep(field, chosen)
  }

  /** A field says how another one's file is read: it is read again.
   * @param {string} name
   * @param {boolean} last */
  changed(name, last) {
    const fields = this.owners(name)
    if (!fields.length) return
    for (const field of fields) {
      this.lacks[field] = `${this.files[field].name} is being read again`
      // A reading that is under way is of no use.
      this.serials[field] = (this.serials[field] ?? 0) + 1
    }
    const send = () => fields.forEach(field => this.send(field))
    clearTimeout(this.soon)
    if (last) send()
    else this.soon = setTimeout(send, AGAIN_MS)
  }

  /** @param {string} field */
  send(field) {
    const {name, content} = this.files[field]
    const serial = this.serials[field] = (this.serials[field] ?? 0) + 1
    const options = this.options(field)
    const n = this.live.ask("upload", {field, name, link: this.then.link()}, message => {
      this.live.done(n)
      // Another file was chosen since.
      if (serial !== this.serials[field] || !(field in this.lacks)) return
      this.propose(field, message.remedies ?? [])
      if (message.lacks) {
        this.lack(field, message.lacks)
        return
      }
      delete this.lacks[field]
      this.read[field] = options
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

  /** What is entered of how a field's file is read.
   * @param {string} field
   * @param {Entered} [entered] */
  options(field, entered = this.fields.entered) {
    return this.words.uploads[field].options.map(name => entered[name]).join()
  }

  // Send the files that stand in fields again, and return true if there are any.
  async resend() {
    await this.before
    const here = Object.keys(this.words.uploads).filter(field => this.holds(field))
    for (const field of here) {
      this.lacks[field] = `${this.files[field].name} is being read`
      this.send(field)
    }
    return here.length > 0
  }

  /**
   * @param {string} field
   * @param {string} why
   */
  lack(field, why) {
    this.lacks[field] = why
    this.then.none()
  }

  /** Buttons for what a refusal proposes.
   * @param {string} field
   * @param {[string, string][]} remedies */
  propose(field, remedies) {
    const [box] = every(`[data-remedies="${field}"]`)
    const button = (/** @type {[string, string]} */ [name, text]) => element("button", `${this.fields.label(name)}: ${text}`, {
      type: "button", className: "plain", onclick: () => {
        this.fields.put({[name]: text})
        this.changed(name, true)
        this.then.changed(true)
      },
    })
    box.replaceChildren(...remedies.map(button))
  }

  /** These fields are changed: nobody waits for their files.
   * @param {string[]} names */
  forget(names) {
    for (const name of names) {
      if (!(name in this.lacks)) continue
      delete this.lacks[name]
      this.propose(name, [])
    }
  }

  // Name the files that stand in fields, offer how they are read, and say that a link does not hold them.
  mention() {
    const uploads = Object.keys(this.words.uploads)
    for (const name of every("[data-uploaded]")) {
      const field = name.dataset.uploaded
      name.textContent = this.holds(field) ? this.files[field].name : ""
      for (const button of every(`[data-remove="${field}"]`)) button.hidden = !this.holds(field)
      name.title = name.textContent && "Kept in this tab of your browser, also over a reload."
    }
    for (const button of every("[data-remove]")) button.hidden = !this.holds(button.dataset.remove)
    for (const field of uploads) {
      const [box] = every(`[data-field="${field}"]`)
      box.classList.toggle("filed", field in this.lacks || this.stands(field))
    }
    this.fields.filed = new Set(uploads.filter(field => this.holds(field)))
    this.fields.hide()
    byId("link-lacks").hidden = !uploads.some(field => this.stands(field))
  }

  /** Which files stand in fields and how they are read, for the comparison of two questions.
   * @param {Entered} entered */
  of(entered) {
    const uploads = Object.keys(this.words.uploads).filter(field => this.stands(field, entered))
    return uploads.map(field => `${this.files[field]?.at ?? "gone"} ${this.read[field]}`).join()
  }
}
