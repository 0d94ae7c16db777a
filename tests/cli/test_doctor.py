"""``trms doctor --jitter``: the figures of known wake-ups, and what a known machine lacks."""

import json
import time

import numpy as np
import pytest

from trms_cli.commands.doctor.check import OK, SLOWER
from trms_cli.commands.doctor.real_time import Jitter, Measurement, lines_of, machine, measure
from trms_cli.simulation.pace import VirtualClock


class LateClock(VirtualClock):
    """Each sleep ends late by the next of some times (s)."""

    def __init__(self, lateness):
        super().__init__()
        self._lateness = iter(lateness)

    def sleep_until(self, moment):
        if moment > self.time:  # what is due now is not waited for
            super().sleep_until(moment + next(self._lateness))


def test_the_figures_are_those_of_the_wake_ups():
    """5 s at 50 Hz are 250, at 200 Hz 1000."""
    first = np.zeros(250)
    first[::2] = 2e-4
    first[7:17:2] = 3e-3
    second = np.full(1000, 1e-5)
    second[500] = 4e-3
    slow, fast = measure(10.0, LateClock([*first, *second])).jitter
    assert (slow.rate, slow.wake_ups, fast.rate, fast.wake_ups) == (50.0, 250, 200.0, 1000)
    np.testing.assert_allclose(
        [slow.median, slow.p99, slow.worst, slow.late_share],
        [np.median(first), np.quantile(first, 0.99), 3e-3, 5 / 250],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        [fast.median, fast.worst, fast.late_share], [1e-5, 4e-3, 1e-3], atol=1e-12
    )
    late, other = lines_of((slow, fast))
    assert late.state == SLOWER and "3 ms at worst; 2.0 % of 250 wake-ups" in late.found
    assert "0.1 % of 1000 wake-ups by more than 1 ms" in other.found


def test_a_wake_up_that_is_late_does_not_move_the_next_one():
    """As in the loop, each is due at its own time: a sleep of 12 ms makes three late at 200 Hz."""
    lateness = [0.0] * 5 + [0.0, 0.012] + [0.0] * 20
    fast = measure(0.2, LateClock(lateness)).jitter[1]
    assert fast.wake_ups == 20 and fast.worst == pytest.approx(0.012)
    assert fast.late_share == pytest.approx(3 / 20)  # 12, 7 and 2 ms


POOR = {
    "proc/sys/kernel/osrelease": "6.1.0-18-amd64\n",
    "proc/version": "Linux version 6.1.0 SMP PREEMPT_DYNAMIC Debian\n",
    "proc/swaps": "Filename Type Size\n/dev/sda5 partition 999420\n",
    "proc/cpuinfo": "processor : 0\nflags\t\t: fpu sse hypervisor\n",
    "sys/devices/system/cpu/isolated": "\n",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "powersave\n",
    "sys/class/dmi/id/product_name": "VirtualBox\n",
}
GOOD = POOR | {
    "proc/version": "Linux version 6.1.0 SMP PREEMPT_RT Debian\n",
    "proc/swaps": "Filename Type Size\n",
    "proc/cpuinfo": "processor : 0\nflags\t\t: fpu sse\n",
    "sys/devices/system/cpu/isolated": "0-63\n",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance\n",
}
REFUSALS = ("memory may be paged out (mlockall: no)", "like any process (SCHED_FIFO: no)")


def looked_at(tmp_path, files, measurement):
    for name, text in files.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return {check.what: check for check in machine(measurement, tmp_path)}


def test_what_a_machine_lacks_is_told_with_what_to_do(tmp_path):
    checks = looked_at(tmp_path, POOR, Measurement((), False, False, REFUSALS))
    del checks["load"]  # of the machine that this runs on
    assert all(check.state == SLOWER and check.remedy for check in checks.values())
    for what, remedy in {
        "SCHED_FIFO": "`@realtime - rtprio 95` into /etc/security/limits.d",
        "mlockall": "`@realtime - memlock unlimited`",
        "kernel": "linux-image-rt-amd64",
        "isolated cores": "isolcpus=3",
        "CPU governor": "cpupower frequency-set -g performance",
        "swap": "swapoff -a",
        "virtual machine": "a machine of its own",
    }.items():
        assert remedy in checks[what].remedy, what
    assert "mlockall: no" in checks["mlockall"].found
    assert "VirtualBox" in checks["virtual machine"].found
    assert "/dev/sda5" in checks["swap"].found


def test_a_machine_that_has_it_all_is_left_alone(tmp_path):
    checks = looked_at(tmp_path, GOOD, Measurement((), True, True, ()))
    del checks["load"]
    assert {check.state for check in checks.values()} == {OK}
    assert not any(check.remedy for check in checks.values())


def test_cores_that_this_process_does_not_run_on_are_named(tmp_path):
    files = GOOD | {"sys/devices/system/cpu/isolated": "4090-4091,4095\n"}
    cores = looked_at(tmp_path, files, Measurement((), True, True, ()))["isolated cores"]
    assert cores.state == SLOWER and "taskset -c 4090" in cores.remedy


def test_the_command(trms, refused):
    begin = time.monotonic()
    document = json.loads(trms("doctor", "--jitter", "0.5", "--json").stdout)
    assert time.monotonic() - begin >= 0.5
    assert [each["wake_ups"] for each in document["jitter"]] == [12, 50]
    for each in document["jitter"]:
        assert 0.0 <= each["median_s"] <= each["p99_s"] <= each["worst_s"]
    told = {finding["what"] for finding in document["findings"]}
    assert {"SCHED_FIFO", "mlockall", "kernel", "load"} <= told
    assert "wake-ups by more than 1 ms" in trms("doctor", "jitter=0.2").stdout
    plain = json.loads(trms("doctor", "--json").stdout)
    assert "jitter" not in plain
    assert "SCHED_FIFO" not in {finding["what"] for finding in plain["findings"]}
    refused("doctor", "--jitter", "0", words="0.1 to 3600 s")
    refused("doctor", "--jitter", "long", words="no number")


def test_lines_are_good_where_nothing_is_late():
    assert lines_of((Jitter(50.0, 10, 1e-5, 2e-5, 3e-5, 1e-3, 0.0),))[0].state == OK
