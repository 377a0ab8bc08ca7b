"""`thermoctl doctor`: each property of the machine that makes ticks late is found where it is, with its remedy."""

from types import SimpleNamespace

import pytest

from thermoctl.daemon.offline import doctor
from thermoctl.daemon.offline.doctor import cpu_list, real_time_checks

GOOD = {
    "sys/kernel/realtime": "1",
    "proc/version": "Linux 6.1-rt SMP PREEMPT_RT",
    "sys/devices/system/cpu/isolated": "2-3",
    "sys/devices/system/cpu/nohz_full": "3",
    "proc/sys/kernel/sched_rt_runtime_us": "-1",
    "proc/sys/kernel/sched_rt_period_us": "1000000",
    "dev/cpu_dma_latency": "",
    "sys/devices/system/cpu/cpu3/cpufreq/scaling_governor": "performance",
    "proc/irq/17/smp_affinity_list": "0-2",
    "proc/irq/17/eth0/x": "",
    "proc/irq/0/smp_affinity_list": "0-3",
    "sys/bus/usb-serial/devices/ttyUSB7/latency_timer": "1",
}


def settings(cpu=3, spin_s=0.0):
    device = SimpleNamespace(
        name="encoder",
        binding=SimpleNamespace(
            port="/dev/ttyUSB7", profile=SimpleNamespace(line=SimpleNamespace(latency_timer_ms=1))
        ),
    )
    return SimpleNamespace(
        loop=SimpleNamespace(cpu=cpu, period_s=1e-3, spin_s=spin_s),
        hal=SimpleNamespace(backend="devices", device=device),
    )


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """checks(files changed, settings) on a machine in a directory; a value of None removes the file."""
    monkeypatch.setattr(doctor, "fast_devices", lambda s: [s.hal.device])

    def checks(changed=None, s=None):
        for name, text in {**GOOD, **(changed or {})}.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if text is None:
                path.unlink(missing_ok=True)
            else:
                path.write_text(text + "\n")
        return {c.name: c for c in real_time_checks(s or settings(), str(tmp_path))}

    return checks


def test_a_tuned_machine_has_nothing_to_tune(machine):
    found = machine()
    assert all(c.good for c in found.values()), [c for c in found.values() if not c.good]
    assert len(found) == 8


@pytest.mark.parametrize(
    "changed,name,word",
    [
        (
            {"sys/kernel/realtime": None, "proc/version": "Linux 6.1 SMP PREEMPT_DYNAMIC"},
            "PREEMPT_RT",
            "linux-image-rt",
        ),
        ({"sys/devices/system/cpu/isolated": "0-2"}, "isolated processor", "isolcpus"),
        ({"sys/devices/system/cpu/nohz_full": "(null)"}, "no tick on it", "nohz_full=3"),
        ({"proc/irq/17/smp_affinity_list": "0-3"}, "interrupts elsewhere", "smp_affinity_list"),
        (
            {"sys/devices/system/cpu/cpu3/cpufreq/scaling_governor": "powersave"},
            "frequency governor",
            "cpupower",
        ),
        ({"sys/bus/usb-serial/devices/ttyUSB7/latency_timer": "16"}, "latency_timer of encoder", "echo 1 >"),
    ],
)
def test_what_is_not_tuned_is_named_with_its_remedy(machine, changed, name, word):
    found = machine(changed)
    assert [c.name for c in found.values() if not c.good] == [name]
    assert word in found[name].remedy and found[name].found


def test_spinning_is_held_against_real_time_throttling(machine):
    throttled = {"proc/sys/kernel/sched_rt_runtime_us": "950000"}
    assert machine(throttled)["real-time throttling"].good
    spinning = machine(throttled, settings(spin_s=8e-4))["real-time throttling"]
    assert not spinning.good and "sched_rt_runtime_us=-1" in spinning.remedy
    assert machine(None, settings(spin_s=8e-4))["real-time throttling"].good


def test_a_loop_without_a_processor_of_its_own_is_told(machine):
    found = machine(None, settings(cpu=-1))
    assert not found["own processor"].good and "interrupts elsewhere" not in found


def test_lists_of_the_kernel():
    assert cpu_list("0-2,5") == {0, 1, 2, 5} and cpu_list("(null)") == set() and cpu_list("") == set()
