"""The client's side of the command socket: one JSON object a line each way over a Unix socket.

A request is {"command": NAME, ...}; the answer is {"ok": true, ...} or {"ok": false, "error": TEXT}. The
server is command_server.py. This module loads nothing slow: `thermoctl status` starts with it.
"""

from __future__ import annotations

import contextlib
import json
import select
import socket
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from thermoctl.files.safe_file import long_socket
from thermoctl.files.yamlfile import InputError


def settled(now: dict[str, Any]) -> bool:
    """Return whether the loop has warmed up: only a command or a fault changes its state now."""
    state = now.get("state", "OFF")
    return state != "OFF" and (state != "SAFE" or any(f["severity"] != "warning" for f in now["faults"]))


class Connection:
    """A connection to the daemon at `path`: one request after the other.

    Raises InputError when the daemon does not answer. After {"command": "arm", "held": true} the daemon
    disarms the rig when the connection ends, for whatever reason."""

    def __init__(self, path: Path | str, timeout_s: float = 3.0):
        self.path, self.timeout_s = path, timeout_s
        if long := long_socket(path, "socket.path"):
            raise InputError(long)
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.socket.settimeout(timeout_s)
        with self._answering():
            self.socket.connect(str(path))

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send one request and return its answer."""
        with self._answering():
            self.socket.sendall(json.dumps(request).encode() + b"\n")
            received = b""
            while not received.endswith(b"\n"):
                data = self.socket.recv(1 << 16)
                if not data:
                    raise InputError(f"{self.path}: the daemon closed the connection; see its log")
                received += data
        return json.loads(received)

    def lost(self, wait_s: float) -> bool:
        """Wait for `wait_s`; True as soon as the daemon closes the connection. Between two requests only."""
        return bool(select.select([self.socket], [], [], wait_s)[0])

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    @contextlib.contextmanager
    def _answering(self) -> Iterator[None]:
        try:
            yield
        except OSError as e:
            self.socket.close()
            if isinstance(e, PermissionError):
                text = "not allowed; the socket is for its group (see socket.group)"
            elif isinstance(e, FileNotFoundError | ConnectionRefusedError):
                text = (
                    "the daemon is not running; `thermoctl start` or `thermoctl run --config FILE`"
                    + self._demo()
                )
            elif isinstance(e, TimeoutError):
                text = f"no answer within {self.timeout_s:g} s; see the daemon's log"
            else:
                text = "the daemon broke the connection off; see its log"
            raise InputError(f"{self.path}: {text}") from None

    def _demo(self) -> str:
        """Return a hint where a demo with a rig of its own runs beside this one."""
        rig = Path(self.path).parent / "demo/rig.yaml"
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as demo:
            demo.connect(str(rig.with_suffix(".sock")))
            return f"; a demo runs here on a rig of its own: --config {rig}"
        return ""


def tell(path: Path | str, request: dict[str, Any]) -> None:
    """Send one request to the daemon at `path`, and wait for no answer. Raises InputError."""
    with Connection(path) as connection, connection._answering():
        connection.socket.sendall(json.dumps(request).encode() + b"\n")


def refused_reload(paths: Iterable[Path | str], timeout_s: float = 3.0) -> str:
    """Return why an axis would refuse a reload, '' where none would: then nothing is half applied."""
    for path in paths:
        try:
            answer = ask(path, {"command": "may_reload"}, timeout_s)
        except InputError as e:
            answer = {"ok": False, "error": str(e)}
        if not answer["ok"]:
            return f"axis {answer.get('axis') or path}: {answer['error']}; no axis was changed"
    return ""


def ask(path: Path | str, request: dict[str, Any], timeout_s: float = 3.0) -> dict[str, Any]:
    """Send one request to the daemon at `path`; return its answer.

    Raises InputError when the daemon does not answer."""
    with Connection(path, timeout_s) as connection:
        return connection.ask(request)
