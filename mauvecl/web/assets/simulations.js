// Simulations: one at a time, its progress, and those that are still wanted.

const byId = id => document.getElementById(id)

export class Simulations {
  // ended(kind): its answer is here; refused(why): it is not.
  constructor(live, routing, card, {question, ready, offer, ended, refused}) {
    Object.assign(this, {live, routing, card, question, ready, offer, ended, refused})
    this.running = null
    this.wanted = []
    byId("simulate").onclick = () => this.start("detection")
    byId("cancel").onclick = () => this.drop()
    for (const button of document.querySelectorAll("[data-simulate]")) {
      button.onclick = () => this.start(button.dataset.simulate)
    }
  }

  start(kind) {
    if (this.running !== null || !this.ready()) return
    const question = this.question()
    this.card.progress(0, "waiting for its turn")
    const n = this.running = this.live.ask("simulate", {kind, link: this.routing.link}, message => {
      if (message.ended === undefined) {
        this.card.progress(message.progress, message.message)
        return
      }
      this.live.done(n)
      this.running = null
      this.card.ended(message.ended)
      this.offer()
      if (question !== this.question()) return
      if (message.refused) this.refused(message.refused)
      else if (message.kind) this.ended(message.kind)
    })
    this.offer()
  }

  // Start the next one that a link wants and that is not here.
  next(simulated) {
    this.wanted = this.wanted.filter(kind => !simulated.includes(kind))
    if (this.wanted.length && this.running === null) this.start(this.wanted.shift())
  }

  stop() {
    if (this.running !== null) this.live.ask("cancel", {})
  }

  // Stop, and want no other.
  drop() {
    this.wanted = []
    this.stop()
  }

  // The connection is lost, and what ran with it.
  lost() {
    this.running = null
  }
}
