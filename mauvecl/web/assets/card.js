// The answer card, the notices below it, and what fades where there is no answer.

const byId = id => document.getElementById(id)

function element(tag, text, more = {}) {
  return Object.assign(document.createElement(tag), {textContent: text, ...more})
}

export class Card {
  constructor() {
    this.box = byId("card")
    this.message = this.box.querySelector(".message")
    this.dismissed = new Set()
    this.unfolded = false
  }

  busy(busy) {
    this.box.setAttribute("aria-busy", String(busy))
  }

  // What is shown is no answer to what is entered.
  fade() {
    this.busy(true)
    for (const part of [this.message, byId("facts"), ...document.querySelectorAll(".pictures, .rows")]) part.classList.add("dim")
  }

  // The pictures of a tab are those of the answer; other tabs may still hold an earlier one's.
  fresh(tab) {
    for (const part of document.querySelectorAll(`#panel-${tab} :is(.pictures, .rows)`)) part.classList.remove("dim")
  }

  tell(answer) {
    this.box.classList.remove("none")
    this.box.style.minHeight = ""
    for (const part of [this.message, byId("facts")]) part.classList.remove("dim")
    byId("chance").textContent = answer.shown
    byId("interval").textContent = answer.interval
    byId("words-of").textContent = answer.words
    byId("facts").replaceChildren(...answer.facts.flatMap(([name, value]) => [element("dt", name), element("dd", value)]))
    this.busy(false)
  }

  none(why) {
    // What is below stays where it is.
    this.box.style.minHeight = `${this.box.offsetHeight}px`
    this.box.classList.add("none")
    this.message.classList.remove("dim")
    byId("chance").textContent = "No answer."
    byId("interval").textContent = ""
    byId("words-of").textContent = why
    this.ended("")
    this.busy(false)
  }

  progress(share, message, idle = false) {
    byId("progress").value = share
    byId("progress").classList.toggle("idle", idle)
    byId("status").textContent = message
  }

  ended(text) {
    this.progress(0, text, true)
  }

  // The small table of a tab.
  rows(tab, rows) {
    const box = document.querySelector(`#panel-${tab} .rows`)
    if (!box) return
    box.hidden = rows.length === 0
    const table = document.createElement("table")
    rows.forEach((cells, k) => {
      const row = table.insertRow()
      for (const text of cells) {
        const cell = document.createElement(k ? "td" : "th")
        if (!k) cell.scope = "col"
        cell.textContent = text
        row.append(cell)
      }
    })
    box.replaceChildren(table)
  }

  // Sentences that can be put away; one that was stays away as long as it is the same.
  notices(message) {
    const box = byId("notices")
    const shown = message.filter(([text]) => !this.dismissed.has(text))
    const key = JSON.stringify(shown)
    if (box.dataset.key === key) return
    box.dataset.key = key
    const item = ([text, kind]) => {
      const made = element("li", "", {className: kind}), away = element("button", "×", {type: "button", className: "plain"})
      away.setAttribute("aria-label", `Put away: ${text.slice(0, 60)}`)
      away.onclick = () => { this.dismissed.add(text); made.remove() }
      made.append(element("span", text), away)
      if (kind === "danger") made.setAttribute("role", "alert")
      return made
    }
    const grave = shown.filter(([, kind]) => kind !== "info")
    const others = shown.filter(([, kind]) => kind === "info")
    const parts = grave.map(item)
    if (others.length) {
      const fold = element("details", ""), list = element("ul", "")
      const head = element("summary", others.length === 1 ? "1 note on this answer" : `${others.length} notes on this answer`)
      list.append(...others.map(item))
      fold.append(head, list)
      fold.open = this.unfolded
      fold.ontoggle = () => { this.unfolded = fold.open }
      const whole = element("li", "")
      whole.append(fold)
      parts.push(whole)
    }
    box.replaceChildren(...parts)
  }
}
