// @ts-check
// A picture as a file: on white whatever the page's colours are, with title, legend, and what was asked.

import {element} from "./dom.js"

/** @typedef {import("./figure.js").Figure} Figure */

//: Pixels of the plot, margin around it, and pixels of a PNG or PDF for each.
const WIDTH = 1000, HEIGHT = 560, MARGIN = 20, FINE = 2.4
const FONT = "system-ui, sans-serif"
const NS = "http://www.w3.org/2000/svg"

/** Lines of at most the plot's width.
 * @param {string} text
 * @param {number} size */
function wrapped(text, size) {
  const context = element("canvas").getContext("2d")
  context.font = `${size}px ${FONT}`
  const lines = [""]
  for (const word of text.split(" ")) {
    const longer = `${lines[lines.length - 1]} ${word}`.trim()
    if (context.measureText(longer).width > WIDTH && lines[lines.length - 1]) lines.push(word)
    else lines[lines.length - 1] = longer
  }
  return lines
}

/** The plot as SVG, drawn out of sight.
 * @param {Figure} figure
 * @returns {Promise<string>} */
async function plotted(figure) {
  const box = element("div", null, {className: "unseen", inert: true})
  box.style.width = `${WIDTH}px`
  box.style.height = `${HEIGHT}px`
  document.body.append(box)
  try {
    await figure.mount(box)
    while (!figure.view.has_finished()) await new Promise(done => { setTimeout(done, 20) })
    const blob = await figure.view.export("svg").to_blob()
    return await blob.text()
  } finally {
    figure.remove()
    box.remove()
  }
}

/** Compose the whole picture.
 * @param {Figure} figure
 * @param {string} title
 * @param {Element[]} legend its entries, with swatches
 * @param {string[]} about sentences below
 * @returns {Promise<SVGSVGElement>} */
async function composed(figure, title, legend, about) {
  const whole = /** @type {SVGSVGElement} */ (document.createElementNS(NS, "svg"))
  const put = (/** @type {string} */ tag, /** @type {Record<string, any>} */ given, text = "") => {
    const made = document.createElementNS(NS, tag)
    for (const [name, value] of Object.entries(given)) made.setAttribute(name, String(value))
    made.textContent = text
    whole.append(made)
    return made
  }
  const ground = put("rect", {width: "100%", height: "100%", fill: "#ffffff"})
  const write = (/** @type {string} */ text, /** @type {number} */ x, /** @type {number} */ y, size = 14, more = {}) =>
    put("text", {x, y, "font-family": FONT, "font-size": size, fill: "#1b2733", ...more}, text)
  let y = MARGIN + 20
  for (const line of wrapped(title, 22)) { write(line, MARGIN, y, 20, {"font-weight": 600}); y += 26 }
  const context = element("canvas").getContext("2d")
  context.font = `14px ${FONT}`
  let x = MARGIN
  for (const entry of legend) {
    const text = entry.textContent ?? "", wide = 30 + context.measureText(text).width
    if (x > MARGIN && x + wide > WIDTH) { x = MARGIN; y += 20 }
    const swatch = /** @type {Element} */ (entry.querySelector("svg").cloneNode(true))
    for (const [name, value] of Object.entries({x, y: y - 10, width: 22, height: 10})) swatch.setAttribute(name, String(value))
    whole.append(swatch)
    write(text, x + 28, y)
    x += wide + 22
  }
  y += 10
  const plot = new DOMParser().parseFromString(await plotted(figure), "image/svg+xml").documentElement
  plot.setAttribute("x", String(MARGIN))
  plot.setAttribute("y", String(y))
  whole.append(plot)
  y += HEIGHT + 26
  for (const line of about.flatMap(text => wrapped(text, 13.5))) { write(line, MARGIN, y, 13); y += 18 }
  const [width, height] = [WIDTH + 2 * MARGIN, y]
  for (const [name, value] of Object.entries({xmlns: NS, width, height, viewBox: `0 0 ${width} ${height}`})) {
    whole.setAttribute(name, String(value))
  }
  whole.prepend(ground)
  return whole
}

/** Draw SVG on a canvas.
 * @param {Blob} svg
 * @returns {Promise<HTMLCanvasElement>} */
async function rastered(svg) {
  const address = URL.createObjectURL(svg)
  try {
    const image = new Image()
    image.src = address
    await image.decode()
    const canvas = element("canvas", null, {width: Math.round(image.width * FINE), height: Math.round(image.height * FINE)})
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height)
    return canvas
  } finally {
    URL.revokeObjectURL(address)
  }
}

/** A PDF of one page that holds an image. Libraries that write PDF lack letters such as sigma in their own fonts.
 * @param {HTMLCanvasElement} canvas
 * @returns {Promise<Blob>} */
async function pdf(canvas) {
  const {width, height} = canvas, {data} = canvas.getContext("2d").getImageData(0, 0, width, height)
  const colours = new Uint8Array(width * height * 3)
  for (let k = 0; k < width * height; k++) colours.set(data.subarray(4 * k, 4 * k + 3), 3 * k)
  const deflated = await new Response(new Blob([colours]).stream().pipeThrough(new CompressionStream("deflate"))).arrayBuffer()
  // In points, of which 72 are an inch.
  const size = [width, height].map(pixels => (pixels / FINE * 0.75).toFixed(2))
  const content = `q ${size[0]} 0 0 ${size[1]} 0 0 cm /I Do Q`
  const objects = [
    ["<</Type/Catalog/Pages 2 0 R>>"],
    ["<</Type/Pages/Kids[3 0 R]/Count 1>>"],
    [`<</Type/Page/Parent 2 0 R/MediaBox[0 0 ${size.join(" ")}]/Resources<</XObject<</I 4 0 R>>>>/Contents 5 0 R>>`],
    [`<</Type/XObject/Subtype/Image/Width ${width}/Height ${height}/ColorSpace/DeviceRGB/BitsPerComponent 8` +
      `/Filter/FlateDecode/Length ${deflated.byteLength}>>\nstream\n`, deflated, "\nendstream"],
    [`<</Length ${content.length}>>\nstream\n${content}\nendstream`],
  ]
  /** @type {(string | ArrayBuffer)[]} */
  const parts = ["%PDF-1.4\n"]
  const size_of = (/** @type {string | ArrayBuffer} */ part) => typeof part === "string" ? part.length : part.byteLength
  let at = size_of(parts[0])
  const places = objects.map((object, k) => {
    const place = at, whole = [`${k + 1} 0 obj\n`, ...object, "\nendobj\n"]
    parts.push(...whole)
    for (const part of whole) at += size_of(part)
    return place
  })
  const entries = places.map(place => `${String(place).padStart(10, "0")} 00000 n \n`).join("")
  const n = objects.length + 1
  parts.push(`xref\n0 ${n}\n0000000000 65535 f \n${entries}trailer\n<</Size ${n}/Root 1 0 R>>\nstartxref\n${at}\n%%EOF\n`)
  return new Blob(parts, {type: "application/pdf"})
}

/** The picture as a file of a kind: svg, png, or pdf.
 * @param {string} ending
 * @param {Figure} figure in light colours, filled and not drawn yet
 * @param {string} title
 * @param {Element[]} legend
 * @param {string[]} about
 * @returns {Promise<Blob>} */
export async function pictureFile(ending, figure, title, legend, about) {
  const whole = await composed(figure, title, legend, about)
  const svg = new Blob([new XMLSerializer().serializeToString(whole)], {type: "image/svg+xml"})
  if (ending === "svg") return svg
  const canvas = await rastered(svg)
  return ending === "pdf" ? pdf(canvas) : new Promise(done => { canvas.toBlob(blob => done(blob), "image/png") })
}
