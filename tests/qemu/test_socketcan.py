"""SocketCAN for real: Debian's kernel in a qemu guest, vcan and two emulated CAN cards (issue 7). Slow: `make test-qemu`.

The guest boots the rootfs of tests/systemd (made once, build/) from a disk image, mounts this checkout read-only over 9p and
runs tests/qemu/guest.py. Emulated in software by default, which runs everywhere;
THERMOCTL_QEMU_ACCEL=kvm takes /dev/kvm where that works.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time

import pytest

from tests.systemd.container import CHECKOUT, ROOT, make_rootfs, missing

IMAGE = ROOT / "build/qemu/disk.img"
INIT = f"""#!/bin/sh
mount -t proc proc /proc; mount -t sysfs sys /sys; mount -t devtmpfs dev /dev 2>/dev/null; mount -t tmpfs tmp /tmp
for m in 9pnet_virtio 9p can can_raw can_dev vcan kvaser_pci; do modprobe $m || echo "no module $m"; done
mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=262144 checkout {CHECKOUT} || echo "no checkout"
ip link set lo up
OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=1 python3 {CHECKOUT}/tests/qemu/guest.py
echo DONE
sync
echo o > /proc/sysrq-trigger
sleep 5
"""
SCENARIOS = (
    "kernel filters",
    "drive on vcan, down and up",
    "bus-off",
    "heartbeat lost",
    "missing and down interfaces",
    "drive on the emulated card, down and up",
)


def cannot() -> str:
    if shutil.which("qemu-system-x86_64") is None:
        return "needs qemu-system-x86_64 (apt-get install qemu-system-x86)"
    return missing()


pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(cannot()), reason=cannot())]


def disk_image() -> None:
    """The rootfs as an ext4 image, made again when the rootfs or the guest's init changed."""
    rootfs = make_rootfs()
    init = rootfs / "opt/qemu-init"
    if not init.exists() or init.read_text() != INIT:
        init.write_text(INIT)
        init.chmod(0o755)
        IMAGE.unlink(missing_ok=True)
    if not IMAGE.exists() or IMAGE.stat().st_mtime < (rootfs / "etc/debian_version").stat().st_mtime:
        IMAGE.parent.mkdir(parents=True, exist_ok=True)
        part = IMAGE.with_suffix(".part")
        part.unlink(missing_ok=True)
        subprocess.run(
            ["mke2fs", "-q", "-t", "ext4", "-O", "^has_journal", "-d", str(rootfs), str(part), "2G"],
            check=True,
        )
        part.rename(IMAGE)


@pytest.fixture(scope="module")
def results():
    """What the guest printed, by scenario."""
    disk_image()
    boot = ROOT / "build/systemd/rootfs/boot"
    kernel = max(boot.glob("vmlinuz-*"))
    kvm = os.environ.get("THERMOCTL_QEMU_ACCEL", "tcg") == "kvm"
    begin = time.monotonic()
    done = subprocess.run(
        [
            "qemu-system-x86_64",
            *(["-accel", "kvm", "-cpu", "host"] if kvm else ["-accel", "tcg", "-cpu", "max"]),
            "-m",
            "1024",
            "-smp",
            "1",
            "-nographic",
            "-no-reboot",
            "-nic",
            "none",
            "-kernel",
            str(kernel),
            "-initrd",
            str(kernel).replace("vmlinuz", "initrd.img"),
            "-append",
            "root=/dev/vda rw console=ttyS0 quiet no_timer_check panic=-1 init=/opt/qemu-init",
            "-drive",
            f"file={IMAGE},format=raw,if=virtio,snapshot=on",
            "-virtfs",
            f"local,path={ROOT},mount_tag=checkout,security_model=none,readonly=on",
            "-object",
            "can-bus,id=bus0",
            "-device",
            "kvaser_pci,canbus=bus0",
            "-device",
            "kvaser_pci,canbus=bus0",
        ],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    seconds = time.monotonic() - begin
    found = {}
    for line in done.stdout.splitlines():
        if "RESULT " in line:
            result = json.loads(line[line.index("RESULT ") + 7 :])
            found[result["name"]] = result
    print(f"\nqemu with {'kvm' if kvm else 'software emulation'}, {kernel.name}: {seconds:.0f} s")
    for name, r in found.items():
        figures = ", ".join(
            f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}"
            for k, v in r.items()
            if k not in ("name", "ok")
        )
        print(f"  {name:42} {'ok  ' if r['ok'] else 'FAIL'} {figures}")
    assert found, done.stdout[-3000:] + done.stderr[-1000:]
    return found


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_driver_on_the_kernels_can(results, name):
    assert name in results, f"the guest did not get there: {sorted(results)}"
    assert results[name]["ok"], results[name].get("error")


@pytest.mark.parametrize("name", ["drive on vcan, down and up", "drive on the emulated card, down and up"])
def test_a_dead_bus_is_noticed_and_the_amplifier_off_within_its_watchdog(results, name):
    assert results[name]["down_noticed_s"] < 0.1  # at once by the socket; at the latest by the heartbeat
    assert results[name]["amplifier_off_s"] < 0.5  # the drive's own watchdog is 0.2 s
    assert results[name]["back_after_up_s"] < 3.0
