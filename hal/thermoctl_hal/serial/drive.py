"""Amplifiers on a serial line of their own: binary frames or text lines carry the command."""

from __future__ import annotations

import errno
import os

from thermoctl_hal.base.amplifier import Commanded
from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.base.message import serial_bytes
from thermoctl_hal.base.profile import Message
from thermoctl_hal.serial.port import SerialDevice


class SerialDrive(Commanded, SerialDevice):
    """An amplifier on a serial line."""

    def send_message(self, message: Message, command: float) -> None:
        """Send one message. Raises OSError."""
        data = serial_bytes(message, command, self.binding.address)
        if self._fd < 0:
            raise HardwareError("not connected")
        self.sent(data)
        try:
            written = os.write(self._fd, data)
        except BlockingIOError:
            written = 0
        if written < len(data):
            raise OSError(errno.ENOBUFS, "the line takes no data: is command_hz too high for its baud rate?")
