// Heights of a legend at sixty widths, with and without an entry.
absent => {
    const legend = document.querySelector("#figure-excess .legend")
    const entry = [...legend.children].find(item => item.textContent == "drawn exposure")
    entry.classList.toggle("absent", absent)
    legend.style.alignSelf = "end"
    return [...Array(60).keys()].map(k => {
        legend.style.width = `${150 + 10 * k}px`
        return legend.offsetHeight
    })
}
