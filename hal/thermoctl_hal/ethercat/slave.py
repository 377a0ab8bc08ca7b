"""Set-up of one EtherCAT slave: identity, objects, mapping and watchdog, as its profile says."""

from __future__ import annotations

import struct
import warnings
from typing import Any

from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.cia402 import CONTROL_WORD
from thermoctl_hal.base.profile import Object, typed
from thermoctl_hal.ethercat.read import Ethercat, Place

OUTPUT_CONTROL = 0x0814  # control byte of sync manager 2, the outputs
TRIGGERS_WATCHDOG = 0x40
RECEIVE_PDO, TRANSMIT_PDO, RECEIVE_ASSIGN, TRANSMIT_ASSIGN = 0x1600, 0x1A00, 0x1C12, 0x1C13
MODE = Object(0x6060)


class SlaveSetUp:
    """The numbers written to a slave in PREOP, and the checks of it in SAFEOP.

    `slave` is pysoem's object in every method."""

    def __init__(self, binding: Binding) -> None:
        self.name, self.position = binding.name, binding.address
        self.spec = typed(binding.profile.bus_spec, Ethercat)
        self.drives = binding.profile.amplifier is not None
        places = [typed(b.channel.source, Place) for b in binding.bounds]
        self._end = max([p.end for p in places] + [p.invalid[0].end for p in places if p.invalid], default=0)

    def is_it(self, slave: Any) -> bool:
        """Return whether the slave has the vendor and product of the profile."""
        return (slave.man, slave.id) == (self.spec.vendor_id, self.spec.product_code)

    def write(self, slave: Any) -> None:
        """Write objects, mapping and watchdog of the slave in PREOP. Raises the errors of pysoem."""
        spec = self.spec

        def put(item: Object, letter: str, value: int) -> None:
            """Write an integer to an object by SDO; `letter`: its format in struct, without byte order."""
            slave.sdo_write(item.number, item.sub, struct.pack("<" + letter, value))

        if spec.command is not None:
            put(MODE, "b", spec.mode)
        for item, letter, value in spec.start_up:
            put(item, letter, value)
        mapped = [(TRANSMIT_ASSIGN, TRANSMIT_PDO, list(spec.transmit.items()))]
        if spec.command is not None:
            mapped.append((RECEIVE_ASSIGN, RECEIVE_PDO, [(CONTROL_WORD, "H"), spec.command]))
        for assign, pdo, entries in mapped if spec.transmit else ():
            put(Object(assign), "B", 0)
            put(Object(pdo), "B", 0)
            for k, ((index, sub), letter) in enumerate(entries, 1):
                put(Object(pdo, k), "I", index << 16 | sub << 8 | 8 * struct.calcsize("<" + letter))
            put(Object(pdo), "B", len(entries))
            put(Object(assign, 1), "H", pdo)
            put(Object(assign), "B", 1)
        if spec.watchdog_s is not None:
            with warnings.catch_warnings(action="ignore"):  # pysoem's: steps of 0.1 ms
                slave.set_watchdog("processdata", spec.watchdog_s * 1e3)

    def check(self, slave: Any) -> None:
        """Compare the slave in SAFEOP with the profile: its sizes and its watchdog. Raises HardwareError."""
        size, wanted = len(slave.input), self.spec.input_bytes
        if size < self._end or (wanted and size != wanted):
            raise HardwareError(
                f"slave {self.position} has {size} bytes of inputs, the profile says "
                f"{wanted or f'at least {self._end}'}: compare its mapping (0x1C13, 0x1A00) with the profile"
            )
        if self.spec.command is None or not self.drives:
            return
        outputs = 2 + struct.calcsize("<" + self.spec.command[1])
        if len(slave.output) != outputs:
            raise HardwareError(
                f"slave {self.position} takes {len(slave.output)} bytes of outputs, {outputs} were mapped"
            )
        if self.spec.watchdog_s is None:
            return
        control, time_ms = slave._fprd(OUTPUT_CONTROL, 1)[0], slave.get_watchdog("processdata")
        if not control & TRIGGERS_WATCHDOG or not time_ms:
            raise HardwareError(
                f"slave {self.position} has no watchdog of its outputs (sync manager 2: 0x{control:02X}, "
                f"{time_ms:g} ms): it would keep its last command. Say watchdog_s: none, and cut its enable input by "
                "a hardware watchdog"
            )
