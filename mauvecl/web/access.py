"""Access control of the page: hosts, origins and number of visitors."""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from tornado.routing import Matcher, Rule
from tornado.web import RequestHandler

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened
from mauvecl.web.visitor import Visitor

if TYPE_CHECKING:
    from tornado.httputil import HTTPServerRequest

#: Largest number of simultaneous visitors, with some megabytes each (assumed to suffice for a team).
MAX_VISITORS = 100
#: A host as browsers write it: name, IPv4 address or IPv6 address in brackets; and a port.
HOST = r"(?:[a-z0-9](?:[a-z0-9.-]*[a-z0-9])?|\[[0-9a-f:.]+\])(?::\d{1,5})?"


def local(address: str) -> bool:
    """Return whether an address is reachable from this machine only.

    Raises InputError if it is empty, or this machine cannot resolve it.
    """
    if not address.strip():
        raise InputError(
            "address = '' is empty", "an address such as 127.0.0.1, ::1 or 0.0.0.0", key="address", value=address
        )
    try:
        known = {str(info[4][0]).split("%")[0] for info in socket.getaddrinfo(address, None, type=socket.SOCK_STREAM)}
    except (OSError, UnicodeError) as error:
        raise InputError.of("address", address, "one such as 127.0.0.1") from error
    return all(ipaddress.ip_address(one).is_loopback for one in known)


def netloc(address: str, port: int) -> str:
    """Format host and port, with IPv6 addresses in brackets."""
    return f"[{address}]:{port}" if ":" in address else f"{address}:{port}"


def plain(host: str) -> str:
    """Return a host in lower case without default ports."""
    return re.sub(r":(80|443)$", "", host.strip().lower())


def origin(text: str) -> str:
    """Parse a value of `--allow-origin`, ``https://name`` or ``name:port``, to a host with its port.

    Raises InputError if it does not name a single host.
    """
    host = re.sub(r"^https?://", "", text.strip().lower()).removesuffix("/")
    if re.fullmatch(HOST, host) is None:
        raise InputError.of("allow_origin", text, "one host such as https://mauve.example.org")
    return plain(host)


def hosts(address: str, port: int, allowed: Iterable[str]) -> frozenset[str]:
    """Return the hosts under which the page is served.

    Raises InputError if other machines may connect and no origin is given, or an origin or the address is invalid.

    Parameters
    ----------
    address : str
        Address on which the server listens.
    allowed : iterable of str
        Values of `--allow-origin`.
    """
    named = {origin(text) for text in allowed}
    if not local(address) and not named:
        raise InputError(
            f"address = {shortened(address)} accepts other machines",
            "`allow_origin` with the address that visitors' browsers will show, such as https://mauve.example.org",
            key="address",
            value=address,
        )
    own = {"127.0.0.1", "localhost", "::1"} | ({address} if local(address) else set())
    return frozenset(plain(netloc(one, port)) for one in own) | named


class RefusalHandler(RequestHandler):
    """Handler that returns an error message instead of the page."""

    def initialize(self, status: int, why: str) -> None:
        """Set status and message."""
        self._status, self._why = status, why

    async def prepare(self) -> None:
        """Answer any request."""
        self.set_status(self._status)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        if self._status == 503:
            self.set_header("Retry-After", "60")
        await self.finish(f"{self._why}\n")


class AccessMatcher(Matcher):
    """Matcher of requests that are rejected.

    Parameters
    ----------
    allowed : frozenset of str
        Hosts from `hosts`.
    """

    def __init__(self, allowed: frozenset[str]) -> None:
        self._allowed = allowed

    @classmethod
    def rule(cls, allowed: frozenset[str]) -> Rule:
        """Return the routing rule, which must precede all others."""
        return Rule(cls(allowed), RefusalHandler)

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        """Return the reason for which a request is rejected, or None."""
        refused = self._foreign(request) or self._too_many(request)
        return None if refused is None else {"target_kwargs": dict(zip(("status", "why"), refused, strict=True))}

    def _foreign(self, request: HTTPServerRequest) -> tuple[int, str] | None:
        """Return the error for an unknown host name (DNS rebinding) or another server's page, or None."""
        if [plain(host) for host in request.headers.get_list("Host")] not in [[host] for host in self._allowed]:
            return 403, "The page is not served under this host name; see `mauvecl serve --allow-origin`."
        for given in request.headers.get_list("Origin"):
            if plain(re.sub(r"^https?://", "", given.lower())) not in self._allowed:
                return 403, "Pages of other servers cannot use this page; see `mauvecl serve --allow-origin`."
        if request.path == "/live" and not request.headers.get_list("Origin"):
            return 403, "Expected a connection from the page."
        return None

    def _too_many(self, request: HTTPServerRequest) -> tuple[int, str] | None:
        """Return the error if there are too many visitors, or None."""
        if request.path in ("/", "/live") and len(Visitor.here) >= MAX_VISITORS:
            return 503, "Too many visitors are here at the moment; please come again in some minutes."
        return None
