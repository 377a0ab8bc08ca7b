"""Amplifiers that messages command: the order of the messages, without any port.

A device on CAN (DBC file), Modbus or a serial line may take the command. Its profile names the messages for
set-up, enabling, the command, disabling, and the reset of a fault. It also names the channel of the state.

Only a new `enable` enables. An amplifier that leaves the state 'enabled' without our command is disabled. It
stays so until `enable` was withdrawn. The same happens when its state is not reported for longer than the
channel's `stale_after_s`. A fault is reset only while `enable` is False. While disabled, a command of 0 and
the disabling messages are repeated.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from typing import Any

from thermoctl.files.yamlfile import InputError
from thermoctl_hal.base.backend import (
    AMP_DISABLED,
    AMP_ENABLED,
    AMP_FAULT,
    AMP_OFFLINE,
    AMP_QUICK_STOP,
    HardwareError,
    Sample,
)
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.profile import Amplifier, Assumed, Message

REPEAT_S = 0.1  # time between repetitions of enabling and disabling messages
RESET_S = 1.0  # time between attempts to reset a fault
CONFIRM_S = 0.5  # longest time for the amplifier to report that it is off


class Sequencer:
    """State of one amplifier. patience_s: largest age of its reported state, s."""

    def __init__(self, amplifier: Amplifier, patience_s: float) -> None:
        self.amplifier, self._patience_s = amplifier, patience_s
        self.fault = 0.0
        self.restart()

    def restart(self) -> None:
        """Forget the state, after a new connection."""
        self.state = AMP_OFFLINE if self.amplifier.state else AMP_DISABLED
        self._heard_s = self._next_s = self._command_s = self._reset_s = -math.inf
        self._wanted = self._driving = self.left = False
        self._left_to = AMP_OFFLINE

    def observe(self, raw: float, now_s: float) -> float:
        """Take the reported state; return the AMP_* state to show."""
        shown = self.amplifier.state
        self._heard_s = now_s
        if shown is None:
            state = self.state
        elif self.fault:
            state = AMP_FAULT
        else:
            state = next(
                (
                    s
                    for numbers, s in (
                        (shown.enabled, AMP_ENABLED),
                        (shown.disabled, AMP_DISABLED),
                        (shown.quick_stop, AMP_QUICK_STOP),
                    )
                    if raw in numbers
                ),
                AMP_FAULT,
            )
        self.state = state
        if self._driving and not self.left and state != AMP_ENABLED:
            self.left, self._left_to = True, state
        if self._wanted and state == AMP_ENABLED and not self.left:
            self._driving = True
        return self._left_to if self.left and state != AMP_FAULT else state

    def messages(self, drive: float, enable: bool, now_s: float) -> list[tuple[Message, float]]:
        """Return the messages to send now, each with its command in counts."""
        a = self.amplifier
        if not enable:
            self._driving = self.left = False
        elif a.state and self._driving and now_s - self._heard_s > self._patience_s:
            self.left, self._left_to = True, AMP_OFFLINE
        wanted = enable and not self.left
        if wanted != self._wanted:
            self._wanted, self._next_s = wanted, -math.inf
        if wanted and self.state == AMP_ENABLED:
            if now_s < self._command_s + 1.0 / a.command_hz:
                return []
            self._command_s = now_s
            low, high = a.limits
            return [(_command(a), min(max(drive, low), high) / a.scale)]
        if now_s < self._next_s:
            return []
        self._next_s = now_s + REPEAT_S
        messages = [(_command(a), 0.0)]
        if wanted:
            messages += [(m, 0.0) for m in (*a.set_up, *a.enable)]
        else:
            messages += [(m, 0.0) for m in a.disable]
            if self.state == AMP_FAULT and not enable and now_s >= self._reset_s + RESET_S:
                self._reset_s = now_s
                messages += [(m, 0.0) for m in a.reset]
        if a.state is None:
            self.state = AMP_ENABLED if wanted else AMP_DISABLED
        return messages

    def send_again(self) -> None:
        """Let the messages be due at once: the last were not taken."""
        self._next_s = self._command_s = -math.inf

    def off(self) -> list[tuple[Message, float]]:
        """Return the messages that disable, in every state."""
        return [(_command(self.amplifier), 0.0), *((m, 0.0) for m in self.amplifier.disable)]


def _command(a: Amplifier) -> Message:
    if a.command is None:
        raise TypeError("this amplifier is not commanded by messages")
    return a.command


class Commanded:
    """Mixin of drivers: an amplifier commanded by messages. The driver's class implements `send_message`."""

    binding: Binding
    roles: list[int]

    def __init__(self: Any, binding: Binding) -> None:
        """Find the channels of state and fault. Raises InputError where one has no role."""
        super().__init__(binding)  # type: ignore[call-arg]
        amplifier = self.binding.profile.amplifier
        if amplifier is None:
            raise TypeError("a profile with 'drive' was expected")
        names = [b.channel.name for b in self.binding.bounds]
        state = "state" if amplifier.state is None else amplifier.state.channel
        for name in (state, amplifier.fault):
            if name and name not in names:
                role = "amplifier_state" if name == state else "amplifier_fault"
                raise InputError(
                    f"{self.binding.place}: a drive needs its channel '{name}' in the role {role}: without it nobody "
                    "sees that the drive stopped by itself"
                )
        self.state_bound = names.index(state)
        self.fault_bound = names.index(amplifier.fault) if amplifier.fault else -1
        self.is_assumed = isinstance(self.binding.bounds[self.state_bound].channel.source, Assumed)
        stale_s = self.binding.bounds[self.state_bound].channel.stale_after_s
        self.sequencer = Sequencer(amplifier, stale_s)

    def connect(self: Any) -> None:
        """Open the port; the amplifier is disabled by the first `write`."""
        super().connect()  # type: ignore[misc]
        self.sequencer.restart()

    def disconnect(self: Any) -> None:
        """Disable, as far as the port still works, and close it."""
        with contextlib.suppress(OSError, HardwareError):
            self._send_off()
        super().disconnect()  # type: ignore[misc]

    def switch_off(self: Any) -> None:
        """Disable over a link of its own. Raises HardwareError when it is not confirmed, OSError."""
        self.connect()
        sample = Sample(len(self.binding.channels.names))
        try:
            self.confirm_off(lambda: self.poll(sample) if self.slow else self.read(sample, time.monotonic()))
        finally:
            super().disconnect()  # type: ignore[misc]

    def read(self: Any, sample: Sample, now_s: float) -> None:
        """Take what has arrived; an assumed state counts as just reported."""
        super().read(sample, now_s)  # type: ignore[misc]
        if self.is_assumed:
            self.put(sample, self.state_bound, 0.0, now_s)

    def poll(self: Any, sample: Sample) -> None:
        """Read every channel once; an assumed state counts as just reported."""
        super().poll(sample)  # type: ignore[misc]
        if self.is_assumed:
            self.put(sample, self.state_bound, 0.0, time.monotonic())

    def send_message(self, message: Message, command: float) -> None:
        """Send one message; never blocks in a fast device. Raises OSError, HardwareError."""
        raise NotImplementedError

    def put(self: Any, sample: Sample, bound: int, raw: float, time_s: float) -> None:
        """Store a reading; the state's raw number becomes an AMP_* state."""
        if bound == self.state_bound:
            raw = self.sequencer.observe(raw, time_s)
        elif bound == self.fault_bound:
            self.sequencer.fault = raw
        super().put(sample, bound, raw, time_s)  # type: ignore[misc]

    def write(self, drive: float, enable: bool, now_s: float) -> None:
        """Send the messages that are due. Raises OSError, HardwareError."""
        for message, command in self.sequencer.messages(drive, enable, now_s):
            self.send_message(message, command)

    def _send_off(self) -> None:
        """Send all messages that disable, also when one fails or has no valid answer.

        Raises the last HardwareError or OSError then."""
        failed: HardwareError | OSError | None = None
        for message, command in self.sequencer.off():
            try:
                self.send_message(message, command)
            except (HardwareError, OSError) as e:
                failed = e
        if failed is not None:
            raise failed

    def confirm_off(self, read: Callable[[], None]) -> None:
        """Disable, and wait until the amplifier reports that it is off. read: takes what has arrived.

        Raises HardwareError, OSError."""
        end = time.monotonic() + CONFIRM_S
        again = 0.0
        while True:
            now_s = time.monotonic()
            if now_s >= again:
                again = now_s + REPEAT_S
                self._send_off()
            if self.is_assumed:
                return
            read()
            if self.sequencer.fault or self.sequencer.state in (AMP_DISABLED, AMP_QUICK_STOP):
                return
            if now_s > end:
                raise HardwareError(f"{self.binding.port}: the amplifier does not report that it is off")
            time.sleep(0.001)
