"""What the page's own code in the browser does: address and history, a lost connection, files that are too large."""

from __future__ import annotations

from typing import Any

from bokeh.core.properties import Bool, Float, List, String
from bokeh.model import DataModel
from bokeh.models import CustomJS

from mauvecl.web.upload import MOST_UPLOADED

#: Milliseconds between two looks whether a lost server is there again.
AGAIN_MS = 1000


class Bridge(DataModel):
    """What server and browser tell each other beside the controls."""

    #: The address's query as the server wants it, and whether it takes the present one's place.
    address = String()
    replaces = Bool(False)
    #: The query that the visitor went back or forward to, and a number that makes each such step another.
    came = List(String, default=["", ""])
    #: Bytes of a file that is too large to be sent, and how often one was chosen.
    refused = List(Float, default=[0.0, 0.0])
    #: Whether the server lets go of a page that nobody uses.
    idle = Bool(False)


#: Pushing an address while one goes back would forget the way forward: the same one is left alone.
ADDRESS = """
if (bridge.address !== window.location.search)
  window.history[bridge.replaces ? 'replaceState' : 'pushState']({}, '', window.location.pathname + bridge.address)
"""
READY = f"""
// The server then has no address to send back, which could come after the next step.
window.addEventListener('popstate', () => {{
  const search = window.location.search
  bridge.setv({{address: search, came: [search, String(performance.now())]}})
}})
if (bridge.address !== window.location.search)
  window.history.replaceState({{}}, '', window.location.pathname + bridge.address)
// 'input' leaves shadow roots and comes before the 'change' at which a file is read and sent.
window.addEventListener('input', event => {{
  const field = event.composedPath()[0]
  const file = field.type === 'file' && field.files.length ? field.files[0] : null
  if (file !== null && file.size > {MOST_UPLOADED}) {{
    event.stopImmediatePropagation()
    field.value = ''
    bridge.refused = [file.size, bridge.refused[1] + 1]
  }}
}}, true)
"""
#: The address holds the state: a new page takes the old one's place as soon as there is a server again.
LOST = f"""
if (document.getElementById('mauvecl-lost') !== null) return
for (const part of document.body.children) part.inert = true
const box = document.createElement('div')
box.id = 'mauvecl-lost'
box.setAttribute('role', 'alert')
box.style.cssText = 'position:fixed;inset:0;z-index:99999;background:rgba(255,255,255,.75);display:flex;'
  + 'align-items:center;justify-content:center;font:1.1rem system-ui;color:#000'
const told = document.createElement('div')
told.style.cssText = 'background:#fff;border:2px solid #b00020;padding:1.5em;max-width:30em'
const again = document.createElement('button')
again.textContent = 'Go on'
again.onclick = () => window.location.reload()
told.textContent = bridge.idle ? 'This page was not used for a long time, and the server let it go. '
  : 'The connection to the server is lost. The page comes back by itself as soon as the server answers. '
if (bridge.idle) told.append(again)
box.append(told)
document.body.append(box)
if (bridge.idle) again.focus()
else {{
  const look = () => fetch('favicon.ico', {{cache: 'no-store'}}).then(() => window.location.reload())
    .catch(() => setTimeout(look, {AGAIN_MS}))
  setTimeout(look, {AGAIN_MS})
}}
"""


def attach(document: Any, bridge: Bridge) -> None:
    """Put the browser's part into a document."""
    bridge.js_on_change("address", CustomJS(args={"bridge": bridge}, code=ADDRESS))
    document.js_on_event("document_ready", CustomJS(args={"bridge": bridge}, code=READY))
    document.js_on_event("connection_lost", CustomJS(args={"bridge": bridge}, code=LOST))
