// Enter a magnitude and press the button before its answer comes; return whether the button is disabled and has the focus.
() => {
  const field = document.getElementById("f-magnitude"), button = document.getElementById("simulate")
  field.value = "6.5"
  field.dispatchEvent(new Event("input", {bubbles: true}))
  button.focus()
  button.click()
  return [button.ariaDisabled, document.activeElement === button]
}
