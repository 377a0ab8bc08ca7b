"""The dashboard: one page in the browser, served by a process of its own, with Prometheus' metrics beside it.

    GET  /                  the page: complete in itself, no file from elsewhere
    GET  /api/live          server-sent events: `past`, the last minute; then frames, 1 to 50 a second
                            (watch.Watch), and `slow` once a second: latency and captures
    GET  /api/info          rig, limits, signals, whether commands are taken
    GET  /api/history       ?signal=NAME&begin=S&end=S&points=N   least, mean and largest a pixel
    GET  /api/captures      faults with full-rate rows;  /api/capture?number=N&signal=NAME[&format=csv]
    GET  /metrics           with --metrics
    POST /api/command       arm, disarm, setpoint; with --commands only

Access: on loopback every user of this machine may read. On other addresses, and for every command, the token
is needed ("Authorization: Bearer TOKEN"; the page takes it from the address's #token=). Requests of other web
pages are refused (Host, Origin, Sec-Fetch-Site). So are requests that are too large, too slow or too many.
The protocol is plain HTTP: beyond the machine, use an ssh tunnel or a TLS proxy.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import io
import ipaddress
import json
import math
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.daemon.answers.readings import hide_invalid, invalid
from thermoctl.daemon.answers.sources import sources
from thermoctl.daemon.control_socket import ask
from thermoctl.daemon.tick.assemble import rig_identity
from thermoctl.daemon.views.access import MIN_TOKEN, Policy, Refused, parse_address
from thermoctl.daemon.views.metrics import CONTENT_TYPE, metrics
from thermoctl.daemon.views.watch import Watch
from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import InputError
from thermoctl.log import console_log
from thermoctl.recording.history import history, recorded_span
from thermoctl.rig.channels import DEFAULT
from thermoctl.rig.signals import AT

PAGE = Path(__file__).with_name("dashboard.html")
MAX_HEAD, MAX_BODY = 8192, 1024  # bytes of a request
FIRST_LOOK_S = 10.0
MAX_CONNECTIONS, MAX_STREAMS = 32, 12
REQUEST_S, SEND_S = 5.0, 5.0  # time limits of receiving a request and of sending an answer
COMMANDS = ("arm", "disarm", "setpoint")
TOKEN_VARIABLE = "THERMOCTL_DASHBOARD_TOKEN"


MAX_DRAWING = 1_000_000  # bytes


def drawing(settings: Settings) -> str:
    """Return the text of the rig's drawing, SVG; '' for none. Raises InputError where it cannot be read."""
    if settings.rig.drawing:
        path = Path(settings.path).parent / settings.rig.drawing
    elif settings.channels == DEFAULT:
        path = shipped("config/points") / "actuator.svg"
    else:
        return ""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as e:
        raise InputError(f"{path}: rig.drawing cannot be read: {getattr(e, 'strerror', None) or e}") from None
    if len(text) > MAX_DRAWING or "<svg" not in text:
        raise InputError(f"{path}: rig.drawing: an SVG file of at most {MAX_DRAWING} bytes was expected")
    return text


class Server(ThreadingHTTPServer):
    """Serves at most MAX_CONNECTIONS at a time; a further connection is closed at once."""

    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = 64

    def __init__(self, address: tuple[str, int], settings: Settings, watch: Watch, policy: Policy):
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self.settings, self.watch, self.policy = settings, watch, policy
        self.page, self.page_policy = _page()
        self.connections = threading.BoundedSemaphore(MAX_CONNECTIONS)
        self.streams = threading.BoundedSemaphore(MAX_STREAMS)
        super().__init__(address, Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for the request, when a place is free."""
        if not self.connections.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve the request as the library does, then free the place."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.connections.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore clients that disconnect; report every other error."""
        import sys

        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


def _page() -> tuple[bytes, str]:
    """Return the page, and the policy that forbids every script and style but the page's own."""
    text = PAGE.read_text()

    def hashes(tag: str) -> str:
        """Return the policy's sources (SHA-256) of all elements `tag` of the page."""
        elements = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        digests = (base64.b64encode(hashlib.sha256(part.encode()).digest()).decode() for part in elements)
        return " ".join(f"'sha256-{d}'" for d in digests)

    return text.encode(), (
        f"default-src 'none'; script-src {hashes('script')}; style-src {hashes('style')}; "
        "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


class Handler(BaseHTTPRequestHandler):
    """Answers one request a connection."""

    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "thermoctl", ""

    def handle(self) -> None:
        """Read the request within its limits, answer it, close."""
        self.close_connection = True
        self.command, self.path, self.request_version, self.requestline = "", "", "HTTP/1.1", ""
        try:
            head, body = self._receive()
            if not head:
                return
            first, _, rest = head.partition(b"\r\n")
            self.raw_requestline, self.rfile = first + b"\r\n", io.BytesIO(rest)
            if not self.parse_request():
                return
            self.close_connection = True
            self.connection.settimeout(SEND_S)
            self._answer(body)
        except Refused as e:
            self._json({"ok": False, "error": e.text}, e.status)
        except InputError as e:
            self._json({"ok": False, "error": str(e)}, HTTPStatus.BAD_REQUEST)

    def _receive(self) -> tuple[bytes, bytes]:
        """Return (head with its empty line, bytes after it). Raises Refused when too large or too slow."""
        data, deadline = b"", time.monotonic() + REQUEST_S
        while b"\r\n\r\n" not in data:
            if len(data) > MAX_HEAD:
                raise Refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, f"at most {MAX_HEAD} bytes of head")
            more = self._more(deadline)
            if not more:
                return b"", b""
            data += more
        head, _, body = data.partition(b"\r\n\r\n")
        if len(head) > MAX_HEAD:
            raise Refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, f"at most {MAX_HEAD} bytes of head")
        return head + b"\r\n\r\n", body

    def _more(self, deadline: float) -> bytes:
        left = deadline - time.monotonic()
        try:
            self.connection.settimeout(max(left, 1e-3))
            return self.connection.recv(4096) if left > 0 else b""
        except TimeoutError:
            raise Refused(
                HTTPStatus.REQUEST_TIMEOUT, f"the request did not come within {REQUEST_S:g} s"
            ) from None

    def _answer(self, body: bytes) -> None:
        policy = self.server.policy
        policy.check_source(self.headers)
        url = urlsplit(self.path)
        if self.command == "POST" and url.path == "/api/command" and policy.commands:
            self._command(body)
            return
        if self.command not in ("GET", "HEAD"):
            raise Refused(
                HTTPStatus.METHOD_NOT_ALLOWED,
                "this dashboard is read-only; start it with --commands to move the rig"
                if self.command == "POST"
                else "only GET is answered",
            )
        routes: dict[str, Callable[[Query], None]] = {
            "/api/live": self._live,
            "/api/info": self._info,
            "/api/history": self._history,
            "/api/captures": self._captures,
            "/api/capture": self._capture,
        }
        if policy.metrics:
            routes["/metrics"] = self._metrics
        if url.path == "/":
            self._send(self.server.page, "text/html; charset=utf-8")
            return
        if url.path == "/favicon.ico":
            self._send(b"", "image/x-icon", HTTPStatus.NO_CONTENT)
            return
        route = routes.get(url.path)
        if route is None:
            raise Refused(HTTPStatus.NOT_FOUND, "no such page")
        if policy.token_to_look:
            policy.check_token(self.headers)
        route(Query(url.query))

    def _live(self, query: Query) -> None:
        """Send frames until the client disconnects.

        A slow client misses frames; one that stops reading is dropped."""
        if not self.server.streams.acquire(blocking=False):
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, f"already {MAX_STREAMS} pages are open")
        try:
            self._head(HTTPStatus.OK, "text/event-stream", None)
            watch, seen, told_s = self.server.watch, -1, -math.inf
            watch.wait(0, FIRST_LOOK_S)  # without a daemon, the watcher reads the last recorded minute
            self.wfile.write(f"event: past\ndata: {_dump(list(watch.past))}\n\n".encode())
            while not watch.stopping:
                seen, frame = watch.wait(seen, 1.0)
                now, text = time.monotonic(), f"data: {_dump(frame)}\n\n"
                if now - told_s >= 1.0:
                    told_s = now
                    slow = {
                        "latency": watch.latency(),
                        "captures": [c.summary() for c in list(watch.captures)],
                    }
                    text += f"event: slow\ndata: {_dump(slow)}\n\n"
                self.wfile.write(text.encode())
        finally:
            self.server.streams.release()

    def _info(self, query: Query) -> None:
        settings = self.server.settings
        self._json(
            {
                "ok": True,
                "rig": settings.rig.name,
                "commands": self.server.policy.commands,
                "points": settings.channels.labels,
                "coil": settings.channels.coil,
                "drawing": drawing(settings),
                "period_s": settings.loop.period_s,
                "rate_hz": self.server.watch.rate_hz,
                "innovation_limit_c": settings.protection.innovation_limit_c,
                "innovation_time_s": settings.protection.innovation_time_s,
                "coil_limit_c": settings.protection.coil_limit_c,
                "power_limit_w": settings.protection.power_limit_w,
                "setpoint_low_um": settings.control.setpoint_low_um,
                "setpoint_high_um": settings.control.setpoint_high_um,
                "sources": sources(settings.channels),
                "recorded": recorded_span(settings.recording.directory, rig_identity(settings)),
                "signals": [
                    {"name": s.name, "unit": s.unit, "meaning": s.meaning} for s in settings.row.signals
                ],
            }
        )

    def _history(self, query: Query) -> None:
        end = query.number("end", time.time())
        drawn = history(
            self.server.settings.recording.directory,
            rig_identity(self.server.settings),
            query.text("signal", "compensation_um"),
            query.number("begin", end - 3600.0),
            end,
            int(query.number("points", 800.0)),
            invalid,
            self.server.settings.row.names,
        )
        self._json(
            {
                "ok": True,
                "source": drawn.source,
                "files": drawn.files,
                "t": _numbers(drawn.t, 3),
                **{k: _numbers(getattr(drawn, k)) for k in ("low", "mean", "high")},
            }
        )

    def _captures(self, query: Query) -> None:
        self._json({"ok": True, "captures": [c.summary() for c in list(self.server.watch.captures)]})

    def _capture(self, query: Query) -> None:
        capture = self.server.watch.capture(int(query.number("number", 0.0)))
        if capture is None:
            raise Refused(
                HTTPStatus.NOT_FOUND, "no capture of this number (the dashboard keeps the newest ones)"
            )
        if query.text("format", "json") == "csv":
            out = io.StringIO()
            np.savetxt(
                out, capture.rows, "%.17g", ",", header=",".join(self.server.settings.row.names), comments=""
            )
            self._send(
                out.getvalue().replace("nan", "").encode(),
                "text/csv; charset=utf-8",
                extra={"Content-Disposition": f'attachment; filename="capture-{capture.number}.csv"'},
            )
            return
        signal = query.text("signal", "compensated_um")
        if signal not in self.server.settings.row.index:
            raise InputError(f"capture: no signal '{signal[:60]}'")
        self._json(
            {
                "ok": True,
                **capture.summary(),
                "t": _numbers(capture.rows[:, AT["t_s"]] - capture.t_s, 6),
                "values": _numbers(hide_invalid(capture.rows, signal, self.server.settings.row)),
            }
        )

    def _metrics(self, query: Query) -> None:
        self._send(metrics(self.server.watch.shared).encode(), CONTENT_TYPE)

    def _command(self, body: bytes) -> None:
        self.server.policy.check_token(self.headers)
        if self.headers.get_content_type() != "application/json":
            raise Refused(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "application/json was expected")
        length = self.headers.get("Content-Length", "")
        if not re.fullmatch(r"\d{1,9}", length) or self.headers.get("Transfer-Encoding"):
            raise Refused(HTTPStatus.LENGTH_REQUIRED, "Content-Length was expected")
        if int(length) > MAX_BODY:
            raise Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {MAX_BODY} bytes")
        deadline = time.monotonic() + REQUEST_S
        while len(body) < int(length):
            more = self._more(deadline)
            if not more:
                return
            body += more
        try:
            request = json.loads(body[: int(length)])
            command, value = request["command"], request.get("value")
        except (ValueError, RecursionError, KeyError, TypeError, AttributeError):
            raise Refused(HTTPStatus.BAD_REQUEST, "an object with a 'command' was expected") from None
        if command not in COMMANDS:
            raise Refused(HTTPStatus.BAD_REQUEST, f"the commands are {', '.join(COMMANDS)}")
        answer = ask(self.server.settings.socket.path, {"command": command, "value": value})
        console_log(
            "command",
            name=command,
            value=value,
            peer=self.client_address[0],
            ok=answer["ok"],
            error=answer.get("error"),
        )
        self._json(answer, HTTPStatus.OK if answer["ok"] else HTTPStatus.CONFLICT)

    def _json(self, answer: dict[str, Any], status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(_dump(answer).encode(), "application/json", status)

    def _send(
        self,
        content: bytes,
        kind: str,
        status: HTTPStatus = HTTPStatus.OK,
        extra: dict[str, str] | None = None,
    ) -> None:
        self._head(status, kind, len(content), extra)
        if self.command != "HEAD":
            self.wfile.write(content)

    def _head(
        self, status: HTTPStatus, kind: str, length: int | None, extra: dict[str, str] | None = None
    ) -> None:
        self.send_response(status)
        headers = {
            "Content-Type": kind,
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Content-Security-Policy": self.server.page_policy,
            "Connection": "close",
            **(extra or {}),
        }
        if status == HTTPStatus.UNAUTHORIZED:
            headers["WWW-Authenticate"] = "Bearer"
        if length is not None:
            headers["Content-Length"] = str(length)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer a request that the library rejects."""
        self.request_version = "HTTP/1.1"
        self._json({"ok": False, "error": message or HTTPStatus(code).phrase}, HTTPStatus(code))

    def log_message(self, format: str, *args: Any) -> None:
        """Do not log requests: a page asks many times a second, and a log would keep addresses."""


class Query:
    """The part of an address after '?': each name once."""

    def __init__(self, text: str):
        try:
            self.values = {k: v[0] for k, v in parse_qs(text, max_num_fields=8, errors="strict").items()}
        except ValueError:
            raise InputError("the query is not understood: at most 8 names in UTF-8 were expected") from None

    def text(self, name: str, default: str) -> str:
        """Return the value of `name`."""
        return self.values.get(name, default)

    def number(self, name: str, default: float) -> float:
        """Return the finite number of `name`. Raises InputError for anything else."""
        try:
            value = float(self.values.get(name, default))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{name}: a finite number was expected")
        return value


def _dump(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _numbers(array: np.ndarray, digits: int | None = None) -> list[float | None]:
    """Round numbers for JSON: seven significant digits (or `digits` after the point), null for NaN."""
    return [
        None if not math.isfinite(v) else round(v, digits) if digits is not None else float(f"{v:.7g}")
        for v in array.tolist()
    ]


def make_server(
    settings: Settings,
    listen: str,
    watch: Watch,
    commands: bool = False,
    with_metrics: bool = False,
    token: str = "",
    names: Sequence[str] = (),
) -> Server:
    """Make a server on `listen` that does not serve yet.

    listen: ADDRESS:PORT, [V6ADDRESS]:PORT, or PORT on loopback."""
    address, port = parse_address(listen)
    if token and len(token) < MIN_TOKEN:
        raise InputError(f"the token has {len(token)} characters; at least {MIN_TOKEN} were expected")
    loopback = ipaddress.ip_address(address).is_loopback
    policy = Policy(
        token or secrets.token_urlsafe(24),
        not loopback,
        commands,
        with_metrics,
        frozenset(n.lower() for n in (*names, *(() if loopback else (socket.gethostname(),)))),
    )
    try:
        return Server((address, port), settings, watch, policy)
    except OSError as e:
        raise InputError(
            f"{listen}: cannot listen: {e.strerror or e}; choose another address with --listen"
        ) from None


def url(server: Server) -> str:
    """Return the address to open, with the token where one is needed."""
    host, port = str(server.server_address[0]), server.server_address[1]
    host = f"[{host}]" if ":" in host else host
    needed = server.policy.token_to_look or server.policy.commands
    return f"http://{host}:{port}/" + (f"#token={server.policy.token}" if needed else "")


def serve(
    settings: Settings,
    listen: str,
    commands: bool,
    with_metrics: bool,
    token_file: str | None,
    rate_hz: float,
    names: Sequence[str],
) -> int:
    """Serve until Ctrl-C."""
    if not 1.0 <= rate_hz <= 50.0:
        raise InputError(f"--rate {rate_hz:g}: 1 to 50 frames a second were expected")
    token = os.environ.get(TOKEN_VARIABLE, "")
    if token_file:
        try:
            token = Path(token_file).read_text().strip()
        except (OSError, UnicodeDecodeError) as e:
            raise InputError(f"{token_file}: cannot be read: {getattr(e, 'strerror', None) or e}") from None
    watch = Watch(settings, rate_hz)
    server = make_server(settings, listen, watch, commands, with_metrics, token, names)
    follower = threading.Thread(target=watch.run, daemon=True)
    follower.start()
    print(
        f"{url(server)}\n{'commands are taken with the token' if commands else 'read-only'}"
        f"{'; metrics at /metrics' if with_metrics else ''}; Ctrl-C ends it",
        flush=True,
    )
    with contextlib.suppress(KeyboardInterrupt):
        server.serve_forever(poll_interval=0.2)
    watch.stop()
    server.server_close()
    follower.join(1.0)
    return 0
