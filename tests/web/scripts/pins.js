// Which of three pins a picture shows, and the colours of the lines of pinned scenarios.
picture => {
  const figure = page.pictures.all[picture].figure
  return [
    [0, 1, 2].map(k => Object.values(figure?.models?.get(`pin ${k}`).data ?? {})[0]?.length > 0),
    figure?.plot.renderers.filter(one => one.name?.startsWith("pinned")).map(one => one.glyph.line_color.value),
  ]
}
