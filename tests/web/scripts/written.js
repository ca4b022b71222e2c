// Record what is written on canvases: text, and its left and right end in pixels of the canvas.
() => {
  const kind = CanvasRenderingContext2D.prototype, write = kind.fillText
  window.written = []
  kind.fillText = function (text, x, y) {
    const at = this.getTransform(), left = at.a * x + at.e
    if (!at.b) window.written.push([text, left, left + at.a * this.measureText(text).width])
    write.call(this, text, x, y)
  }
}
