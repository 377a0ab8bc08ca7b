"""Keep the law's estimates across a restart: the supervisor saves them, the next loop restores them.

Saved are temperatures, expansion, compensation and the encoders' zeros. Arming, setpoint and controller are
not: a restarted daemon is as safe as a new one.

They are restored only within KEEP_S, after no reboot, and for the same model. The coil's first reading must
also lie within RESUME_LIMIT_C of them (law.resume); otherwise the estimate starts at that reading. The pause
is simulated without power.
"""

from __future__ import annotations

import json
import time
import zlib
from dataclasses import fields
from pathlib import Path

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.control.model import CompensatorModel
from thermoctl.daemon.recorder import decode, encode
from thermoctl.files.safe_file import write_text

KEEP_S = 600.0  # older estimates are useless for the rig's slow parts
EVERY_S = 5.0  # time between two savings by the supervisor
MAX_BYTES = 65536
_BOOT = Path("/proc/sys/kernel/random/boot_id")


def kept_path(settings: Settings) -> Path:
    """Return the file of a daemon's saved estimates, beside its socket."""
    return Path(settings.socket.path).with_suffix(".state")


def _now_s() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def _fingerprint(model: CompensatorModel) -> int:
    """Return the CRC-32 of every field of the model but `meta`, which only describes it."""
    crc = 0
    for f in fields(model):
        if f.name != "meta":
            value = getattr(model, f.name)
            content = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            crc = zlib.crc32(f.name.encode() + content, crc)
    return crc


def save(path: Path, model: CompensatorModel, state: np.ndarray) -> Path:
    """Save a law's snapshot; return the file.

    Raises WriteError when the disk refuses: the next start is cold."""
    saved = {"version": 2, "boot": _boot(), "at_s": _now_s(), "model": _fingerprint(model)}
    text = json.dumps({**saved, "state": encode(state), "crc": zlib.crc32(state.tobytes())})
    write_text(path, text, sync=False)  # not used after a power cut: it is of another boot
    return path


def load(path: Path, model: CompensatorModel) -> tuple[np.ndarray | None, float, str]:
    """Return (snapshot or None, its age in s, the reason when there is none)."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        saved = json.loads(data) if len(data) <= MAX_BYTES else {}
        age_s = _now_s() - float(saved["at_s"])
        if saved["version"] != 2 or saved["boot"] != _boot() or not 0.0 <= age_s <= KEEP_S:
            return None, 0.0, f"older than {KEEP_S:g} s or of another boot"
        if saved["model"] != _fingerprint(model):
            return None, 0.0, "of another model"
        state = decode(saved["state"])
        if saved["crc"] != zlib.crc32(state.tobytes()):
            return None, 0.0, f"{path} is damaged"
        return (state, age_s, "") if np.isfinite(state).all() else (None, 0.0, "not finite")
    except FileNotFoundError:
        return None, 0.0, "none were kept"
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as e:
        return None, 0.0, f"{path} cannot be read ({type(e).__name__})"


def _boot() -> str:
    try:
        return _BOOT.read_text().strip()
    except OSError:
        return ""
