"""An EtherCAT adapter of this process: its master (pysoem), and the cycle that its devices share.

A cycle sends the outputs of every slave in one frame, which comes back with their inputs. Its working counter
tells whether every slave took part. `exchange` blocks until the frame is back. A lost frame costs up to 8 ms,
at any timeout: the master's socket waits in steps of the kernel's clock. A process of its own therefore
runs the cycle, beside the loop.

    working counter as expected   every slave's inputs are new
    another counter               the states are read: a slave in OP has new inputs, another one is lost
                                  with every slave in OP the frame does not count
    LOST_FRAMES lost in a row     the link is lost
    SILENT_READS without a state  the slave is lost; one alone may be a lost frame

The first device that connects brings every slave to OP. A slave that is lost later comes back alone, by
a thread, while the others stay in the cycle.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, wait
from typing import Any
from weakref import WeakValueDictionary

from thermoctl_hal.base.backend import HardwareError
from thermoctl_hal.ethercat.slave import SlaveSetUp

LOST_FRAMES = 3  # frames in a row without an answer, after which the link counts as lost
SILENT_READS = 3  # reads of the states in a row without an answer, after which a slave counts as lost
CHECK_S = 0.05  # time between two checks of the slaves' states
UP_S = 2.0  # longest time for a slave to reach a state
INIT, PREOP, SAFEOP, OP, ERROR = 1, 2, 4, 8, 16
NAMES = {0: "gone", INIT: "INIT", PREOP: "PREOP", 3: "BOOT", SAFEOP: "SAFEOP", OP: "OP"}
US = 1_000_000


class EthercatBus:
    """The master of one network interface, shared by the devices of this process that use it.

    `described`: set-up by position. `cycle`: number of cycles with valid inputs, the last at `time_s`, s.
    `sick`: positions that are not in OP."""

    def __init__(self, interface: str) -> None:
        self.interface = interface
        self.described: dict[int, SlaveSetUp] = {}
        self.users: set[int] = set()
        self.cycle, self.time_s = 0, -1.0
        self.sick: set[int] = set()
        self._silent: dict[int, int] = {}
        self.lost = self.incomplete = 0
        self._master: Any = None
        self._claim: socket.socket | None = None
        self._missing, self._check_s, self._timeout_us = 0, 0.0, 0
        self._back: tuple[int, Future[None]] | None = None
        self._ending = threading.Event()

    def slave(self, position: int) -> Any:
        """Return a slave of the open master."""
        if self._master is None:
            raise HardwareError("not connected")
        return self._master.slaves[position - 1]

    def join(self, position: int, slaves: Iterable[SlaveSetUp]) -> None:
        """Open and configure the bus for its first user, or bring this slave back.

        slaves: set-up of every slave that a device of the interface describes. Raises HardwareError."""
        if self._master is not None and self._ending.is_set():
            self._end()
        if self._master is None:
            self.described = {s.position: s for s in slaves}
            self._timeout_us = round(US * max(s.spec.timeout_s for s in self.described.values()))
            self._open()
        else:
            self._bring_back(position)
        self.users.add(position)

    def leave(self, position: int) -> None:
        """End the use of a slave; its last user sends every slave to INIT and closes the interface."""
        self.users.discard(position)
        if not self.users and self._master is not None:
            self._ending.set()
            if self._back is not None:
                wait([self._back[1]], UP_S)
            with contextlib.suppress(Exception):  # the link may be gone
                self._master.state = INIT
                self._master.write_state()
            with contextlib.suppress(HardwareError):  # `join` tries again
                self._end()

    def _end(self) -> None:
        """Close, unless the thread still uses the master. Raises HardwareError."""
        if self._back is not None and not self._back[1].done():
            raise HardwareError(f"{self.interface}: slave {self._back[0]} is still being brought back")
        self._close()

    def reset(self, position: int) -> None:
        """Send every slave to INIT, which disables a drive, and close. Raises HardwareError."""
        self._start()
        try:
            if not 0 < position <= self._find():
                raise HardwareError(f"{self.interface}: slave {position} does not answer")
        finally:
            self._close()

    def _start(self) -> None:
        import pysoem  # EthercatDevice has reported a missing one

        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0thermoctl-ethercat-{self.interface}")  # ends with this process
        except OSError:
            claim.close()
            raise HardwareError(
                f"{self.interface}: another process is the EtherCAT master of this interface: end it first"
            ) from None
        master = pysoem.Master()
        master.always_release_gil = True
        try:
            master.open(self.interface)
        except ConnectionError:
            claim.close()
            raise HardwareError(
                f"{self.interface}: cannot be opened: give a network interface (`ip link` lists them), and this "
                "program the capability CAP_NET_RAW"
            ) from None
        self._master, self._claim = master, claim

    def _find(self) -> int:
        return max(0, self._master.config_init())

    def _close(self) -> None:
        master, self._master, claim, self._claim = self._master, None, self._claim, None
        if master is not None:
            master.close()
        if claim is not None:
            claim.close()

    def _open(self) -> None:
        self._back = None
        self._ending.clear()
        self._start()
        try:
            self._configure()
        except BaseException:
            self._close()
            raise
        self.sick, self._silent, self._missing = set(), {}, 0

    def _configure(self) -> None:
        count = self._find()
        if not count:
            raise HardwareError(f"{self.interface}: no slave answers: check its cable and power")
        for position, wanted in self.described.items():
            if position > count:
                raise HardwareError(
                    f"{self.interface}: slave {position} is not there; found: {self._found()}"
                )
            slave = self.slave(position)
            if not wanted.is_it(slave):
                raise HardwareError(
                    f"{self.interface}: slave {position} is another device than {wanted.name}, vendor "
                    f"0x{wanted.spec.vendor_id:X} product 0x{wanted.spec.product_code:08X}; found: {self._found()}: "
                    "check 'address' and the profile"
                )
            slave.add_emergency_callback(lambda _: None)  # the status word and error code say it, too
            slave.setup_func = wanted.write
        self._coe(self._master.config_map)
        for position in self.described:
            self._reach(position, SAFEOP)
            self._check(position)
        self.exchange()
        for position in range(1, count + 1):
            self._request(position, OP)
        for position in self.described:
            self._reach(position, OP)

    def _check(self, position: int) -> None:
        try:
            self.described[position].check(self.slave(position))
        except HardwareError as e:
            raise HardwareError(f"{self.interface}: {e}") from None
        except Exception as e:  # the errors of pysoem have no common base
            raise HardwareError(f"{self.interface}: slave {position} does not answer ({e!r})") from None

    def _found(self) -> str:
        return ", ".join(
            f"{k} {s.name} (0x{s.man:X}, 0x{s.id:08X})" for k, s in enumerate(self._master.slaves, 1)
        )

    def _coe(self, act: Callable[[], object]) -> None:
        """Run a set-up over the slaves' mailboxes. Raises HardwareError with the slave's reason."""
        try:
            act()
        except Exception as e:  # the errors of pysoem have no common base
            reasons = "; ".join(map(_reason, getattr(e, "error_list", [e])))
            raise HardwareError(f"{self.interface}: {reasons}") from None

    def _request(self, position: int, state: int) -> None:
        slave = self.slave(position)
        slave.state = state
        slave.write_state()

    def _reach(self, position: int, state: int) -> None:
        """Wait for a state, exchanging in OP. Raises HardwareError."""
        end = time.monotonic() + UP_S
        while True:
            self._master.read_state()
            if self.slave(position).state == state:
                return
            is_over = time.monotonic() > end or self._ending.is_set()
            if self.slave(position).state & ERROR or is_over:
                raise HardwareError(
                    f"{self.interface}: {self.problem(position)}, {NAMES[state]} was expected"
                )
            if state == OP and self._back is None:  # else the poller runs the cycles
                self.exchange()
            time.sleep(0.001)

    def exchange(self) -> None:
        """Run one cycle. Raises HardwareError when the frames do not come back."""
        if self._master is None:
            raise HardwareError("not connected")
        self._master.send_processdata()
        counter = self._master.receive_processdata(self._timeout_us)
        now_s = time.monotonic()
        if counter < 0:
            self.lost += 1
            self._missing += 1
            if self._missing >= LOST_FRAMES:
                raise HardwareError(f"{self.interface}: frames do not come back: check cable and power")
            return
        self._missing = 0
        is_complete = counter == self._master.expected_wkc
        if not is_complete or now_s - self._check_s >= CHECK_S:
            self._check_s = now_s
            self._master.read_state()
            self.sick = {k for k, s in enumerate(self._master.slaves, 1) if self._is_sick(k, s.state)}
        if is_complete or self.sick:
            self.cycle, self.time_s = self.cycle + 1, now_s
        else:
            self.incomplete += 1

    def _is_sick(self, position: int, state: int) -> bool:
        """Return whether a slave is in another state than OP, or answered none of SILENT_READS reads."""
        self._silent[position] = 0 if state else self._silent.get(position, 0) + 1
        return state not in (0, OP) or self._silent[position] >= SILENT_READS

    def problem(self, position: int) -> str:
        """Say in which state a slave is, and why."""
        slave = self.slave(position)
        state, code = slave.state, slave.al_status
        name = NAMES.get(state & 0x0F, f"0x{state:X}")
        if not state:
            return f"slave {position} does not answer: check its cable and power"
        if not state & ERROR:
            return f"slave {position} is in {name}"
        import pysoem

        return (
            f"slave {position} is in {name} with error 0x{code:04X} ({pysoem.al_status_code_to_string(code)})"
        )

    def _bring_back(self, position: int) -> None:
        """Start to bring a slave back, or end it when it is in OP. Raises HardwareError until then.

        It takes seconds, in which the other slaves need their commands: a thread does it, one slave at a
        time. The master locks its frames; it is made for such a thread beside the cycle."""
        if self._back is None:
            done: Future[None] = Future()
            self._back = position, done
            threading.Thread(target=_settle, args=(done, self._revive, position), daemon=True).start()
        busy, done = self._back
        if busy != position or not done.done():
            raise HardwareError(f"{self.interface}: slave {busy} is being brought back")
        self._back = None
        done.result()
        self.sick.discard(position)

    def _revive(self, position: int) -> None:
        """Bring a slave back to OP: after an error, a broken cable or a restart. Raises HardwareError."""
        slave = self.slave(position)
        self._master.read_state()
        if not slave.state and slave.recover() <= 0:
            raise HardwareError(f"{self.interface}: {self.problem(position)}")
        self._master.read_state()
        if slave.state & 0x0F in (SAFEOP, OP):
            if slave.state & ERROR:
                # The ERROR bit in a request acknowledges the slave's error.
                self._request(position, SAFEOP | ERROR)
        else:
            self._coe(slave.reconfig)
        if slave.state != OP:
            self._reach(position, SAFEOP)
        self._check(position)
        self._request(position, OP)
        self._reach(position, OP)


def _settle(done: Future[None], act: Callable[[int], None], position: int) -> None:
    try:
        act(position)
    except BaseException as e:  # the poller raises it at its next attempt
        done.set_exception(e)
    else:
        done.set_result(None)


def _reason(error: Any) -> str:
    where = f"slave {getattr(error, 'slave_pos', '?')}"
    if hasattr(error, "abort_code"):
        return (
            f"{where} refuses object 0x{error.index:04X}:{error.subindex}: abort 0x{error.abort_code:08X}, "
            f"{error.desc}: check the profile's objects and values against the manual"
        )
    return f"{where} does not answer its mailbox ({error!r}): check its manual for CANopen over EtherCAT"


_BUSES: WeakValueDictionary[str, EthercatBus] = WeakValueDictionary()
_LOCK = threading.Lock()


def bus_of(interface: str) -> EthercatBus:
    """Return this process's bus of an interface, the same for all its devices."""
    with _LOCK:
        return _BUSES.setdefault(interface, EthercatBus(interface))
