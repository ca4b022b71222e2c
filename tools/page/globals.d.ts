// Names of other scripts of the page: BokehJS, and theme.js, which runs before anything is drawn.

declare const Bokeh: any

interface Window {
  chooseTheme(name: string | null): void
  page: unknown
}
