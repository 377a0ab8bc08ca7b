"""Publish the rig's state to an MQTT broker; it accepts no commands. Needs `pip install 'thermoctl[mqtt]'`.

    TOPIC/availability   `online` while the daemon answers, else `offline`. The broker publishes `offline`
                         when this program is gone (last will). Retained.
    TOPIC/status         the output of `thermoctl status --json`, RATE times a second
    TOPIC/faults         active faults with meaning and remedy, when they change. Retained.

The default TOPIC is thermoctl/RIG. While the broker is away, messages are dropped: only the newest state
matters, and the recording has the rest.
"""

from __future__ import annotations

import contextlib
import json
import threading
from pathlib import Path
from typing import Any

from thermoctl.configuration.settings import Settings
from thermoctl.daemon.control_socket import ask
from thermoctl.extras import load
from thermoctl.files.yamlfile import InputError

CONNECT_S = 10.0
ONLINE, OFFLINE = "online", "offline"


class Bridge:
    """Asks the daemon of `settings` and publishes below `topic`.

    broker: HOST or HOST:PORT (default 1883, with `tls` 8883); user, password: where the broker asks for
    them."""

    def __init__(
        self,
        settings: Settings,
        broker: str,
        topic: str = "",
        user: str = "",
        password: str = "",
        tls: bool = False,
    ):
        self.settings, self.topic = settings, topic or f"thermoctl/{settings.rig.name}"
        if any(c in self.topic for c in "+#\0") or self.topic.startswith("/"):
            raise InputError(
                f"--topic {self.topic}: a topic without '+' and '#' that does not begin with '/' was expected"
            )
        host, _, port = broker.rpartition(":") if ":" in broker else (broker, "", "8883" if tls else "1883")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise InputError(f"--broker {broker}: HOST or HOST:PORT was expected")
        self.broker = (host, int(port))
        self.connected, self.refused = threading.Event(), ""
        self._online: bool | None = None
        self._faults: str | None = None
        mqtt = load("paho.mqtt.client", "mqtt")
        self.client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        self.client.will_set(f"{self.topic}/availability", OFFLINE, qos=1, retain=True)
        self.client.reconnect_delay_set(1, 30)
        if user:
            self.client.username_pw_set(user, password or None)
        if tls:
            self.client.tls_set()
        self.client.on_connect = self._on_connect
        self.client.on_disconnect = lambda *_: self.connected.clear()

    def _on_connect(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            self.refused = str(reason)
            return
        self._online = self._faults = None  # the broker may have lost them: publish again
        self.connected.set()

    def open(self) -> None:
        """Connect. Raises InputError when the broker cannot be reached or refuses."""
        where = f"broker {self.broker[0]}:{self.broker[1]}"
        try:
            self.client.connect(*self.broker, keepalive=15)
        except OSError as e:
            raise InputError(
                f"{where}: cannot be reached: {e.strerror or e}; is it running, is the port right?"
            ) from None
        self.client.loop_start()
        if not self.connected.wait(CONNECT_S):
            self.client.loop_stop()
            raise InputError(
                f"{where}: {self.refused or f'no answer within {CONNECT_S:g} s'}; check --user and --password-file"
            )

    def look(self) -> None:
        """Ask the daemon once and publish."""
        try:
            status = ask(self.settings.socket.path, {"command": "status"})
        except InputError:
            status = {"ok": False}
        if not self.connected.is_set():
            return
        online = bool(status["ok"])
        if online != self._online:
            self.client.publish(
                f"{self.topic}/availability", ONLINE if online else OFFLINE, qos=1, retain=True
            )
            self._online = online
        if online:
            self.client.publish(f"{self.topic}/status", json.dumps(status, separators=(",", ":")))
            faults = json.dumps(status["faults"])
            if faults != self._faults:
                self.client.publish(f"{self.topic}/faults", faults, qos=1, retain=True)
                self._faults = faults

    def close(self) -> None:
        """Publish `offline` and disconnect."""
        if self.connected.is_set():
            # The connection was just lost: the last will publishes it.
            with contextlib.suppress(RuntimeError, ValueError):
                self.client.publish(
                    f"{self.topic}/availability", OFFLINE, qos=1, retain=True
                ).wait_for_publish(2.0)
        self.client.disconnect()
        self.client.loop_stop()


def publish(
    settings: Settings,
    broker: str,
    topic: str,
    rate_hz: float,
    user: str,
    password_file: str | None,
    tls: bool,
) -> int:
    """Publish until Ctrl-C. Raises InputError when the broker cannot be reached or refuses."""
    if not 0.01 <= rate_hz <= 10.0:
        raise InputError(f"--rate {rate_hz:g}: 0.01 to 10 messages a second were expected")
    try:
        password = Path(password_file).read_text().strip() if password_file else ""
    except (OSError, UnicodeDecodeError) as e:
        raise InputError(f"{password_file}: cannot be read: {getattr(e, 'strerror', None) or e}") from None
    bridge = Bridge(settings, broker, topic, user, password, tls)
    bridge.open()
    print(
        f"publishing below {bridge.topic} on {bridge.broker[0]}:{bridge.broker[1]}; Ctrl-C ends it",
        flush=True,
    )
    pause = threading.Event()
    try:
        while True:
            bridge.look()
            pause.wait(1.0 / rate_hz)
    except KeyboardInterrupt:
        return 0
    finally:
        bridge.close()
