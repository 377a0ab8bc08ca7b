"""Modbus devices, TCP and RTU: registers, coils and discrete inputs read in blocks.

Neighbours are read in one block. The profile gives the word order of a value of several words. Bytes inside a
word are big-endian, by the protocol, unless the profile says otherwise. Sentinel numbers, such as an open
thermocouple's, and status bits make the channel an ERROR while the others stay OK. After a lost or damaged
answer, or while the device is busy, the last values are kept. A refused block is read register by register.
One illegal address therefore does not invalidate its neighbours. thermoctl_hal.modbus.link opens the ports.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from thermoctl_hal.base.amplifier import Commanded
from thermoctl_hal.base.backend import HardwareError, Sample
from thermoctl_hal.base.binding import Binding
from thermoctl_hal.base.device import Device
from thermoctl_hal.base.message import clipped
from thermoctl_hal.base.profile import (
    BIT_KINDS,
    REGISTER_TYPES,
    Assumed,
    Condition,
    Message,
    Modbus,
    Register,
    RegisterMessage,
    typed,
)
from thermoctl_hal.modbus.link import Link, NoAnswer, join, leave
from thermoctl_hal.modbus.read import register_hint

EXCEPTIONS = {
    1: ("illegal function", "try the other 'kind' (input, holding)"),
    2: ("illegal register address", "check 'register' and 'kind'; addresses count from 0"),
    3: ("illegal value", "it may not give so many registers at once: lower 'max_block'"),
    4: ("device failure", "the device reports a failure of its own: check it and its sensors"),
    5: ("acknowledge", "it is still at work on an earlier request: lower 'rate_hz'"),
    6: ("device busy", "another master may be asking it, or we ask too often: lower 'rate_hz'"),
    8: ("memory parity error", "the device's memory is damaged: restart it"),
    10: (
        "gateway path unavailable",
        "the gateway has no line for this unit: check its configuration and 'address'",
    ),
    11: (
        "gateway target silent",
        "no unit of this address answers behind the gateway: check 'address', power and line",
    ),
}
"""Modbus exception codes: the text, and what to do."""
# Exceptions of a busy unit; those after which a request is repeated, without an ERROR.
BUSY, PASSING = (5, 6), (5, 6, 10, 11)
ILLEGAL_ADDRESS, ILLEGAL_VALUE = 2, 3
ILLEGAL_FUNCTION = 1
NOT_OF_A_REGISTER = (ILLEGAL_FUNCTION, *PASSING)
"""Exceptions that no register can cause; after any other the block is read one by one."""
MAX_EXPONENT = 10  # largest value of a scale register: SunSpec allows -10 .. 10, and -32768 for none
MUTE_POLLS = 2  # after so many lost answers, a block that never was answered is requested without its gaps
BUSY_TRIES, BUSY_PAUSE_S = 3, 0.02
LOST_POLLS = 3  # after so many polls without any answer the link is opened again
MAX_BITS = 2000  # largest number of coils in one answer


@dataclass(frozen=True)
class Block:
    """Registers or bits read by one request; `members` are (number of the item, register)."""

    kind: str
    address: int
    count: int
    members: tuple[tuple[int, Register], ...]


def plan_blocks(registers: Iterable[tuple[int, Register]], max_gap: int, max_block: int) -> list[Block]:
    """Plan the fewest requests for (number of the item, register).

    Registers of one kind share a block of up to max_block registers (MAX_BITS bits) over gaps <= max_gap."""
    blocks: list[Block] = []
    for i, r in sorted(registers, key=lambda item: (item[1].kind, item[1].address)):
        last = blocks[-1] if blocks else None
        if (
            last
            and last.kind == r.kind
            and r.address - last.address - last.count <= max_gap
            and r.address + r.words - last.address <= (MAX_BITS if r.kind in BIT_KINDS else max_block)
        ):
            count = max(last.count, r.address + r.words - last.address)
            blocks[-1] = Block(r.kind, last.address, count, (*last.members, (i, r)))
        else:
            blocks.append(Block(r.kind, r.address, r.words, ((i, r),)))
    return blocks


def decode(words: Sequence[int], register: Register) -> float:
    """Return the raw number in `words` (uint16 in the order of the wire, or bits); NaN for invalid BCD."""
    if register.type == "bit":
        return float(words[0])
    ordered = words if register.word_order == "big" else words[::-1]
    letters = f"{'>' if register.byte_order == 'big' else '<'}{len(ordered)}H"
    data = struct.pack(letters, *ordered)
    low, count = register.bits
    if count:
        value = int.from_bytes(data, "big") >> low & (1 << count) - 1
        return float(value - (1 << count) if register.signed and value >> (count - 1) else value)
    if register.type.startswith("bcd"):
        digits = data.hex()
        return float(digits) if digits.isdecimal() else math.nan
    return float(struct.unpack(">" + REGISTER_TYPES[register.type], data)[0])


class ModbusDevice(Device):
    """A register device; `poll` reads every bound channel and blocks up to the profile's timeout."""

    def __init__(self, binding: Binding) -> None:
        super().__init__(binding)
        self.slow = True  # an answer takes milliseconds, a lost one the timeout
        self.counts["lost"] = 0
        self._link: Link | None = None
        self._spec = typed(binding.profile.bus_spec, Modbus)
        sources = [
            (i, typed(b.channel.source, Register))
            for i, b in enumerate(binding.bounds)
            if not isinstance(b.channel.source, Assumed)
        ]
        self._items: list[tuple[int, Register, Condition | None]] = [(i, s, None) for i, s in sources] + [
            (i, s.invalid[0], s.invalid[1]) for i, s in sources if s.invalid
        ]
        """Items to read: (bound channel, register, the test of a status register)."""
        self._exponents = range(
            len(self._items), len(self._items) + sum(s.exponent is not None for _, s in sources)
        )
        """The items that are scale registers."""
        self._items += [(i, s.exponent, None) for i, s in sources if s.exponent is not None]
        self._factors: dict[int, float] = {}  # bound channel -> the factor that its scale register gave
        self._state: dict[int, str] = {}  # bound channel with a status: its fault, '' when good
        self._got: list[tuple[int, float, float]] = []  # readings of this poll: (item, raw number, time)
        self._plan()
        self._lost_polls = 0
        # (kind, address, count) of the blocks that were answered at least once.
        self._heard: set[tuple[str, int, int]] = set()

    def _plan(self) -> None:
        registers = [(k, register) for k, (_, register, _) in enumerate(self._items)]
        self._blocks = plan_blocks(registers, self._spec.max_gap, self._spec.max_block)

    def connect(self) -> None:
        """Open the connection or the serial port. Raises HardwareError."""
        self._link = join(self.binding.port, self.binding.profile.line, self._spec.timeout_s)
        self._lost_polls = 0
        self._state.clear()
        self._factors.clear()
        self._heard.clear()
        self._plan()

    def disconnect(self) -> None:
        """Close the connection, if no other device uses it."""
        link, self._link = self._link, None
        if link is not None:
            leave(link)

    def poll(self, sample: Sample) -> None:
        """Read every block, then store what came.

        A lost answer ends this poll, because a late answer must not be taken for the next block's; the last
        values are kept. Raises HardwareError when the link is gone or LOST_POLLS polls in a row had no
        answer."""
        self._got.clear()
        try:
            self._read_blocks(sample)
        finally:
            self._store(sample)

    def _read_blocks(self, sample: Sample) -> None:
        for block in list(self._blocks):
            try:
                self._read(sample, block)
                self._lost_polls = 0
            except NoAnswer as e:
                self.counts["lost"] += 1
                self._lost_polls += 1
                for k, _ in block.members:
                    self.miss(self._items[k][0], f"{self._named(block)}: {e}")
                if self._lost_polls >= LOST_POLLS:
                    raise HardwareError(f"{self.binding.port}: {self._named(block)}: {e}") from None
                at = self._blocks.index(block)
                again = [block]
                if (
                    self._lost_polls >= MUTE_POLLS
                    and (block.kind, block.address, block.count) not in self._heard
                ):
                    # The device may not answer if a block has gaps.
                    again = plan_blocks(block.members, 0, self._spec.max_block)
                # The next poll starts after it.
                self._blocks = self._blocks[at + 1 :] + self._blocks[:at] + again
                return

    def silence(self) -> str:
        """Report that the poller has posted no reading and no problem yet."""
        return "its poller has posted nothing"

    def _read(self, sample: Sample, block: Block) -> None:
        answer = self._request(block)
        if isinstance(answer, list):
            self._heard.add((block.kind, block.address, block.count))
            self._take(block, answer)
        elif answer not in NOT_OF_A_REGISTER and (
            len(block.members) > 1 or block.count > block.members[0][1].words
        ):
            self._read_singly(sample, block)
        else:
            self._refused(sample, block, answer)

    def _read_singly(self, sample: Sample, block: Block) -> None:
        """Read a refused block's registers one by one.

        From now on ask for the refused registers apart, and for the others without the gaps between them."""
        refused: list[Block] = []
        for member in block.members:
            single = Block(block.kind, member[1].address, member[1].words, (member,))
            answer = self._request(single)
            if isinstance(answer, list):
                self._take(single, answer)
            else:
                refused.append(single)
                self._refused(sample, single, answer)
        bad = {i for b in refused for i, _ in b.members}
        good = plan_blocks((m for m in block.members if m[0] not in bad), 0, self._spec.max_block)
        if not good:
            return  # the answer is not to one of the registers' requests
        at = self._blocks.index(block)
        self._blocks[at : at + 1] = [*good, *refused]

    def _request(self, block: Block) -> list[int] | int:
        """Return the values of a block, or the Modbus exception code that the unit answers with.

        Raises NoAnswer, or HardwareError when the link is gone."""
        if self._link is None:
            raise HardwareError("not connected")
        code = 0
        for _ in range(BUSY_TRIES):
            try:
                self._link.is_urgent = self.is_urgent
                answer = self._link.read(
                    block.kind, block.address, block.count, self.binding.address, self._spec.timeout_s
                )
            except HardwareError:
                self.counts["lost"] += 1
                raise
            if isinstance(answer, list):
                self.counts["frames"] += 1
                return answer
            self.counts["errors"] += 1
            code = answer
            if code not in BUSY:
                break
            time.sleep(BUSY_PAUSE_S)
        return code

    def _take(self, block: Block, words: list[int]) -> None:
        now_s = time.monotonic()
        for k, register in block.members:
            at = register.address - block.address
            self._got.append((k, decode(words[at : at + register.words], register), now_s))

    def _store(self, sample: Sample) -> None:
        """Store the readings of this poll; those whose status register reports a fault are errors."""
        self._store_tests()
        for k, raw, time_s in self._got:
            i, register, test = self._items[k]
            if test is not None or k in self._exponents:
                continue
            factor = 1.0 if register.exponent is None else self._factors.get(i)
            state = self._state.get(i) if register.invalid else ""
            if state:
                self.fail(sample, i, state)
            elif state is None or factor is None:
                what = "status" if state is None else "scale"
                self.miss(i, f"its {what} register has not been read yet")
            elif raw in register.sentinels or math.isnan(raw):
                self.fail(sample, i, f"register {register.address} reads {raw:g}: open or missing sensor")
            elif math.isnan(factor):
                self.fail(sample, i, "its scale register reads no scale: the device has no such value")
            else:
                self.put(sample, i, raw * factor, time_s)

    def _store_tests(self) -> None:
        """Keep what the status registers and the scale registers of this poll say."""
        for k, raw, _ in self._got:
            i, register, test = self._items[k]
            if k in self._exponents:
                self._factors[i] = 10.0**raw if abs(raw) <= MAX_EXPONENT else math.nan
            elif test is not None:
                bits = int(raw) & test.mask
                self._state[i] = (
                    ""
                    if bits == test.value
                    else f"{register.kind} {register.address} reads 0x{bits:X}, a good reading has "
                    f"0x{test.value:X}: the device reports a fault of this channel (open wire?)"
                )

    def _refused(self, sample: Sample, block: Block, code: int) -> None:
        """Note the exception of an answer; it becomes the channel's ERROR when the last reading is stale."""
        name, remedy = EXCEPTIONS.get(code, ("unknown", "see the device's manual"))
        now_s = time.monotonic()
        for k, register in block.members:
            i = self._items[k][0]
            self._state.pop(i, None)
            hint = register_hint(register.address) if code == ILLEGAL_ADDRESS else ""
            text = f"{self._named(block)}: exception {code} ({name}): {remedy}{'; ' if hint else ''}{hint}"
            stale_s = self.binding.bounds[i].channel.stale_after_s
            if code not in PASSING and now_s - sample.time_s[self.roles[i]] > stale_s:
                self.fail(sample, i, text)
            else:
                self.miss(i, text)

    @staticmethod
    def _named(block: Block) -> str:
        what = f"{block.kind} {'input' if block.kind == 'discrete' else ''}".strip()
        what = what if block.kind in BIT_KINDS else f"{block.kind} register"
        if len(block.members) == 1:
            return f"{what} {block.address}"
        return f"{what}s {block.address}..{block.address + block.count - 1}"


class ModbusDrive(Commanded, ModbusDevice):
    """An amplifier whose registers take the command (DAC, servo drive); its poller writes them."""

    def send_message(self, message: Message, command: float) -> None:
        """Write a register, again while the unit is busy.

        Raises HardwareError when the unit refuses it or does not answer."""
        m = typed(message, RegisterMessage)
        if self._link is None:
            raise HardwareError("not connected")
        value = clipped(command if m.value is None else m.value, m.register)
        where = f"{self.binding.port}: writing {m.register.kind} {m.register.address}"
        words, code = encode(value, m.register), 0
        for _ in range(BUSY_TRIES):
            try:
                code = self._link.write(
                    m.function, m.register.address, words, self.binding.address, self._spec.timeout_s
                )
            except NoAnswer as e:
                raise HardwareError(f"{where}: {e}") from None
            if code not in BUSY:
                break
            time.sleep(BUSY_PAUSE_S)
        if code:
            name, remedy = EXCEPTIONS.get(code, ("unknown", "see the device's manual"))
            raise HardwareError(f"{where}: exception {code} ({name}): {remedy}")


def encode(value: float, register: Register) -> list[int]:
    """Return the words (or the bit) of a number, in the order of the wire."""
    if register.type == "bit":
        return [int(value != 0)]
    letter = REGISTER_TYPES[register.type]
    data = struct.pack(">" + letter, value if letter in "fd" else int(value))
    words = list(struct.unpack(f">{register.words}H", data))
    return words if register.word_order == "big" else words[::-1]
