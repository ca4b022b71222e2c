// Drop a file with this text on the star.
text => {
  const held = new DataTransfer()
  held.items.add(new File([text], "dropped star.txt"))
  const how = {dataTransfer: held, bubbles: true, cancelable: true}
  document.querySelector("[data-field=star]").dispatchEvent(new DragEvent("drop", how))
}
