"""MQTT on a real broker (Debian: apt-get install mosquitto)."""

import json
import os
import queue
import shutil
import socket
import subprocess
import time

import pytest

from tests.devices.emulators import free_port
from thermoctl import cli
from thermoctl.files.yamlfile import InputError
from thermoctl.rig.signals import INDEX

LIMIT_S = 20.0
BROKER = shutil.which("mosquitto", path=os.environ["PATH"] + ":/usr/sbin")


@pytest.fixture
def broker(tmp_path):
    """The port of a broker on loopback that lets in `rig` with a password, and anonymous readers."""
    if BROKER is None:
        pytest.skip("no mosquitto on this machine: MQTT is not tested (apt-get install mosquitto)")
    port = free_port()
    log = (tmp_path / "broker.log").open("wb")
    process = subprocess.Popen([BROKER, "-p", str(port)], stdout=log, stderr=log)
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
            break
        except OSError:
            assert process.poll() is None, (tmp_path / "broker.log").read_text()
    yield port
    process.terminate()
    process.wait(10)


class Reader:
    """A client that collects what comes below thermoctl/."""

    def __init__(self, port):
        client = pytest.importorskip(
            "paho.mqtt.client", reason="paho-mqtt is not installed: pip install 'thermoctl[mqtt]'"
        )
        self.got = queue.Queue()
        self.client = client.Client(client.CallbackAPIVersion.VERSION2)
        self.client.on_message = lambda c, u, m: self.got.put((m.topic, m.payload.decode(), m.retain))
        self.client.on_connect = lambda c, *_: c.subscribe("thermoctl/#", qos=1)
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()

    def until(self, topic, wanted):
        """The first message on `topic` of which wanted(text) is true: (text, retained)."""
        deadline = time.monotonic() + LIMIT_S
        while True:
            got, text, retained = self.got.get(timeout=max(0.01, deadline - time.monotonic()))
            if got == topic and wanted(text):
                return text, retained

    def close(self):
        self.client.disconnect()
        self.client.loop_stop()


def test_state_faults_and_availability(settings, running, broker):
    from thermoctl.daemon.views.mqtt import Bridge

    running.arm()
    running.run()
    reader = Reader(broker)
    bridge = Bridge(settings, f"127.0.0.1:{broker}")
    bridge.open()
    bridge.look()
    assert reader.until("thermoctl/simulated/availability", lambda t: t == "online")
    status = json.loads(reader.until("thermoctl/simulated/status", lambda t: True)[0])
    assert status["state"] == "ARMED" and set(status["temperatures_c"]) >= {"coil", "bracket_2"}
    assert reader.until("thermoctl/simulated/faults", lambda t: t == "[]")
    running.backend.broken.add("coil_c")
    running.until(lambda row: row[INDEX["state"]] == 4, "FAULT")
    bridge.look()
    fault = json.loads(reader.until("thermoctl/simulated/faults", lambda t: t != "[]")[0])[0]
    assert fault["name"] == "coil_error" and fault["remedy"]

    # Who comes later is told at once: availability and faults are kept by the broker.
    late = Reader(broker)
    assert late.until("thermoctl/simulated/availability", lambda t: t == "online")[1]
    assert late.until("thermoctl/simulated/faults", lambda t: "coil_error" in t)[1]
    late.close()

    # The daemon goes; then this program, without a word: the broker says so.
    running.stopping.set()
    for thread in running.threads:
        thread.join(LIMIT_S)
    bridge.look()
    assert reader.until("thermoctl/simulated/availability", lambda t: t == "offline")
    bridge._online = None
    bridge.client.publish("thermoctl/simulated/availability", "online", qos=1, retain=True)
    assert reader.until("thermoctl/simulated/availability", lambda t: t == "online")
    bridge.client.socket().shutdown(socket.SHUT_RDWR)
    assert reader.until("thermoctl/simulated/availability", lambda t: t == "offline")
    bridge.close()
    reader.close()


def test_what_is_refused(settings, capsys):
    pytest.importorskip(
        "paho.mqtt.client", reason="paho-mqtt is not installed: pip install 'thermoctl[mqtt]'"
    )
    from thermoctl.daemon.views.mqtt import Bridge

    for arguments, message in (
        ({"broker": "host:port"}, "HOST:PORT"),
        ({"broker": ":1883"}, "HOST:PORT"),
        ({"broker": "localhost", "topic": "a/#"}, "topic"),
    ):
        with pytest.raises(InputError, match=message):
            Bridge(settings, **arguments)
    port = free_port()
    assert cli.main(["mqtt", "--config", str(settings.path), "--broker", f"127.0.0.1:{port}"]) == 2
    assert "cannot be reached" in capsys.readouterr().err
    assert cli.main(["mqtt", "--config", str(settings.path), "--broker", "127.0.0.1", "--rate", "99"]) == 2
