"""A recording as hardware: its samples arrive when the clock reaches their times; commands are ignored.

A column has the role of its own name, unless `hal.roles` maps it as `column: role`. A unit that differs from
the role's is given in brackets, as `q: position_um [m]`. A missing cell means: no new reading of that sensor.
After the last row every channel is stale and `finished` is True.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from thermoctl.configuration.settings import Settings
from thermoctl.files.yamlfile import InputError, suggest
from thermoctl.recording.files import read_table
from thermoctl.recording.table import Table
from thermoctl.rig.channels import DEFAULT, Channels
from thermoctl_hal.base.backend import OK, STALE, Sample
from thermoctl_hal.base.units import role_units

STALE_PERIODS = 5  # a channel is stale after this many of its usual (median) periods without a reading


def replay_backend(settings: Settings) -> ReplayBackend:
    """Make the back end `replay`. Raises InputError: no such file, or no column with a role."""
    table = read_table(Path(settings.path).parent / settings.hal.recording)
    return ReplayBackend(table, settings.hal.roles, settings.channels)


class ReplayBackend:
    """`thermoctl_hal.base.backend.Backend` over a Table."""

    def __init__(self, table: Table, roles: Mapping[str, str], channels: Channels = DEFAULT) -> None:
        for column in roles:
            if column not in table.columns:
                raise InputError(
                    f"{table.path}: no column '{column}' for hal.roles{suggest(column, table.columns)}; "
                    f"columns: {', '.join(table.columns)}"
                )
        self.roles = channels.index
        self.sample, self.finished = Sample(len(channels.names)), False
        self._t = table.t - table.t[0]
        self._channels: list[tuple[int, np.ndarray, float]] = []  # role, values (N,), greatest valid age in s
        for column, values in table.columns.items():
            role, factor, shift = self._role(table, column, roles.get(column, column))
            if role in self.roles:
                times = self._t[np.isfinite(values)]
                period = float(np.median(np.diff(times))) if len(times) > 1 else math.inf
                self._channels.append((self.roles[role], values * factor + shift, STALE_PERIODS * period))
        if not self._channels:
            raise InputError(
                f"{table.path}: no column plays a role; say which in hal.roles "
                f"(columns: {', '.join(table.columns)}; roles: {', '.join(self.roles)})"
            )
        taken = [r for r, _, _ in self._channels]
        if twice := {channels.names[r] for r in taken if taken.count(r) > 1}:
            raise InputError(f"{table.path}: hal.roles gives {', '.join(sorted(twice))} to two columns")
        self._next, self._start_s = 0, math.nan

    def _role(self, table: Table, column: str, text: str) -> tuple[str, float, float]:
        match = re.fullmatch(r"(\w+)(?: \[([^]]+)\])?", text.strip())
        role = match[1] if match else text
        if text != column and role not in self.roles:
            raise InputError(
                f"{table.path}: hal.roles: '{role}' is no role{suggest(role, self.roles)}; "
                f"roles: {', '.join(self.roles)}"
            )
        if match is None or match[2] is None:
            return role, 1.0, 0.0
        units = role_units(role)
        if match[2] not in units:
            raise InputError(
                f"{table.path}: hal.roles: column '{column}' in {match[2]}: {role} takes {' or '.join(units)}"
            )
        return role, *units[match[2]]

    def open(self) -> None:
        """Start with the first row."""
        self._next, self._start_s, self.finished = 0, math.nan, False
        for role, _, _ in self._channels:
            self.sample.status[role] = STALE

    def read(self, now_s: float) -> Sample:
        """Take the readings up to `now_s`; the first read takes the first row."""
        sample = self.sample
        sample.fresh[:] = False
        if math.isnan(self._start_s):
            self._start_s = now_s
        begin, t = self._next, now_s - self._start_s + 1e-9
        end = begin + 1 if begin < len(self._t) and self._t[begin] <= t else begin
        if end < len(self._t) and self._t[end] <= t:  # more than one row since the last read
            end = int(np.searchsorted(self._t, t, "right"))
        self._next = end
        self.finished = end == len(self._t) and t > self._t[-1] + 2e-9
        for role, values, stale_s in self._channels:
            for i in range(end - 1, begin - 1, -1):
                value = values[i]
                if value == value:
                    sample.value[role], sample.time_s[role] = value, self._start_s + self._t[i]
                    sample.fresh[role], sample.status[role] = True, OK
                    break
            if self.finished or now_s - sample.time_s[role] > stale_s:
                sample.status[role] = STALE
        return sample

    def write(self, drive: float, enable: bool) -> None:
        """Ignore the command: a recording takes none."""

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def problem(self, role: str) -> str:
        """Say why a channel has no new reading."""
        status = self.sample.status[self.roles[role]]
        if status == OK:
            return ""
        if status == STALE:
            return f"{role}: the recording {'has ended' if self.finished else 'has no sample here'}"
        return f"{role}: not in the recording"

    def counters(self) -> dict[str, int]:
        """Return the number of rows played."""
        return {"replay.rows": self._next}
