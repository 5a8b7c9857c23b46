"""Record what a latency depends on besides the code: the machine, its software, its state and other processes.

Everything here is read, nothing is set. A value that the machine does not expose is None.
"""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from edgeperc import __version__
from edgeperc.system.extras import require
from edgeperc.system.machine import board, cpu_model, cpu_quota, has_hypervisor, quota_pauses, read_text, usable_cores

PACKAGES = (
    *("numpy", "numba", "onnxruntime", "onnxruntime-gpu", "onnxruntime-ep-openvino", "onnxruntime-ep-nv-tensorrt-rtx"),
    "mlcommons-loadgen",
)
# Environment variables that set how many threads compute, and how long they spin while they wait for work.
VARIABLES = (
    *("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "KMP_BLOCKTIME", "GOMP_SPINCOUNT", "NUMBA_NUM_THREADS"),
    *("NUMBA_DISABLE_JIT", "ORT_LOG_LEVEL", "MALLOC_ARENA_MAX"),
)
CPU = Path("/sys/devices/system/cpu")
BUSY_CORES = 0.1  # used by other processes: a tenth of a core is visible in the p99 of a scan
STOLEN_SHARE = 0.01
HOT_MARGIN_C = 10.0


def _psutil() -> Any:
    return require("psutil", "bench", "Measuring")


def _measured(name: str) -> Any:
    """What psutil measures by a function of this name; None where the system has none, or no /sys."""
    try:
        return getattr(_psutil(), name)()
    except (AttributeError, OSError):
        return None


def _number(path: Path) -> int | None:
    text = read_text(path)
    return int(text) if text is not None and text.lstrip("-").isdigit() else None


def machine() -> dict[str, Any]:
    """The hardware and how it is set up."""
    psutil = _psutil()
    governors = {text for path in CPU.glob("cpu[0-9]*/cpufreq/scaling_governor") if (text := read_text(path))}
    no_turbo, boost = _number(CPU / "intel_pstate/no_turbo"), _number(CPU / "cpufreq/boost")
    model = board()
    frequency = _measured("cpu_freq")
    return {
        "cpu": cpu_model(),
        "board": model.rstrip("\0") if model else None,
        "architecture": platform.machine(),
        "cores": psutil.cpu_count(logical=False),
        "logical_cores": psutil.cpu_count(),
        "usable_cores": usable_cores(),
        "max_mhz": frequency.max or None if frequency else None,
        "governor": ", ".join(sorted(governors)) or None,
        "turbo": (no_turbo == 0) if no_turbo is not None else (boost == 1) if boost is not None else None,
        "cpu_quota": cpu_quota(),
        "memory_mb": round(psutil.virtual_memory().total / 1e6),
        "swap_mb": round(psutil.swap_memory().total / 1e6),
        "hypervisor": has_hypervisor(),
        "energy_rails": sorted(EnergyMeter().rails) or None,
    }


def version_of(package: str) -> str | None:
    """The version of an installed package."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def software() -> dict[str, Any]:
    """Versions and environment settings."""
    return {
        "edgeperc": __version__,
        "python": platform.python_version(),
        "os": platform.platform(),
        **{package: version_of(package) for package in PACKAGES},
        "environment": {name: os.environ[name] for name in VARIABLES if name in os.environ},
        "niceness": os.nice(0) if hasattr(os, "nice") else None,
        "measured": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    }


def conditions() -> dict[str, Any]:
    """The state of the machine at this moment; two of them show what happened in between (`disturbances`)."""
    psutil = _psutil()
    frequency, sensors = _measured("cpu_freq"), _measured("sensors_temperatures") or {}
    sensors_read = [each for group in sensors.values() for each in group if each.current]
    throttles = [_number(path) for path in CPU.glob("cpu[0-9]*/thermal_throttle/*_throttle_count")]
    times = psutil.cpu_times()
    battery = _measured("sensors_battery")
    # Time of guests is part of user and nice.
    idle = times.idle + getattr(times, "iowait", 0.0)
    busy = sum(times) - idle - getattr(times, "guest", 0.0) - getattr(times, "guest_nice", 0.0)
    stolen = getattr(times, "steal", 0.0)
    return {
        "at_s": time.perf_counter(),
        "mhz": frequency.current if frequency else None,
        "temperature_c": max((each.current for each in sensors_read), default=None),
        "critical_c": min((each.critical for each in sensors_read if each.critical), default=None),
        "throttle_count": sum(n or 0 for n in throttles) if throttles else None,
        "quota_throttled": quota_pauses(),
        "load_average": psutil.getloadavg()[0],
        "busy_s": busy - stolen,
        "stolen_s": stolen,
        "on_battery": None if battery is None else not battery.power_plugged,
    }


def busiest(seconds: float = 0.5) -> list[dict[str, Any]]:
    """Other processes that use a twentieth of a core or more during some seconds, the busiest first, five at most."""
    psutil = _psutil()
    processes = [p for p in psutil.process_iter() if p.pid != os.getpid()]
    for process in processes:
        _ask(process.cpu_percent, 0.0)
    time.sleep(seconds)
    loads = [
        {"name": _ask(process.name, "?"), "cores": round(_ask(process.cpu_percent, 0.0) / 100.0, 2)}
        for process in processes
    ]
    return sorted((load for load in loads if load["cores"] >= 0.05), key=lambda load: -load["cores"])[:5]


def _ask(question: Callable[[], Any], otherwise: Any) -> Any:
    try:
        return question()
    except _psutil().Error:  # the process has ended, or may not be inspected
        return otherwise


def disturbances(
    hardware: Mapping[str, Any], before: Mapping[str, Any], after: Mapping[str, Any], own_cpu_s: float
) -> list[str]:
    """What disturbed the samples between two `conditions` beside the measured process's own CPU time, in sentences."""
    sentences = []
    wall_s = max(after["at_s"] - before["at_s"], 1e-9)
    others = (after["busy_s"] - before["busy_s"] - own_cpu_s) / wall_s
    if others > BUSY_CORES:
        sentences.append(f"other processes kept {others:.1f} of {hardware['logical_cores']} cores busy")
    stolen = (after["stolen_s"] - before["stolen_s"]) / wall_s / hardware["logical_cores"]
    if stolen > STOLEN_SHARE:
        sentences.append(f"the hypervisor withheld {stolen:.0%} of the CPU time (steal)")
    for key, sentence in (
        ("throttle_count", "the CPU was throttled for heat {} times"),
        ("quota_throttled", "the container's CPU quota paused it {} times"),
    ):
        if before[key] is not None and after[key] is not None and after[key] > before[key]:
            sentences.append(sentence.format(after[key] - before[key]))
    hot, critical = after["temperature_c"], after["critical_c"]
    if hot is not None and critical is not None and hot > critical - HOT_MARGIN_C:
        sentences.append(f"the CPU is at {hot:.0f} C; {critical:.0f} C is critical")
    if before["mhz"] and after["mhz"] and after["mhz"] < 0.9 * before["mhz"]:
        sentences.append(f"the clock fell from {before['mhz']:.0f} to {after['mhz']:.0f} MHz")
    if after["on_battery"]:
        sentences.append("the machine runs on battery")
    return sentences


def lasting_disturbances(hardware: Mapping[str, Any], busy: list[dict[str, Any]]) -> list[str]:
    """List what disturbs every sample of a report, one sentence each."""
    sentences = []
    governor = hardware["governor"]
    if governor not in (None, "performance"):
        sentences.append(f"the frequency governor is {governor}, not performance: the clock follows the load")
    if hardware["turbo"]:
        sentences.append("turbo is on: the clock depends on heat and on the other cores")
    if hardware["cpu_quota"]:
        sentences.append(f"a container gives the time of {hardware['cpu_quota']:g} cores")
    if busy:
        sentences.append("busy before the start: " + ", ".join(f"{p['name']} ({p['cores']:g} cores)" for p in busy))
    if hardware["hypervisor"]:
        sentences.append("a virtual machine: other machines on its host, the clock and the heat are not visible")
    return sentences


def rss_mb() -> float:
    """Resident memory of this process [MB]."""
    return float(_psutil().Process().memory_info().rss / 1e6)


def peak_rss_mb() -> float | None:
    """Largest resident memory of this process so far [MB]."""
    # After fork and exec, getrusage starts from the parent's value.
    for line in (read_text(Path("/proc/self/status")) or "").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1.024e-3
    memory = _psutil().Process().memory_info()
    if hasattr(memory, "peak_wset"):
        return float(memory.peak_wset / 1e6)
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # bytes on macOS


class EnergyMeter:
    """Joules by rail since construction: RAPL domains, and INA power rails as on Jetson boards, of whole packages or
    boards. Call `tick` often: counters wrap, and rails show only power, which is integrated here.
    """

    def __init__(self, root: Path = Path("/sys")) -> None:
        self._counters: dict[str, tuple[Path, int]] = {}
        for domain in sorted(root.glob("class/powercap/intel-rapl:*")):
            if _number(domain / "energy_uj") is not None:  # often readable by root only
                span = _number(domain / "max_energy_range_uj") or 2**32
                self._counters[f"{read_text(domain / 'name')} ({domain.name})"] = domain / "energy_uj", span + 1
        self._powers: dict[str, tuple[Path, Path]] = {}
        for label in sorted(root.glob("class/hwmon/hwmon*/in*_label")):
            number = label.name[2:].removesuffix("_label")
            volts, amperes = (label.with_name(f"{kind}{number}_input") for kind in ("in", "curr"))
            if (read_text(label.parent / "name") or "").startswith("ina") and None not in (
                _number(volts),
                _number(amperes),
            ):
                self._powers[f"{read_text(label)} ({label.parent.name})"] = volts, amperes
        self.rails = (*self._counters, *self._powers)
        self.joules = dict.fromkeys(self.rails, 0.0)
        self._last_s = time.perf_counter()
        self._last = self._readings()

    def _readings(self) -> dict[str, float]:
        counted = {rail: float(_number(path) or 0) for rail, (path, _) in self._counters.items()}
        # millivolts times milliamperes
        return counted | {rail: 1e-6 * (_number(v) or 0) * (_number(a) or 0) for rail, (v, a) in self._powers.items()}

    def tick(self) -> None:
        """Add the energy since the last tick."""
        now_s, now = time.perf_counter(), self._readings()
        for rail, (_, span) in self._counters.items():
            self.joules[rail] += (now[rail] - self._last[rail]) % span * 1e-6
        for rail in self._powers:
            self.joules[rail] += (now[rail] + self._last[rail]) / 2.0 * (now_s - self._last_s)
        self._last_s, self._last = now_s, now
