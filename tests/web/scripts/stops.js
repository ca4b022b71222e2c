// Stops of the keyboard within a picture, by their classes.
name => {
  const found = []
  const walk = node => {
    for (const element of node.children) {
      if (element.tabIndex >= 0) found.push(element.className)
      if (element.shadowRoot) walk(element.shadowRoot)
      walk(element)
    }
  }
  walk(document.getElementById(name))
  return found
}
