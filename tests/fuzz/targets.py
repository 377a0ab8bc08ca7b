"""What reads bytes from outside, as functions of bytes: each may refuse with the error meant for it, and nothing else.

    python -m tests.fuzz.targets NAME [--seconds 20] [--seed 1] [--replay FILE]

A target gets bytes that are damaged seeds (atheris, which sees which branches they reach, where it is installed; else our own
damage). An exception that is not meant, an input that takes over LIMIT_S or more than LIMIT_MB of memory ends the run, with the
input kept in build/fuzz. `make fuzz` runs all.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "build" / "fuzz"
LIMIT_S, LIMIT_MB = 5, 1024
MAX_INPUT = 20_000

with contextlib.suppress(ImportError):
    import atheris

FOLDER = Path(tempfile.mkdtemp(prefix="thermoctl-fuzz-"))


def _file(data: bytes, suffix: str) -> Path:
    path = FOLDER / f"input{suffix}"
    path.write_bytes(data)
    return path


def plant() -> tuple[Callable[[bytes], Any], list[bytes]]:
    """A plant file: read, checked, its units counted."""
    from thermoctl.plant import load

    seeds = [p.read_bytes() for p in sorted((ROOT / "config/plants").glob("*.yaml"))]
    seeds.append(
        b"format: thermoctl-plant/1\ntitle: a\ninputs: {u: {unit: W}}\nparameters: {C: {value: 1, unit: J/K}}\n"
        b"nodes: {T: {unit: degC, storage: C, initial: 20}}\nflows: {q: {into: T, rate: u * (1 - T / 3), unit: W}}\n"
        b"outputs: {y: {value: T, unit: degC}}\n"
    )
    return (lambda data: load(_file(data, ".yaml"))), seeds


def config() -> tuple[Callable[[bytes], Any], list[bytes]]:
    """A configuration, with its device profiles and faults."""
    from thermoctl.configuration.settings import effective, load_settings
    from thermoctl.daemon.tick.assemble import law_parameters
    from thermoctl_hal.profiles.bind import bind
    from thermoctl_hal.profiles.read import load_profile
    from thermoctl_hal.simulated.faulty import schedule

    def one(data: bytes) -> None:
        settings = load_settings(_file(data, ".yaml"))
        effective(settings)
        law_parameters(settings)
        for node in settings.hal.devices:
            bind(node, ROOT / "config")
        schedule(settings.hal.faults)

    def either(data: bytes) -> None:
        if data[:1] == b"p":
            load_profile(_file(data[1:], ".yaml"))
        else:
            one(data)

    seeds = [p.read_bytes() for p in (ROOT / "config").glob("*.yaml") if p.name != "experiments.yaml"]
    return either, seeds + [b"p" + p.read_bytes() for p in (ROOT / "config/devices").glob("*.yaml")]


def expression() -> tuple[Callable[[bytes], Any], list[bytes]]:
    """An expression: read, written again, differentiated."""
    from thermoctl.plant.expression import ExpressionError, derivative, names, parse

    def one(data: bytes) -> None:
        with contextlib.suppress(ExpressionError):
            tree = parse(data.decode("utf-8", "replace"))
            for name in sorted(names(tree))[:2]:
                str(derivative(tree, name))

    return one, [
        b"k*(a-b)",
        b"min(max(u, -U), U) * exp(-x**2/2)",
        b"table(x, [0, 1, 2], [3, 4, 5]) + delay(u, 3) - first(T)",
        b"sign(v)*F*tanh(v/1e-3) + step(x - 2)*(x > 3) + 1.5e-3 + pi*t",
        b"((((a))))**-2**b",
    ]


def _cut(data: bytes) -> list[bytes]:
    """Pieces as a line delivers them: the first bytes say how long."""
    sizes, rest, pieces = data[:4], data[4:], []
    k = 0
    while rest:
        size = 1 + (sizes[k % len(sizes)] if sizes else 7)
        pieces.append(rest[:size])
        rest, k = rest[size:], k + 1
    return pieces


def serial() -> tuple[Callable[[bytes], Any], list[bytes]]:
    """Encoder frames and text lines in any pieces; what the framer keeps stays small."""
    from thermoctl_hal.base.line import LineReader
    from thermoctl_hal.base.profile import BinaryFrame
    from thermoctl_hal.base.wire import Framer

    fields = (("sequence", "uint16"), ("counts", "int32"), ("status", "uint8"))
    specs = [
        BinaryFrame(b"\xaa\x55", fields, sequence="sequence"),
        BinaryFrame(b"\xaa", fields, has_length=False, crc="modbus"),
        BinaryFrame(
            b"\0\0\0\0\0\0\0\0", (("a", "float64"), ("b", "int64")), endian=">", crc="xmodem", crc_endian=">"
        ),
    ]

    def one(data: bytes) -> None:
        for spec in specs:
            framer = Framer(spec)
            for piece in _cut(data):
                framer.feed(piece)
                assert framer.pending <= 9000, framer.pending
        reader = LineReader()
        for piece in _cut(data):
            assert all(len(line) <= 1024 for line in reader.feed(piece))

    frames = b"".join(Framer(specs[0]).encode(k, k * 1000, 0) for k in range(5))
    return one, [
        b"\x05\x09\x01\x40" + frames,
        b"\x20\x20\x20\x20V=+3.1250 A=+0.6250\r\nV=1e9 A=\n",
        b"\xff" * 4 + b"\xaa\x55\x07" * 300,
    ]


def slcan() -> tuple[Callable[[bytes], Any], list[bytes]]:
    """An adapter's answers, and a drive's frames behind them."""
    from thermoctl_hal.base.cia402 import drive_state, next_control_word
    from thermoctl_hal.base.wire import SlcanParser, encode_slcan

    def one(data: bytes) -> None:
        parser = SlcanParser()
        for piece in _cut(data):
            for can_id, body in parser.feed(piece):
                assert 0 <= can_id < 1 << 32 and len(body) <= 8
                word = int.from_bytes(body[:2], "little")
                assert (
                    drive_state(word) in (0.0, 1.0, 2.0, 3.0)
                    and 0 <= next_control_word(word, bool(word & 1)) <= 0xFF
                )

    frames = b"".join(
        encode_slcan(i, bytes(range(n))) for i, n in ((0x185, 6), (0x705, 1), (0x9FFFFFFF, 8), (0, 0))
    )
    return one, [
        b"\x07\x01\x20\x03" + frames + b"z\r\aZ\rV1013\rF00\r",
        b"\x40" * 4 + b"t1238" + b"00" * 8 + b"A5F3\r",
    ]


def modbus() -> tuple[Callable[[bytes], Any], list[bytes]]:
    """A Modbus device whose answers are these bytes, over TCP (one connection a try) as the poller sees it."""
    import socket
    import threading

    from thermoctl.files import yamlfile
    from thermoctl_hal.base.backend import HardwareError, Sample
    from thermoctl_hal.modbus.device import ModbusDevice
    from thermoctl_hal.profiles.bind import bind

    listener = socket.create_server(("127.0.0.1", 0))
    answer = [b""]

    def serve() -> None:
        while True:
            connection, _ = listener.accept()
            with connection, contextlib.suppress(OSError):
                request = connection.recv(260)
                connection.sendall(answer[0].replace(b"\xf0\x0d", request[:2]))

    threading.Thread(target=serve, daemon=True).start()
    text = (
        f"{{profile: devices/thermocouples-modbus-8.yaml, port: 'tcp:127.0.0.1:{listener.getsockname()[1]}', "
        "roles: {thermocouple_1: coil_c, thermocouple_2: bobbin_c}}"
    )
    device = ModbusDevice(bind(yamlfile.loads(text), ROOT / "config"))
    device._spec = replace(device._spec, timeout_s=0.05)

    def one(data: bytes) -> None:
        answer[0], sample = data, Sample()
        try:
            device.connect()
            device.poll(sample)
        except HardwareError:
            pass
        finally:
            device.disconnect()
        assert ((sample.value != sample.value) | (abs(sample.value) < 1e4)).all()

    good = b"\xf0\x0d\0\0\0\x07\x01\x04\x04\x08\xb1\x08\xa0"
    return one, [
        good,
        b"\xf0\x0d\0\0\0\x03\x01\x84\x02",
        good[:9],
        b"\xf0\x0d\0\0\xff\xff\x01\x04\xff",
        b"\xf0\x0d\0\0\0\x07\x01\x04\x04\x7f\xff\x80\x00",
    ]


def _recording(suffix: str) -> tuple[Callable[[bytes], Any], list[bytes]]:
    import numpy as np
    import pyarrow as pa

    from thermoctl.recording.files import read_table, write_table
    from thermoctl.recording.reader import info
    from thermoctl.recording.table import Table

    table = Table("a", "a", np.arange(40.0), {"x": np.sin(np.arange(40.0)), "y": np.full(40, np.nan)})
    path = FOLDER / f"seed{suffix if suffix != '.arrows' else '.arrow'}"
    write_table(str(path), table)
    seeds = [path.read_bytes()]
    if suffix == ".csv":
        seeds += [b"# a\nt,x\n0,1\n1,\n2,nan\n", b"t;x\n0;1\n", b't,"x ""y"""\n0,1e400\n']
    if suffix == ".arrows":
        sink = io.BytesIO()
        columns = pa.table({"t_s": np.arange(50.0), "wall_s": np.arange(50.0), "x": np.zeros(50)})
        with pa.ipc.new_stream(
            sink, columns.schema, options=pa.ipc.IpcWriteOptions(compression="zstd")
        ) as stream:
            stream.write_table(columns, max_chunksize=20)
        seeds.append(sink.getvalue())

    def one(data: bytes) -> None:
        from thermoctl.files.yamlfile import InputError

        read = _file(data, suffix)
        with contextlib.suppress(InputError):
            read_table(str(read))
        if suffix == ".arrows":
            info(read)

    return one, seeds


def commands() -> tuple[Callable[[bytes], Any], list[bytes]]:
    """Requests to the daemon's socket, on a ring with one row."""
    import numpy as np

    from thermoctl.configuration.settings import load_settings
    from thermoctl.daemon import command_server as room
    from thermoctl.daemon.tick.shared import Shared
    from thermoctl.rig.signals import SIGNALS

    settings = load_settings(ROOT / "config/simulated.yaml")
    shared = Shared.create(f"thermoctl-fuzz-{os.getpid()}")
    shared.remove()
    shared.ring.write(np.zeros(len(SIGNALS)))
    room.ANSWER_S = 0.001  # nobody takes the commands

    def refuse(*_: Any) -> Any:
        raise room.InputError("no file")

    obey = room.Commands(shared, settings, refuse, lambda *a, **k: None)

    def one(data: bytes) -> None:
        shared.areas["mail_counters"][:] = 0
        for line in data.split(b"\n"):
            found = obey.answer(line, "uid 0 pid 0")
            assert isinstance(found["ok"], bool) and len(json.dumps(found)) < 1_000_000

    return one, [
        b'{"command": "status"}\n{"command": "setpoint", "value": 1e3}\n{"command": "arm"}\n{"command": "latency"}',
        b'{"command": "setpoint", "value": NaN}\n{"command": ["x"]}\n[[[[1]]]]\n{"command": "reload"}\n'
        b'{"command": "disarm", "value": "\\ud800"}',
    ]


def metadata() -> tuple[Callable[[bytes], Any], list[bytes]]:
    """What a recording says of its law, and the estimates that a daemon kept."""
    import numpy as np

    from thermoctl.control.law import Law
    from thermoctl.control.model import Parameters, zero_model
    from thermoctl.daemon import keep
    from thermoctl.daemon.offline.replay import replay
    from thermoctl.daemon.recorder import law_metadata
    from thermoctl.files.yamlfile import InputError
    from thermoctl.rig.signals import SIGNALS

    model, parameters = zero_model(), Parameters(kp=0.1, ti_s=1.0, td_s=0.0, output_limit=1.0)
    state = Law(model, parameters, 1e-3).snapshot()
    keep.save(FOLDER / "seed.state", model, state)

    def one(data: bytes) -> None:
        if data[:1] == b"k":
            found, age_s, why = keep.load(_file(data[1:], ".state"), model)
            if found is not None:
                with contextlib.suppress(ValueError):
                    Law(model, parameters, 1e-3).resume(found, age_s)
        else:
            with contextlib.suppress(InputError):
                replay(np.zeros((3, len(SIGNALS))), data.decode("utf-8", "replace"))

    return one, [
        law_metadata(model, parameters, 1e-3, 0, 0, state).encode(),
        b"k" + (FOLDER / "seed.state").read_bytes(),
    ]


TARGETS: dict[str, Callable[[], tuple[Callable[[bytes], Any], list[bytes]]]] = {
    "plant": plant,
    "config": config,
    "expression": expression,
    "serial": serial,
    "slcan": slcan,
    "modbus": modbus,
    "csv": lambda: _recording(".csv"),
    "parquet": lambda: _recording(".parquet"),
    "arrow": lambda: _recording(".arrow"),
    "arrows": lambda: _recording(".arrows"),
    "commands": commands,
    "metadata": metadata,
}


def damaged(seed: bytes, others: list[bytes], random_: random.Random) -> bytes:
    """A seed with some of its bytes flipped, cut, doubled, exchanged for another's, or for what breaks parsers."""
    data = bytearray(seed)
    for _ in range(random_.choice((1, 1, 2, 4, 16))):
        at = random_.randrange(len(data) + 1)
        size = random_.choice((1, 2, 4, 8, 64))
        how = random_.randrange(7)
        if how == 0 and data:
            data[at % len(data)] ^= 1 << random_.randrange(8)
        elif how == 1:
            del data[at : at + size]
        elif how == 2:
            data[at:at] = data[max(0, at - size) : at] * random_.choice((1, 2, 50))
        elif how == 3:
            other = random_.choice(others)
            begin = random_.randrange(len(other) + 1)
            data[at : at + size] = other[begin : begin + size]
        elif how == 4:
            data[at : at + size] = random_.choice(
                (
                    b"\xff" * 8,
                    b"\0" * 8,
                    b"\xff\xff\xff\x7f",
                    b"1e999",
                    b"-1",
                    b"nan",
                    b"{",
                    b"[" * 90,
                    b"&a *a ",
                    b"\n",
                    b"\r",
                    b"'",
                    b'"',
                    b"!!python/object:os.system ",
                    b"9" * 400,
                    b"<<: ",
                    b"\xf0\x9f\x92\xa9",
                )
            )
        elif how == 5:
            del data[at:]
        else:
            data[at:at] = random_.randbytes(size)
    return bytes(data[:MAX_INPUT])


class _TooSlow(BaseException):
    pass


def _alarm(*_: Any) -> None:
    raise _TooSlow


def guarded(one: Callable[[bytes], Any], name: str) -> Callable[[bytes], None]:
    """`one` with its errors judged: InputError is meant, all else is a find, and so are time and memory."""
    from thermoctl.files.yamlfile import InputError

    def run(data: bytes) -> None:
        try:
            one(data)
        except InputError as e:
            assert "\n" not in str(e) and len(str(e)) < 5000, "a message is one line"

    return run


def guided(args: argparse.Namespace) -> int:
    """`--atheris`: libFuzzer ends its process, so it has one of its own; its last words become one line."""
    log = KEPT / f"{args.name}.log"
    KEPT.mkdir(parents=True, exist_ok=True)
    child = os.fork()
    if child == 0:
        with log.open("w") as f:
            os.dup2(f.fileno(), 1)
            os.dup2(f.fileno(), 2)
        with atheris.instrument_imports(include=["thermoctl", "thermoctl_hal", "yaml"]):
            one, seeds = TARGETS[args.name]()
        corpus = FOLDER / "corpus"
        corpus.mkdir()
        for k, seed in enumerate(seeds):
            (corpus / str(k)).write_bytes(seed[:MAX_INPUT])
        atheris.Setup(
            [
                sys.argv[0],
                f"-max_total_time={args.seconds:.0f}",
                "-timeout=30",
                f"-rss_limit_mb={LIMIT_MB}",
                f"-seed={args.seed}",
                f"-max_len={MAX_INPUT}",
                f"-artifact_prefix={KEPT}/{args.name}-",
                "-print_final_stats=1",
                str(corpus),
            ],
            guarded(one, args.name),
        )
        atheris.Fuzz()
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    shutil.rmtree(FOLDER, ignore_errors=True)
    words = log.read_text(errors="replace")
    said = {
        name: (re.findall(pattern, words) or ["-"])[-1]
        for name, pattern in (
            ("inputs", r"Done (\d+) runs"),
            ("branches", r" cov: (\d+)"),
            ("MB", r"peak_rss_mb: +(\d+)"),
        )
    }
    print(
        f"{args.name:10} {said['inputs']:>7} inputs in {args.seconds:5.1f} s, {said['branches']:>4} branches seen by atheris, at most "
        f"{said['MB']} MB, " + ("no find" if code == 0 else f"FIND, see {log}")
    )
    return code


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=TARGETS)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--replay")
    parser.add_argument("--atheris", action="store_true")
    args = parser.parse_args()
    if args.atheris:
        return guided(args)
    one, seeds = TARGETS[args.name]()
    run = guarded(one, args.name)
    if args.replay:
        run(Path(args.replay).read_bytes())
        return 0
    for seed in seeds:
        run(seed)
    KEPT.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGPROF, _alarm)  # processor time: a busy machine is no find
    random_, begun, count, grown = random.Random(args.seed), time.monotonic(), 0, 0.0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    while time.monotonic() - begun < args.seconds:
        data = damaged(random_.choice(seeds), seeds, random_)
        count += 1
        signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
        try:
            run(data)
        except BaseException as e:
            signal.setitimer(signal.ITIMER_PROF, 0)
            path = KEPT / f"{args.name}-{count}"
            path.write_bytes(data)
            print(
                f"{args.name}: {type(e).__name__}: {e} after {count} inputs; kept in {path}", file=sys.stderr
            )
            raise
        signal.setitimer(signal.ITIMER_PROF, 0)
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before
        if grown > LIMIT_MB:
            (KEPT / f"{args.name}-{count}").write_bytes(data)
            print(f"{args.name}: {grown:.0f} MB more after {count} inputs", file=sys.stderr)
            return 1
    print(
        f"{args.name:10} {count:7} inputs in {time.monotonic() - begun:5.1f} s, {grown:4.0f} MB more, no find"
    )
    shutil.rmtree(FOLDER, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
