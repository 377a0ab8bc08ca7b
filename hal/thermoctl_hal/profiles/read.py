"""Read and check a device profile: `load_profile`, and two readers for each bus."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import Section
from thermoctl_hal.base.key import take
from thermoctl_hal.base.profile import Assumed, BusSpec, Channel, Dbc, DbcSource, Profile, Source, typed
from thermoctl_hal.base.text_file import while_same
from thermoctl_hal.can.read import check_unit
from thermoctl_hal.profiles.buses import BUSES, part
from thermoctl_hal.profiles.keys import PROFILE
from thermoctl_hal.profiles.read_drive import read_amplifier
from thermoctl_hal.serial.read import read_line

FORMAT = "thermoctl-device/1"
_parsed = while_same(yamlfile.load)
STATE = "state"  # channel of an amplifier that reports no state


def load_profile(path: str | Path) -> Profile:
    """Read and check a profile. Raises InputError with file, line and what was expected."""
    top = Section(_parsed(Path(path)), "device profile")
    if (stated := top.text("format")) != FORMAT:
        raise top.get("format").error(f"format: '{FORMAT}' was expected, found '{stated}'")
    bus = top.text("bus", choices=BUSES)
    k = take(top, PROFILE["profile"])
    read_source: _ReadSource = part(BUSES[bus].source)
    spec: BusSpec = part(BUSES[bus].spec)(top, Path(path).parent)
    channels = {name: _channel(name, s, spec, read_source) for name, s in top.sections("channels").items()}
    if not channels:
        raise top.get("channels").error("channels: at least one was expected")
    amplifier = read_amplifier(top, spec, channels)
    if amplifier is not None and amplifier.command is not None and amplifier.state is None:
        if STATE in channels:
            raise top.get("channels").error(
                f"channels: '{STATE}' is the name of the assumed state of the drive"
            )
        rate = amplifier.command_hz
        stale = max(1.0, 3.0 / rate)
        channels[STATE] = Channel(STATE, "1", 1.0, 0.0, (0.0, 3.0), rate, stale, Assumed(), top.node.place)
    cited = k["manual"], k["edition"], k["place"]
    if any(cited[1:]) and not cited[0]:
        raise top.get("channels").error("manual: the document of 'edition' and 'place' was expected")
    profile = Profile(
        k["vendor"], k["model"], bus, channels, spec, read_line(top), amplifier, str(path), *cited
    )
    top.end()
    return profile


def _channel(name: str, s: Section, spec: BusSpec, read_source: _ReadSource) -> Channel:
    k = take(s, PROFILE["channel"])
    rate, stale = k["rate_hz"], k["stale_after_s"]
    if stale < 1.0 / rate:
        raise s.get("stale_after_s").error(
            f"stale_after_s: {stale:g} s is shorter than the period of rate_hz "
            f"({1 / rate:g} s): every reading would be stale"
        )
    if k["scale"] == 0.0:
        raise s.get("scale").error("scale: 0 makes every reading the same")
    channel = Channel(
        name, k["unit"], k["scale"], k["offset"], k["range"], rate, stale, read_source(s, spec), s.node.place
    )
    if isinstance(spec, Dbc):
        source = typed(channel.source, DbcSource)
        check_unit(s, spec, source.message, source.signal, channel.unit, channel.scale, channel.offset)
    s.end()
    return channel


_ReadSource = Callable[[Section, BusSpec], Source]
