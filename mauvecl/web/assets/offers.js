// Buttons: which of them can be pressed now.

const byId = id => document.getElementById(id)

// Enable what the answer allows; null stands for no answer.
export function offer(answer, busy, entered, tabs) {
  const ready = answer !== null
  const simulated = new Set(answer?.simulated ?? [])
  byId("simulate").disabled = !ready || busy
  byId("cancel").disabled = !busy
  byId("pin").disabled = !ready
  byId("study").disabled = !ready
  for (const button of document.querySelectorAll("[data-simulate]")) {
    const lacks = ["visible", "plan"].includes(button.dataset.simulate) && !entered.see.trim()
    button.disabled = !ready || busy || lacks
  }
  for (const tab of Object.values(tabs)) {
    for (const [name, needs] of Object.entries(tab.files)) {
      for (const button of document.querySelectorAll(`[data-file="${name}"]`)) {
        button.disabled = !ready || (needs !== null && !simulated.has(needs))
      }
    }
  }
  for (const hint of document.querySelectorAll("[data-needs]")) {
    const lacking = hint.dataset.needs.split(" ").filter(kind => !simulated.has(kind))
    const buttons = lacking.map(kind => document.querySelector(`[data-simulate="${kind}"]`) ?? byId("simulate"))
    hint.textContent = lacking.length ? `after ${buttons.map(button => button.textContent).join(", ")}` : ""
  }
}
