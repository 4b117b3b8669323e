"""Who may talk to the server: whoever has the token, by a name of this machine, from the page that it served itself.

A page of another site could otherwise make a browser connect to a server on this machine; and a name of its own that
leads here (DNS rebinding) would make the two look like one site. Imports neither jax nor a web framework.
"""

import functools
import hmac
import ipaddress
import re
import socket
from collections.abc import Mapping
from typing import NamedTuple
from urllib.parse import urlsplit

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_HOST = re.compile(r"(?P<name>[A-Za-z0-9.-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\])(?P<port>:[0-9]{1,5})?")


class Verdict(NamedTuple):
    """Why a request is turned away."""

    status: int
    says: str


class Guard(NamedTuple):
    """What requests are held against. host: the address that the server listens on."""

    token: str
    host: str

    def verdict(self, headers: Mapping[str, str], token: str) -> Verdict | None:
        """Return why a request is turned away; None for one that is let in. Header names are in small letters."""
        found = _HOST.fullmatch(headers.get("host", ""))
        if found is None or not self._ours(found["name"].strip("[]").lower()):
            return Verdict(400, "this server is not called so: use the address that it printed")
        origin = headers.get("origin")
        if origin is not None and origin not in (f"http://{found[0]}", f"https://{found[0]}"):
            return Verdict(403, "another site may not use this server")
        if not hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode()):
            return Verdict(403, "the address lacks its token: use the whole address that was printed")
        return None

    def _ours(self, name: str) -> bool:
        """Whether a name is this machine's own; beyond loopback also its addresses, which no foreign site can have."""
        if name in LOOPBACK or name == self.host.lower():
            return True
        if self.host in LOOPBACK:
            return False
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in _own_names()
        return True


@functools.cache
def _own_names() -> tuple[str, str]:
    """Names of this machine: asked for once, since the second may take a nameserver seconds."""
    return socket.gethostname().lower(), socket.getfqdn().lower()


def same_site(headers: Mapping[str, str]) -> str:
    """Return the host of a request that was let in, for the security policy of its page."""
    return urlsplit(f"http://{headers['host']}").netloc
