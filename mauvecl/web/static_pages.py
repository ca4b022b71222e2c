"""Static content: the page, its assets and empty figures, each rendered and compressed once."""

from __future__ import annotations

import gzip
import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

from tornado.web import RequestHandler

from mauvecl.host.version import VERSION

#: The page connects to its own server only, and runs only its own code.
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; object-src 'none'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
KINDS = {
    "js": "text/javascript; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "svg": "image/svg+xml",
    "json": "application/json",
    "html": "text/html; charset=utf-8",
}
#: Citation, as in the project's file CITATION.cff, which has neither the paper's volume and pages nor an address of
#: the project.
BIBTEX = """@software{{mauvecl,
  author = {{{{The mauvecl developers}}}},
  title = {{mauvecl: would the Mauve satellite see this stellar flare?}},
  version = {{{version}}},
  year = {{2026}}
}}

@article{{mauvesim,
  author = {{Saba, A. and Favata, F. and Savini, G. and Tinetti, G. and Bradley, L. and Stotesbury, I. and
            Tessenyi, M.}},
  title = {{MauveSim: the instrument simulator software for the Blue Skies Space Mauve satellite}},
  journal = {{RAS Techniques and Instruments}},
  year = {{2025}},
  eprint = {{2502.01389}},
  archivePrefix = {{arXiv}},
  url = {{https://arxiv.org/abs/2502.01389}}
}}
"""
_FOLDER = Path(__file__).parent / "assets"


@cache
def packed(content: bytes) -> tuple[bytes, str]:
    """Compress content with gzip, and return it with its digest."""
    return gzip.compress(content, 6, mtime=0), hashlib.sha256(content).hexdigest()[:16]


@cache
def asset(name: str) -> bytes | None:
    """Return an asset of the page; BokehJS comes from its own package."""
    if name == "bokeh.min.js":
        import bokeh

        return (Path(bokeh.__file__).parent / "server" / "static" / "js" / name).read_bytes()
    path = _FOLDER / name
    return path.read_bytes() if path.suffix[1:] in KINDS and path.is_file() else None


@cache
def front() -> bytes:
    """Return the page."""
    from mako.lookup import TemplateLookup

    from mauvecl.host.exposure.star import KNOWN
    from mauvecl.host.stars.library import all_names, library_names, well_known_stars
    from mauvecl.web import fields
    from mauvecl.web.figures import DASHES, INKS
    from mauvecl.web.headline import TITLES
    from mauvecl.web.simulations import SIMULATIONS
    from mauvecl.web.state import SEEN
    from mauvecl.web.tabs import TABS, reads_of
    from mauvecl.web.upload import UPLOADS
    from mauvecl.web.visitor import UNUSED

    words = {
        "version": VERSION,
        "fields": {name: field.first for name, field in fields.FIELDS.items()},
        "sliders": {
            name: {"low": s.low, "high": s.high, "step": s.step, "log": s.log}
            for name, field in fields.FIELDS.items()
            if (s := field.slider) is not None
        },
        "stars": all_names(),
        "example": "AU Mic\nYZ CMi\neps Eri",
        "asks": {name: sorted(reads_of(name)) for name in SIMULATIONS},
        "uploads": {
            name: {"entered": one.entered, "options": list(one.options), "most": one.most}
            for name, one in UPLOADS.items()
        },
        "withFile": fields.WITH_FILE,
        "columns": sorted({*KNOWN}),
        "needs": {name: one.needs for name, one in SIMULATIONS.items() if one.needs},
        "under": fields.ASKED_UNDER,
        "presets": fields.PRESETS,
        "seen": {name: field.first for name, field in SEEN.items()},
        "tabs": {
            tab.name: {
                "pictures": [
                    {"name": p.name, "sets": p.sets, "logs": list(p.logs), "pins": p.pins, "alike": p.alike}
                    for p in tab.pictures
                ],
                "reads": sorted(tab.reads),
                "headline": tab.headline,
            }
            for tab in TABS.values()
        },
        "pins": {theme: list(zip(ink.pins, DASHES, strict=True)) for theme, ink in INKS.items()},
        "unused": UNUSED,
    }
    lookup = TemplateLookup([str(_FOLDER)], default_filters=["h"], strict_undefined=True)
    template = lookup.get_template("page.html.mako")
    text = template.render(
        fields=fields, uploads=UPLOADS, names=[star.name for star in well_known_stars()],
        library=library_names(), tabs=TABS, version=VERSION,
        bibtex=BIBTEX.format(version=VERSION), titles=TITLES, digest=_digest(),
        words=json.dumps(words).replace("<", "\\u003c"),
    )  # fmt: skip
    return str(text).encode()


def _digest() -> str:
    """Return the digest of all assets, so that browsers do not use old ones."""
    each = [packed(content)[1] for path in sorted(_FOLDER.iterdir()) if (content := asset(path.name)) is not None]
    return hashlib.sha256("".join(each).encode()).hexdigest()[:12]


@cache
def figure(theme: str, name: str, logs: str) -> bytes | None:
    """Return an empty figure with its legend."""
    from bokeh.embed import json_item

    from mauvecl.web.figures import INKS
    from mauvecl.web.tabs import TABS

    picture = next((p for tab in TABS.values() for p in tab.pictures if p.name == name), None)
    if picture is None or theme not in INKS or not set(logs) <= {axis.lower() for axis in picture.logs}:
        return None
    canvas = picture.figure(INKS[theme], frozenset(logs))
    return json.dumps({"item": json_item(canvas.plot), "legend": canvas.legend}).encode()


def prepare() -> None:
    """Render and compress the content that every visitor requests; pictures of other tabs follow on request."""
    from mauvecl.web.tabs import TABS

    packed(front())
    for path in _FOLDER.iterdir():
        packed(asset(path.name) or b"")
    packed(asset("bokeh.min.js") or b"")
    for picture in next(iter(TABS.values())).pictures:
        usual = "".join(axis.lower() for axis in picture.logs if axis.isupper())
        for theme in ("light", "dark"):
            packed(figure(theme, picture.name, usual) or b"")


class CompressedHandler(RequestHandler):
    """Handler of static content."""

    def set_default_headers(self) -> None:
        """Set the headers of every answer."""
        self.clear_header("Server")
        for name, value in HEADERS.items():
            self.set_header(name, value)

    def give(self, content: bytes | None, kind: str, *, keep: bool = False) -> None:
        """Send content, or status 404 if it is None."""
        if content is None:
            self.set_status(404)
            self.set_header("Content-Type", "text/plain; charset=utf-8")
            self.finish("There is no such page.\n")
            return
        small, digest = packed(content)
        self.set_header("Content-Type", KINDS[kind])
        self.set_header("Vary", "Accept-Encoding")
        # A file with its digest in its address never changes.
        self.set_header("Cache-Control", "public, max-age=31536000, immutable" if keep else "no-cache")
        self.set_header("Etag", f'"{digest}"')
        if self.check_etag_header():
            self.set_status(304)
            self.finish()
            return
        if "gzip" in self.request.headers.get("Accept-Encoding", ""):
            self.set_header("Content-Encoding", "gzip")
            content = small
        self.finish(content)

    def compute_etag(self) -> str | None:
        """Return None, since `give` sets the tag."""
        return None

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """Send a message without internal details."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"The page cannot answer this ({status_code}).\n")


class FrontHandler(CompressedHandler):
    """Return the page."""

    def get(self) -> None:
        """Send the page, which reads the values of a link itself."""
        self.give(front(), "html")


class AssetHandler(CompressedHandler):
    """Handler of assets."""

    def get(self, name: str) -> None:
        """Send an asset by name."""
        self.give(asset(name), name.rpartition(".")[2], keep="v" in self.request.arguments)


class FigureHandler(CompressedHandler):
    """Handler of empty figures."""

    def get(self, theme: str, name: str) -> None:
        """Send a figure in a theme, with some logarithmic axes."""
        logs = "".join(sorted(set(self.get_query_argument("log", ""))))[:2]
        self.give(figure(theme, name, logs), "json", keep="v" in self.request.arguments)
