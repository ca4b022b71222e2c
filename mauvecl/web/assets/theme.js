// @ts-check
// Before anything is drawn: the colours that the visitor has chosen, or the system's.
"use strict"
{
  const dark = window.matchMedia("(prefers-color-scheme: dark)")
  const apply = () => {
    let chosen = null
    try { chosen = localStorage.getItem("mauvecl-theme") } catch { /* not kept */ }
    document.documentElement.dataset.theme = chosen ?? (dark.matches ? "dark" : "light")
    document.documentElement.dataset.chosen = chosen ?? "system"
    window.dispatchEvent(new Event("mauvecl-theme"))
  }
  window.chooseTheme = (/** @type {string | null} */ name) => {
    try {
      if (name === null) localStorage.removeItem("mauvecl-theme")
      else localStorage.setItem("mauvecl-theme", name)
    } catch { /* not kept */ }
    apply()
  }
  dark.addEventListener("change", apply)
  apply()
}
