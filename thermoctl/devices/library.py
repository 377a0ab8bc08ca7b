"""`thermoctl devices list | show | search`: the profiles that come with the program."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import InputError, load, suggest
from thermoctl_hal.base.profile import Profile
from thermoctl_hal.profiles.read import load_profile

EXIT_OK, EXIT_NONE = 0, 1
FOLDERS = ("config/devices/library", "config/devices")


def profiles() -> Iterator[tuple[str, Profile]]:
    """Return every shipped profile with its name."""
    for folder in FOLDERS:
        for path in sorted(shipped(folder).glob("*.yaml")):
            yield path.stem, load_profile(path)


def cited() -> list[str]:
    """Return the names of the library's profiles that state manual, edition and place of their facts."""
    folder = shipped(FOLDERS[0])
    return sorted(p.stem for p in folder.glob("*.yaml") if load_profile(p).is_cited)


def find(name: str) -> Path:
    """Return the file of a profile: a path, or the name of a shipped one. Raises InputError."""
    path = Path(name)
    if path.is_file():
        return path
    by_name = {p.stem: p for folder in FOLDERS for p in shipped(folder).glob("*.yaml")}
    if name not in by_name:
        raise InputError(
            f"{name}: no file, and no profile of the library{suggest(name, by_name)}: see `thermoctl devices list`"
        )
    return by_name[name]


def _rows() -> Iterator[tuple[str, str]]:
    """Return (row of the list, searched words) of each profile, from its text alone."""
    for folder in FOLDERS:
        for path in sorted(shipped(folder).glob("*.yaml")):
            p = load(path).plain()
            kind = "amplifier" if "drive" in p else "sensor"
            source = " ".join(str(p.get(key, "")) for key in ("manual", "edition", "place"))
            row = f"{path.stem:30} {p['bus']:14} {kind:9} {p.get('vendor', '')} {p.get('model', '')}"
            yield row, " ".join((row, source, *p["channels"])).lower()


def list_all(_args: object = None) -> int:
    """Print every profile of the library."""
    for row, _ in _rows():
        print(row)
    return EXIT_OK


def search(words: list[str]) -> int:
    """Print the profiles in which every word stands; return 1 when there is none.

    Searched are name, vendor, model, bus, manual and channels."""
    count = 0
    for row, text in _rows():
        if all(w.lower() in text for w in words):
            print(row)
            count += 1
    if not count:
        print(f"no profile with {' '.join(words)}: write one with `thermoctl devices new`")
    return EXIT_OK if count else EXIT_NONE


def show(name: str) -> int:
    """Print a profile: its file, where its facts come from, its channels, and the text of the file."""
    path = find(name)
    profile = load_profile(path)
    print(f"{profile.vendor} {profile.model}\nfile: {path}\nfrom: {profile.source or 'not stated'}")
    for c in profile.channels.values():
        low, high = c.range
        print(
            f"  {c.name:20} {c.unit:6} {low:g} .. {high:g}, {c.rate_hz:g} Hz, stale after {c.stale_after_s:g} s"
        )
    amplifier = profile.amplifier
    if amplifier is not None:
        low, high = amplifier.limits
        stop = (
            "cannot stop by itself"
            if amplifier.watchdog_s is None
            else f"stops by itself after {amplifier.watchdog_s:g} s"
        )
        print(f"  command {low:g} .. {high:g} {amplifier.unit}; {stop}")
    print(f"\n{path.read_text(encoding='utf-8')}", end="")
    return EXIT_OK
