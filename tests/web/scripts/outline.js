// Upper end of the outline of what has the focus.
() => {
  const style = getComputedStyle(document.activeElement)
  const top = document.activeElement.getBoundingClientRect().top
  return top - parseFloat(style.outlineWidth) - parseFloat(style.outlineOffset)
}
