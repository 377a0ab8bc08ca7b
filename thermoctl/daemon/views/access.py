"""Access control of the dashboard: address, host name, origin and token of a request."""

from __future__ import annotations

import hmac
import ipaddress
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from thermoctl.files.yamlfile import InputError

MIN_TOKEN = 16  # characters


class Refused(Exception):
    """The request is answered with this status and text."""

    def __init__(self, status: HTTPStatus, text: str):
        super().__init__(text)
        self.status, self.text = status, text


@dataclass(frozen=True)
class Policy:
    """Access policy. names: host names, besides addresses and localhost, that may serve the page."""

    token: str
    token_to_look: bool
    commands: bool = False
    metrics: bool = False
    names: frozenset[str] = field(default_factory=frozenset)

    def check_source(self, headers: Any) -> None:
        """Refuse requests that another web page made the browser send.

        They show a foreign Host (DNS rebinding) or Origin."""
        host = headers.get_all("Host") or []
        if len(host) != 1 or not self._ours(_host_name(host[0])):
            raise Refused(HTTPStatus.MISDIRECTED_REQUEST, "this host name is not served; see --name")
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host[0]:
            raise Refused(HTTPStatus.FORBIDDEN, "requests of other web pages are refused")
        if headers.get("Sec-Fetch-Site") not in (None, "same-origin", "none"):
            raise Refused(HTTPStatus.FORBIDDEN, "requests of other web pages are refused")

    def check_token(self, headers: Any) -> None:
        """Refuse a request without the token."""
        given = headers.get("Authorization", "")
        if not hmac.compare_digest(given.encode(errors="replace"), f"Bearer {self.token}".encode()):
            raise Refused(
                HTTPStatus.UNAUTHORIZED,
                "the token is missing or wrong: open the address that `thermoctl dashboard` printed",
            )

    def _ours(self, name: str) -> bool:
        if name == "localhost" or name in self.names:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


def _host_name(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def parse_address(listen: str) -> tuple[str, int]:
    """Read ADDRESS:PORT, [V6ADDRESS]:PORT, or PORT on loopback. Raises InputError."""
    host, colon, port = listen.rpartition(":")
    host = host.strip("[]") if colon else "127.0.0.1"
    host = "127.0.0.1" if host == "localhost" else host
    try:
        ipaddress.ip_address(host)
        if not 0 <= int(port) <= 65535:
            raise ValueError
    except ValueError:
        raise InputError(
            f"--listen {listen}: ADDRESS:PORT was expected, as 127.0.0.1:8765 or [::]:8765"
        ) from None
    return host, int(port)
