// Places of a picture and three fields from the top of the page.
() => ["plot-excess", "f-magnitude", "f-amplitude_percent", "f-exposure_s"]
  .map(name => document.getElementById(name).getBoundingClientRect().y + scrollY)
