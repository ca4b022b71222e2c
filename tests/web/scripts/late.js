// Let every message of the server come late.
() => {
  const come = page.live.come.bind(page.live)
  page.live.come = data => setTimeout(() => come(data), 1500)
}
