// @ts-check
// Buttons: which of them can be pressed now.

import {byId, every} from "./dom.js"

/** Whether the field is empty without which a simulation cannot start.
 * @param {string | undefined} kind
 * @param {import("./protocol.js").Entered} entered
 * @param {Record<string, string>} needs
 */
export function lacks(kind, entered, needs) {
  const need = kind === undefined ? undefined : needs[kind]
  return need !== undefined && !entered[need].trim()
}

/** Enable what the answer allows.
 * @param {import("./protocol.js").Answer | null} answer
 * @param {boolean} busy
 * @param {import("./protocol.js").Entered} entered
 * @param {Record<string, string>} needs fields without which simulations cannot start
 */
export function offer(answer, busy, entered, needs) {
  const ready = answer !== null
  const simulated = new Set(answer?.simulated ?? [])
  byId("cancel").disabled = !busy
  byId("pin").disabled = !ready
  byId("study").disabled = !ready
  for (const button of [byId("simulate"), ...every("[data-simulate]")]) {
    // Not `disabled`, so that the keyboard reaches it while the answer is on its way.
    button.ariaDisabled = String(!ready || busy || lacks(button.dataset.simulate, entered, needs))
  }
  for (const button of every("[data-file]")) {
    const tab = button.closest("[role=tabpanel]").id.replace("panel-", "")
    button.disabled = !answer?.files.includes(`${tab} ${button.dataset.file}`)
  }
  for (const hint of every("[data-needs]")) {
    const lacking = hint.dataset.needs.split(" ").filter((/** @type {string} */ kind) => !simulated.has(kind))
    const buttons = lacking.map((/** @type {string} */ kind) => document.querySelector(`[data-simulate="${kind}"]`) ?? byId("simulate"))
    hint.textContent = lacking.length ? `after ${buttons.map((/** @type {Element} */ button) => button.textContent).join(", ")}` : ""
  }
}
