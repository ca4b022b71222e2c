// The connection to the server: numbered questions, their answers, and its end.

const AGAIN_MS = 1000

export class Live {
  // came: message what comes; back: called when there is a connection (again); lost: when there is none, with its code.
  constructor(back, lost) {
    this.back = back
    this.lost = lost
    this.n = 0
    this.waiting = new Map()
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

  // Ask, and have `then` called with each message of the answer, and the bytes behind it.
  ask(what, more, then) {
    const n = ++this.n
    if (then) this.waiting.set(n, then)
    if (this.open) this.socket.send(JSON.stringify({ask: what, n, ...more}))
    return n
  }

  send(content) {
    if (this.open) this.socket.send(content)
  }

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

  done(n) {
    this.waiting.delete(n)
  }
}
