"""Server of the page for benches, in a process of its own."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def page_server() -> Iterator[tuple[str, int]]:
    """Serve the page at a free port; yields host with port, and the server's process number."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = subprocess.Popen(
        [sys.executable, "-m", "mauvecl", "serve", "--port", str(port)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert server.stdout is not None
        for line in server.stdout:
            if "serves at" in line:
                break
        else:
            raise RuntimeError("the server ended before it served the page")
        yield f"127.0.0.1:{port}", server.pid
    finally:
        server.terminate()
