"""HTTP server with a bounded number of connections."""

from __future__ import annotations

from typing import Any

from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream


class BoundedServer(HTTPServer):
    """HTTP server that closes the oldest connection without a visitor's page if there are too many."""

    max_connections: int

    def initialize(self, *args: Any, **options: Any) -> None:
        """Create a server without connections."""
        super().initialize(*args, **options)
        self._streams: list[IOStream] = []

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Serve a new connection."""
        from mauvecl.web.visitor import Visitor

        self._streams = [one for one in self._streams if not one.closed()]
        if len(self._streams) >= self.max_connections:
            pages = {id(page.ws_connection.stream) for page in Visitor.here if page.ws_connection is not None}
            oldest = next((one for one in self._streams if id(one) not in pages), stream)
            oldest.close()
            if oldest is stream:
                return
        self._streams.append(stream)
        super().handle_stream(stream, address)
