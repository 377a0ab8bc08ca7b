"""The straightforward loop, for comparison: pyserial and python-can as their tutorials call them, numpy for the law.

    python tests/bench/realtime/plain_loop.py CPU PRIORITY TICKS ENCODER CAN OUT      rows: deadline, wake, end (int64, ns)

The arithmetic is the short law (predict 12 states, correct, twelve temperatures, PID): less than the daemon's.
"""

import binascii
import ctypes
import os
import struct
import sys
import time

import can
import numpy as np
import serial

PERIOD_S = 1e-3


def main(cpu: str, priority: str, ticks: str, encoder: str, can_port: str, out: str) -> None:
    """Run `ticks` ticks and write their times."""
    port = serial.Serial(encoder, 921600, timeout=0)
    bus = can.Bus(interface="slcan", channel=can_port, bitrate=1_000_000, sleep_after_open=0.1)
    bus.send(can.Message(arbitration_id=0, data=b"\x01\x05", is_extended_id=False))
    os.sched_setaffinity(0, {int(cpu)})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(priority)))
    ctypes.CDLL(None).mlockall(3)
    latency = os.open("/dev/cpu_dma_latency", os.O_WRONLY)
    os.write(latency, bytes(4))
    A, B, C, K = -1e-5 * np.eye(12), np.full(12, 1e-6), np.eye(12), np.linspace(1, 0.1, 12)
    x, v, eps1, d1, position = np.zeros(12), 0.0, 0.0, 0.0, 0.0
    rows = np.zeros((int(ticks), 3), np.int64)
    buffer = b""
    deadline = time.monotonic() + PERIOD_S
    for k in range(int(ticks)):
        while (left := deadline - time.monotonic()) > 0:
            time.sleep(left)
        wake = time.monotonic_ns()
        buffer += port.read(port.in_waiting)
        while (at := buffer.find(b"\xaa\x55")) >= 0 and len(buffer) >= at + 12:
            body, crc = buffer[at + 2 : at + 10], buffer[at + 10 : at + 12]
            if binascii.crc_hqx(body, 0xFFFF) == int.from_bytes(crc, "little"):
                position = struct.unpack("<BHiB", body)[2] * 0.005
            buffer = buffer[at + 12 :]
        try:
            while (message := bus.recv(0)) is not None:
                if message.arbitration_id == 0x185:
                    struct.unpack("<HhI", bytes(message.data))
        except ValueError:  # python-can took half of a line for a frame
            pass
        x = x + A @ x + B * 1.0
        x = x + 0.01 * (0.1 - x[0]) * K
        temperatures = C @ x
        eps = 0.0 - position - temperatures[0]
        d = (eps - eps1) / PERIOD_S
        v = float(np.clip(v + 0.01 * ((eps - eps1) + 0.25 * eps + 0.001 * (d - d1)), -2, 2))
        eps1, d1 = eps, d
        bus.send(can.Message(arbitration_id=0x205, data=struct.pack("<Hi", 0, 0), is_extended_id=False))
        bus.send(can.Message(arbitration_id=0x080, data=b"", is_extended_id=False))
        rows[k] = round(deadline * 1e9), wake, time.monotonic_ns()
        deadline += PERIOD_S
        while deadline < time.monotonic():
            deadline += PERIOD_S
    rows.tofile(out)


if __name__ == "__main__":
    main(*sys.argv[1:])
