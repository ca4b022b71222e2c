// @ts-check
// The scale of a slider.

/** @typedef {import("./protocol.js").Words} Words */

// Conversion between a slider's position and the value, with as many digits as needed.
export class Scale {
  /** @param {Words["sliders"][string]} slider */
  constructor({low, high, step, log}) {
    this.low = low
    this.high = high
    this.step = step
    this.log = log
    this.count = Math.round(log ? Math.log(high / low) / Math.log(step) : (high - low) / step)
  }

  /** @param {number} place */
  value(place) {
    if (this.log) return String(Number((this.low * this.step ** place).toPrecision(2)))
    const digits = Math.max(0, -Math.floor(Math.log10(this.step) + 1e-9))
    return (this.low + place * this.step).toFixed(digits).replace(/\.?0+$/, digits ? "" : "$&")
  }

  /** @param {number} value */
  place(value) {
    const found = this.log ? Math.log(value / this.low) / Math.log(this.step) : (value - this.low) / this.step
    return Math.min(Math.max(Math.round(found), 0), this.count)
  }
}
