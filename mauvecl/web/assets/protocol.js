// @ts-check
// The connection to the server: numbered questions, their answers, and its end.

/**
 * Text of each field by name.
 * @typedef {Record<string, string>} Entered
 *
 * Sentences on the text of fields, by name.
 * @typedef {Record<string, string>} Faults
 *
 * Columns of numbers, as base64 of 32-bit floats, or of words, by name.
 * @typedef {Record<string, string[] | {f4: string, shape: number[]}>} Columns
 *
 * Data of a picture: its words, columns by data source, and properties by model.
 * @typedef {{text: string, sources: Record<string, Columns>, props: Record<string, Record<string, any>>,
 *   names: Record<string, string>}} Drawn
 *
 * The answer to a question, as the card shows it; notes are sentences with their kind.
 * @typedef {{numbers: {unknown: string, title: string, shown: string, interval: string}[], chosen: string,
 *   shown: string, interval: string, words: string, facts: [string, string][], notes: [string, string][],
 *   simulated: string[], files: string[], headline: string, chance: boolean}} Answer
 *
 * A message of the server: which entries it has depends on what was asked.
 * @typedef {{n: number, faults: Faults, stray: string, answer: Answer, refused: string, tab: string,
 *   pictures: Record<string, Drawn>, rows: string[][], draws: boolean, ended: string, kind: string, progress: number,
 *   message: string, columns: string[], lacks: string, remedies: [string, string][], entered: string, file: string, taken: any[], solved?: string, payloads?: string,
 *   pins: Record<string, Columns>, hello: string,
 *   known: {star: {about: string, given: Entered, offer: string}, targets: any[]}}} Message
 *
 * What the server says of a picture once.
 * @typedef {{name: string, sets: string, logs: string[], pins: string, alike: string[]}} PictureWords
 *
 * Texts and limits that the page is served with.
 * @typedef {{version: string, fields: Entered, seen: {tab: string, simulated: string}, stars: string[],
 *   example: string, headings: Record<string, string[]>, asks: Record<string, string[]>,
 *   uploads: Record<string, {entered: string, options: string[], most: number}>, withFile: Record<string, string[]>, needs: Record<string, string>,
 *   columns: string[], under: Record<string, [string, string]>, presets: Record<string, Entered>,
 *   sliders: Record<string, {low: number, high: number, step: number, log: boolean}>,
 *   tabs: Record<string, {pictures: PictureWords[], reads: string[], chance: boolean}>,
 *   pins: Record<string, [string, string][]>, unused: number}} Words
 */

const AGAIN_MS = 1000

export class Live {
  /**
   * @param {(version: string) => void} back there is a connection, again or for the first time
   * @param {(code: number) => void} lost there is none any more
   */
  constructor(back, lost) {
    this.back = back
    this.lost = lost
    this.n = 0
    /** @type {Map<number, (message: Message, content?: ArrayBuffer) => void>} */
    this.waiting = new Map()
    /** @type {Message | null} */
    this.head = null
    this.connect()
  }

  connect() {
    const address = new URL("live", window.location.href)
    address.protocol = address.protocol.replace("http", "ws")
    address.search = ""
    this.socket = new WebSocket(address)
    this.socket.binaryType = "arraybuffer"
    this.socket.onmessage = event => this.come(event.data)
    this.socket.onclose = event => {
      this.waiting.clear()
      this.head = null
      this.lost(event.code)
    }
  }

  again() {
    setTimeout(() => this.connect(), AGAIN_MS)
  }

  get open() {
    return this.socket.readyState === WebSocket.OPEN
  }

  /** Ask, and have `then` called with each message of the answer, and the bytes behind it.
   * @param {string} what
   * @param {Record<string, any>} more
   * @param {(message: Message, content?: ArrayBuffer) => void} [then]
   * @returns {number} */
  ask(what, more, then) {
    const n = ++this.n
    if (then) this.waiting.set(n, then)
    if (this.open) this.socket.send(JSON.stringify({ask: what, n, ...more}))
    return n
  }

  /** @param {ArrayBuffer} content */
  send(content) {
    if (this.open) this.socket.send(content)
  }

  /** @param {string | ArrayBuffer} data */
  come(data) {
    if (typeof data !== "string") {
      const head = this.head
      this.head = null
      if (head) this.waiting.get(head.n)?.(head, data)
      return
    }
    const message = JSON.parse(data)
    if (message.hello !== undefined) {
      this.back(message.hello)
    } else if (message.file) {
      // Its bytes come next.
      this.head = message
    } else {
      this.waiting.get(message.n)?.(message)
    }
  }

  /** @param {number} n */
  done(n) {
    this.waiting.delete(n)
  }
}
