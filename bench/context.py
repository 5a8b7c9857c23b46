"""What a figure of latency depends on besides the code: the machine, its software, its state, and who else is busy.

Everything here is read, nothing is set. What a machine does not expose is None, never a guess.
"""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edgeperc import MissingExtraError, __version__
from edgeperc.tuning import cpu_model

try:
    import psutil
except ImportError as exc:
    raise MissingExtraError("psutil", "bench", "Measuring") from exc

__all__ = ["EnergyMeter", "conditions", "machine", "peak_rss_mb", "rss_mb", "software", "spoilers"]

PACKAGES = (
    *("numpy", "numba", "onnxruntime", "onnxruntime-gpu", "onnxruntime-ep-openvino", "onnxruntime-ep-nv-tensorrt-rtx"),
    "mlcommons-loadgen",
)
# Settings that decide how many threads compute, and for how long they spin for more work.
VARIABLES = (
    *("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "KMP_BLOCKTIME", "GOMP_SPINCOUNT", "NUMBA_NUM_THREADS"),
    *("NUMBA_DISABLE_JIT", "ORT_LOG_LEVEL", "MALLOC_ARENA_MAX"),
)
CPU = Path("/sys/devices/system/cpu")
BUSY_CORES = 0.1  # of others: a tenth of a core takes the p99 of a scan with it
STOLEN_SHARE = 0.01
HOT_MARGIN_C = 10.0


def _read(path: Path) -> str | None:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None


def _number(path: Path) -> int | None:
    text = _read(path)
    return int(text) if text is not None and text.lstrip("-").isdigit() else None


def machine() -> dict[str, Any]:
    """The hardware and how it is set up."""
    affinity = psutil.Process().cpu_affinity() if hasattr(psutil.Process, "cpu_affinity") else None
    governors = {text for path in CPU.glob("cpu[0-9]*/cpufreq/scaling_governor") if (text := _read(path))}
    no_turbo, boost = _number(CPU / "intel_pstate/no_turbo"), _number(CPU / "cpufreq/boost")
    quota = _read(Path("/sys/fs/cgroup/cpu.max"))
    board = _read(Path("/sys/firmware/devicetree/base/model"))
    frequency = psutil.cpu_freq()
    return {
        "cpu": cpu_model(),
        "board": board.rstrip("\0") if board else None,
        "architecture": platform.machine(),
        "cores": psutil.cpu_count(logical=False),
        "logical_cores": psutil.cpu_count(),
        "usable_cores": len(affinity) if affinity else None,
        "max_mhz": frequency.max or None if frequency else None,
        "governor": ", ".join(sorted(governors)) or None,
        "turbo": (no_turbo == 0) if no_turbo is not None else (boost == 1) if boost is not None else None,
        "cpu_quota": None if quota is None or quota.startswith("max") else quota,
        "memory_mb": round(psutil.virtual_memory().total / 1e6),
        "swap_mb": round(psutil.swap_memory().total / 1e6),
        "hypervisor": _has_hypervisor(),
        "energy_rails": sorted(EnergyMeter().rails) or None,
    }


def _has_hypervisor() -> bool | None:
    text = _read(Path("/proc/cpuinfo"))
    return None if text is None else " hypervisor" in text


def software() -> dict[str, Any]:
    """Versions and environment settings."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    return {
        "edgeperc": __version__,
        "python": platform.python_version(),
        "os": platform.platform(),
        **versions,
        "environment": {name: os.environ[name] for name in VARIABLES if name in os.environ},
        "niceness": os.nice(0) if hasattr(os, "nice") else None,
        "taken": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    }


def conditions() -> dict[str, Any]:
    """The state of the machine at this moment; two of them tell what happened in between (`spoilers`)."""
    frequency = psutil.cpu_freq()
    sensors = psutil.sensors_temperatures() if hasattr(psutil, "sensors_temperatures") else {}
    found = [each for group in sensors.values() for each in group if each.current]
    throttles = [_number(path) for path in CPU.glob("cpu[0-9]*/thermal_throttle/*_throttle_count")]
    quota = dict(line.split() for line in (_read(Path("/sys/fs/cgroup/cpu.stat")) or "").splitlines())
    times = psutil.cpu_times()
    battery = psutil.sensors_battery() if hasattr(psutil, "sensors_battery") else None
    # Time of guests is part of user and nice.
    idle = times.idle + getattr(times, "iowait", 0.0)
    busy = sum(times) - idle - getattr(times, "guest", 0.0) - getattr(times, "guest_nice", 0.0)
    stolen = getattr(times, "steal", 0.0)
    return {
        "at_s": time.perf_counter(),
        "mhz": frequency.current if frequency else None,
        "temperature_c": max((each.current for each in found), default=None),
        "critical_c": min((each.critical for each in found if each.critical), default=None),
        "throttle_count": sum(n or 0 for n in throttles) if throttles else None,
        "quota_throttled": int(quota["nr_throttled"]) if "nr_throttled" in quota else None,
        "load_average": psutil.getloadavg()[0],
        "busy_s": busy - stolen,
        "stolen_s": stolen,
        "on_battery": None if battery is None else not battery.power_plugged,
    }


def busiest(seconds: float = 0.5) -> list[dict[str, Any]]:
    """Other processes that take a twentieth of a core or more, the busiest first; watched for some time."""
    processes = [p for p in psutil.process_iter() if p.pid != os.getpid()]
    for process in processes:
        _percent(process)
    time.sleep(seconds)
    found = [{"name": _name(p), "cores": round(_percent(p) / 100.0, 2)} for p in processes]
    return sorted((each for each in found if each["cores"] >= 0.05), key=lambda each: -each["cores"])[:5]


def _percent(process: psutil.Process) -> float:
    try:
        return float(process.cpu_percent())
    except psutil.Error:  # it has ended, or is not ours to look at
        return 0.0


def _name(process: psutil.Process) -> str:
    try:
        return str(process.name())
    except psutil.Error:
        return "?"


def spoilers(
    hardware: Mapping[str, Any], before: Mapping[str, Any], after: Mapping[str, Any], own_cpu_s: float
) -> list[str]:
    """What makes the samples taken between two `conditions` worth less, in plain words.

    Parameters
    ----------
    hardware : mapping
        Of `machine`.
    before, after : mapping
        Of `conditions`.
    own_cpu_s : float
        CPU time that what was measured took itself [s].
    """
    told = []
    wall_s = max(after["at_s"] - before["at_s"], 1e-9)
    others = (after["busy_s"] - before["busy_s"] - own_cpu_s) / wall_s
    if others > BUSY_CORES:
        told.append(f"other processes kept {others:.1f} of {hardware['logical_cores']} cores busy meanwhile")
    stolen = (after["stolen_s"] - before["stolen_s"]) / wall_s / hardware["logical_cores"]
    if stolen > STOLEN_SHARE:
        told.append(f"the hypervisor withheld {stolen:.0%} of the CPU time (steal)")
    for key, words in (
        ("throttle_count", "the CPU throttled itself for heat {} times"),
        ("quota_throttled", "the container's CPU quota stopped it {} times"),
    ):
        if before[key] is not None and after[key] is not None and after[key] > before[key]:
            told.append(words.format(after[key] - before[key]))
    hot, critical = after["temperature_c"], after["critical_c"]
    if hot is not None and critical is not None and hot > critical - HOT_MARGIN_C:
        told.append(f"it is {hot:.0f} C hot; {critical:.0f} C is critical")
    if before["mhz"] and after["mhz"] and after["mhz"] < 0.9 * before["mhz"]:
        told.append(f"the clock fell from {before['mhz']:.0f} to {after['mhz']:.0f} MHz")
    if after["on_battery"]:
        told.append("the machine runs on battery")
    return told


def standing_spoilers(hardware: Mapping[str, Any], busy: list[dict[str, Any]]) -> list[str]:
    """What is true of the whole report and makes its samples worth less, in plain words."""
    told = []
    governor = hardware["governor"]
    if governor not in (None, "performance"):
        told.append(f"the frequency governor is {governor}, not performance: the clock follows the load")
    if hardware["turbo"]:
        told.append("turbo is on: the clock depends on heat and on the other cores")
    if hardware["cpu_quota"]:
        told.append(f"a container's CPU quota applies ({hardware['cpu_quota']})")
    if busy:
        told.append("busy before the start: " + ", ".join(f"{p['name']} ({p['cores']:g} cores)" for p in busy))
    if hardware["hypervisor"]:
        told.append("a virtual machine: its neighbours, clock and heat cannot be seen from here")
    return told


def rss_mb() -> float:
    """Resident memory of this process [MB]."""
    return float(psutil.Process().memory_info().rss / 1e6)


def peak_rss_mb() -> float | None:
    """The most that this process ever had resident [MB]."""
    # getrusage's figure goes on from the parent's across fork and exec.
    for line in (_read(Path("/proc/self/status")) or "").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1.024e-3
    memory = psutil.Process().memory_info()
    if hasattr(memory, "peak_wset"):
        return float(memory.peak_wset / 1e6)
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # bytes on macOS


class EnergyMeter:
    """Energy that the machine's own counters tell: RAPL domains, and INA power rails as on Jetson boards.

    It is that of whole packages or boards, idle draw and all else that runs included. `tick` often: counters wrap, and
    rails tell power only, which is integrated here.

    Parameters
    ----------
    root : Path
        ``/sys``.

    Attributes
    ----------
    rails : dict of str to callable
    joules : dict of str to float
        Since construction, by rail.
    """

    def __init__(self, root: Path = Path("/sys")) -> None:
        self._counters: dict[str, tuple[Path, int]] = {}
        for domain in sorted(root.glob("class/powercap/intel-rapl:*")):
            if _number(domain / "energy_uj") is not None:  # often for root alone
                span = _number(domain / "max_energy_range_uj") or 2**32
                self._counters[f"{_read(domain / 'name')} ({domain.name})"] = domain / "energy_uj", span + 1
        self._powers: dict[str, tuple[Path, Path]] = {}
        for label in sorted(root.glob("class/hwmon/hwmon*/in*_label")):
            number = label.name[2:].removesuffix("_label")
            volts, amperes = (label.with_name(f"{kind}{number}_input") for kind in ("in", "curr"))
            if (_read(label.parent / "name") or "").startswith("ina") and None not in (
                _number(volts),
                _number(amperes),
            ):
                self._powers[f"{_read(label)} ({label.parent.name})"] = volts, amperes
        self.rails = (*self._counters, *self._powers)
        self.joules = dict.fromkeys(self.rails, 0.0)
        self._last_s = time.perf_counter()
        self._last = self._readings()

    def _readings(self) -> dict[str, float]:
        counted = {rail: float(_number(path) or 0) for rail, (path, _) in self._counters.items()}
        # millivolts times milliamperes
        return counted | {rail: 1e-6 * (_number(v) or 0) * (_number(a) or 0) for rail, (v, a) in self._powers.items()}

    def tick(self) -> None:
        """Add what was used since the last tick."""
        now_s, now = time.perf_counter(), self._readings()
        for rail, (_, span) in self._counters.items():
            self.joules[rail] += (now[rail] - self._last[rail]) % span * 1e-6
        for rail in self._powers:
            self.joules[rail] += (now[rail] + self._last[rail]) / 2.0 * (now_s - self._last_s)
        self._last_s, self._last = now_s, now
