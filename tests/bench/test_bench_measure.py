"""How latency is measured: statistics by hand, schedules with a fake clock, the machine's state."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from edgeperc.errors import MissingExtraError, ModelFileError
from edgeperc_bench import cli, context, loadgen
from edgeperc_bench.commands.soak import memory_growth
from edgeperc_bench.samples import compare, noise_floor, percentile, summary, supported, trend
from edgeperc_bench.scenarios import Clock, Limits, Timings, back_to_back, throughput

# samples


def test_a_percentile_is_a_sample() -> None:
    values = [5.0, 1.0, 4.0, 2.0, 3.0]
    assert [percentile(values, p) for p in (20.0, 20.1, 50.0, 90.0, 100.0)] == [1.0, 2.0, 3.0, 5.0, 5.0]
    # 9,990 of 10,000 do not exceed 9,990.
    assert percentile(np.arange(1, 10_001), 99.9) == 9990.0
    assert np.isnan(percentile([], 50.0))


def test_a_percentile_needs_ten_samples_above_it() -> None:
    for p, least in ((50.0, 20), (90.0, 100), (99.0, 1000), (99.9, 10_000)):
        assert supported(p, least)
        assert not supported(p, least - 1)
    assert summary(range(1, 101)) == {"n": 100, "p50": 50.0, "p90": 90.0, "p99": None, "p99.9": None, "max": 100.0}
    assert summary([]) == {"n": 0, "p50": None, "p90": None, "p99": None, "p99.9": None, "max": None}


def test_the_noise_floor_is_the_spread_of_medians() -> None:
    assert noise_floor([[1.0, 10.0, 90.0], [11.0], [10.5, 10.5]]) == pytest.approx(1.0 / 10.5)
    assert noise_floor([[1.0, 2.0, 3.0]]) is None
    assert noise_floor([[1.0, 2.0], []]) is None


def repeats(medians: Sequence[float], spread: float, seed: int, n: int = 300) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [median + rng.gamma(2.0, spread, n) for median in medians]


@pytest.mark.parametrize(
    ("medians", "word"),
    [
        ((20.0, 20.1, 19.9), "no difference"),
        ((20.6, 20.7, 20.5), "slower"),
        ((19.0, 19.1, 18.9), "faster"),
        # Farther apart than A, yet so are B's own repeats.
        ((20.0, 23.0, 20.6), "no difference"),
    ],
)
def test_a_verdict_knows_the_noise(medians: Sequence[float], word: str) -> None:
    a = repeats((20.0, 20.1, 19.9), 0.3, 0)
    verdict = compare(a, repeats(medians, 0.3, 1))
    assert verdict.word == word
    assert verdict.interval[0] <= verdict.ratio <= verdict.interval[1]


def test_the_same_samples_never_differ_and_single_runs_say_nothing() -> None:
    a = repeats((20.0, 20.5), 1.0, 0)
    assert compare(a, a).word == "no difference"
    assert compare(a, a).ratio == 1.0
    assert compare(a, a[:1]).word == "unusable"
    assert compare([], a).word == "unusable"


def test_most_runs_of_the_same_thing_show_no_difference() -> None:
    rng = np.random.default_rng(5)
    verdicts = []
    for seed in range(40):
        medians = rng.normal(20.0, 0.3, (2, 3))
        verdicts.append(compare(repeats(medians[0], 0.5, seed), repeats(medians[1], 0.5, 1000 + seed)).word)
    assert verdicts.count("no difference") >= 30


def test_a_trend_is_least_squares() -> None:
    line = trend([0.0, 1.0, 2.0, 3.0], [1.0, 3.0, 5.0, 7.0])
    assert (line.slope, line.intercept, line.error, line.r2) == pytest.approx((2.0, 1.0, 0.0, 1.0))
    # Residuals -1, 1, 1, -1 about the mean: slope 0 with squares 4, spread 5 and 2 degrees of freedom.
    level = trend([0.0, 1.0, 2.0, 3.0], [-1.0, 1.0, 1.0, -1.0])
    assert level.slope == pytest.approx(0.0)
    assert level.error == pytest.approx(1.96 * np.sqrt(4.0 / 2.0 / 5.0))
    assert np.isnan(trend([1.0, 2.0], [1.0, 2.0]).slope)
    # The error grows where neighbors are alike.
    x, steps = np.arange(400.0), np.random.default_rng(0).normal(0.0, 1.0, 400)
    assert trend(x, np.repeat(steps[:20], 20)).error > 2.0 * trend(x, steps).error


def test_a_soak_tells_growth_from_noise() -> None:
    done = np.linspace(0, 18_000, 500)
    for slope, verdict in ((0.0, "level"), (1e-3, "grows"), (1e-6, "level")):
        mb = 300.0 + slope * done + np.random.default_rng(2).normal(0.0, 0.3, 500)
        growth = memory_growth(np.stack([done, mb], axis=1).tolist(), 2000)
        assert growth["verdict"] == verdict
        assert growth["growth_mb"] == pytest.approx(slope * 18_000, abs=0.3)
    few = [*zip(np.linspace(0, 18_000, 8), [300.0, 310.0, 295.0, 305.0, 300.0, 312.0, 296.0, 303.0], strict=True)]
    for unclear in (few, [[10, 300.0]]):
        assert memory_growth(unclear, 0)["verdict"] == "undecided"


# scenarios


class FakeClock(Clock):
    """Stands still but for what is slept and worked; sleeping oversleeps by ``late_s``."""

    def __init__(self, late_s: float = 0.0) -> None:
        self.time_s, self.late_s = 100.0, late_s

    def now(self) -> float:
        return self.time_s

    def sleep_until(self, due_s: float) -> None:
        if due_s > self.time_s:
            self.time_s = due_s + self.late_s


class FakePerceiver:
    def __init__(self, clock: FakeClock, takes_s: Sequence[float]) -> None:
        self.clock, self.takes_s, self.seen = clock, takes_s, []

    def __call__(self, scan: Any) -> Any:
        self.clock.time_s += self.takes_s[len(self.seen) % len(self.takes_s)]
        self.seen.append(scan)
        return SimpleNamespace(stage_ms={"infer": 1.0} | ({"adapt": 2.0} if len(self.seen) % 4 == 0 else {}))


def timed(
    takes_s: Sequence[float], scans: Sequence[Any], limits: Limits, late_s: float = 0.0, **options: Any
) -> tuple[Timings, list[Any]]:
    """The timings of scans that take so long, in turn; and the scans that were perceived."""
    clock = FakeClock(late_s)
    perceive = FakePerceiver(clock, takes_s)
    return back_to_back(perceive, scans, limits, clock=clock, **options), perceive.seen


def test_back_to_back_wants_both_scans_and_seconds() -> None:
    samples, seen = timed([0.5], ["a", "b"], Limits(3, 4.0, 2))
    assert len(samples.ms) == 8
    assert len(samples.warm_up_ms) == 2
    assert seen == ["a", "b"] * 5
    assert samples.ms == samples.age_ms == pytest.approx([500.0] * 8)
    assert samples.start_s == pytest.approx([0.5 * k for k in range(8)])
    assert samples.first_s == pytest.approx(101.0)
    assert samples.stage_ms == {"infer": [1.0] * 8, "adapt": [0.0, 2.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0]}
    assert len(timed([0.5], ["a"], Limits(9, 0.0, 0))[0].ms) == 9


def test_the_pace_is_kept_without_drift() -> None:
    samples, _ = timed([0.02], ["a"], Limits(1000, 0.0, 0), late_s=0.003, rate_hz=10.0)
    # Only the very first scan is there without sleeping; every later one starts 3 ms late, the thousandth too.
    assert samples.start_s[-1] == pytest.approx(99.903)
    assert samples.age_ms[1:] == pytest.approx([23.0] * 999)
    assert (samples.missed, samples.skipped) == (0, 0)


def test_a_late_answer_is_counted_and_the_newest_scan_is_next() -> None:
    samples, seen = timed([0.05, 0.35, 0.05, 0.05], list(range(10)), Limits(4, 0.0, 0), rate_hz=10.0)
    # The second scan arrives at 0.1 s and is answered at 0.45 s: scans 2 and 3 are overtaken by scan 4, of 0.4 s.
    assert seen == [0, 1, 4, 5]
    assert (samples.missed, samples.skipped) == (1, 2)
    assert samples.age_ms == pytest.approx([50.0, 350.0, 100.0, 50.0])
    assert samples.start_s == pytest.approx([0.0, 0.1, 0.45, 0.5])


def test_a_long_run_keeps_few_samples_and_ends_when_told() -> None:
    samples, _ = timed([0.1], ["a"], Limits(100, 0.0, 0, stride=40))
    assert samples.n == 100
    assert samples.start_s == pytest.approx([0.0, 4.0, 8.0])
    assert len(samples.ms) == len(samples.age_ms) == len(samples.stage_ms["infer"]) == 3
    samples, _ = timed([0.1], ["a"], Limits(100, 0.0, 5), keep_going=lambda s: len(s.ms) < 7)
    assert (len(samples.warm_up_ms), len(samples.ms)) == (5, 7)


def test_throughput_counts_the_time_that_all_share() -> None:
    # From 1 to 4 s both are at work: three calls of the one, one and a half of the other.
    one, other = ([0.0, 1.0, 2.0, 3.0], [1000.0] * 4), ([1.0, 3.0], [2000.0] * 2)
    rate, seconds = throughput([one, other])
    assert (rate, seconds) == pytest.approx((1.5, 3.0))
    assert np.isnan(throughput([one, ([], [])])[0])
    assert np.isnan(throughput([one, ([9.0], [1.0])])[0])


# context


def test_the_machine_is_described_in_json(psutil: None) -> None:
    machine = context.machine()
    json.dumps(machine, allow_nan=False)
    assert machine["logical_cores"] >= 1
    assert context.software()["numpy"] == np.__version__
    assert context.rss_mb() > 10.0
    peak = context.peak_rss_mb()
    assert peak is None or peak > 10.0
    before, after = context.conditions(), context.conditions()
    assert after["at_s"] > before["at_s"]
    assert after["busy_s"] >= before["busy_s"] > 0.0


@pytest.mark.parametrize("name", ["cpu_freq", "sensors_temperatures", "sensors_battery"])
def test_a_container_without_sys_is_described(psutil: None, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"psutil.{name}", Mock(side_effect=FileNotFoundError("/sys/class/power_supply")), raising=False)
    json.dumps([context.machine(), context.conditions()], allow_nan=False)
    shown = {"cpu_freq": "mhz", "sensors_temperatures": "temperature_c", "sensors_battery": "on_battery"}[name]
    assert context.conditions()[shown] is None


def quiet(**changed: Any) -> dict[str, Any]:
    state = {"at_s": 0.0, "busy_s": 0.0, "stolen_s": 0.0, "mhz": 3000.0, "temperature_c": 50.0, "critical_c": 100.0}
    return state | {"throttle_count": 7, "quota_throttled": 0, "load_average": 0.1, "on_battery": False} | changed


def test_every_disturbance_is_reported() -> None:
    hardware = {"logical_cores": 4}
    fine = quiet(at_s=10.0, busy_s=8.5)
    assert context.disturbances(hardware, quiet(), fine, 8.0) == []
    counts = {"throttle_count": 9, "quota_throttled": 3, "on_battery": True}
    loud = quiet(at_s=10.0, busy_s=28.0, stolen_s=2.0, mhz=2000.0, temperature_c=95.0, **counts)
    found = "\n".join(context.disturbances(hardware, quiet(), loud, 8.0))
    for part in ("2.0 of 4 cores", "5% of the CPU time", "heat 2 times", "quota paused it 3 times", "95 C", "2000 MHz"):
        assert part in found
    assert "battery" in found
    # What lasts, too
    calm = {"governor": "performance", "turbo": False, "cpu_quota": None, "hypervisor": False}
    assert context.lasting_disturbances(calm, []) == []
    wild = {"governor": "powersave", "turbo": True, "cpu_quota": 0.5, "hypervisor": True}
    assert len(context.lasting_disturbances(wild, [{"name": "cc", "cores": 1.0}])) == 5


def test_energy_counters_wrap_and_rails_integrate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rapl, rail = tmp_path / "class/powercap/intel-rapl:0", tmp_path / "class/hwmon/hwmon3"
    files = {
        rapl: {"name": "package-0", "energy_uj": "900000", "max_energy_range_uj": "999999"},
        rail: {"name": "ina3221", "in1_label": "VDD_IN", "in1_input": "5000", "curr1_input": "1000"},
    }
    for folder, texts in files.items():
        folder.mkdir(parents=True)
        for name, text in texts.items():
            (folder / name).write_text(f"{text}\n")
    now_s = 10.0
    monkeypatch.setattr(context.time, "perf_counter", lambda: now_s)
    meter = context.EnergyMeter(tmp_path)
    (rapl / "energy_uj").write_text("100000\n")
    (rail / "curr1_input").write_text("3000\n")
    now_s = 12.0
    meter.tick()
    # 100,000 microjoules up to the wrap at a million, 100,000 after it; 5 and 15 W for 2 s.
    assert meter.joules == pytest.approx({"package-0 (intel-rapl:0)": 0.2, "VDD_IN (hwmon3)": 20.0})


def test_loadgen_absent_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "mlperf_loadgen", None)
    with pytest.raises(MissingExtraError, match=r"edgeperc\[loadgen\]"):
        loadgen.load()
    assert cli.main(["run", "--loadgen", str(tmp_path)]) == 2


def test_loadgens_summary_is_read(tmp_path: Path) -> None:
    lines = ["Result is : VALID"]
    lines += [f"{p} percentile latency (ns)   : {ns}" for p, ns in (("50.00", 1500000), ("99.90", 2500000))]
    (tmp_path / loadgen.SUMMARY).write_text("\n".join(lines))
    summary = loadgen.read_summary(tmp_path)
    assert (summary["p50"], summary["p99.9"], summary["result"]) == (1.5, 2.5, "VALID")


def test_loadgen_drives_the_single_stream(tmp_path: Path) -> None:
    pytest.importorskip("mlperf_loadgen")
    clock = FakeClock()
    scans = [np.zeros((k, 4), np.float32) for k in range(1, 4)]
    perceive = FakePerceiver(clock, [0.0])
    started = []
    samples = loadgen.single_stream(
        perceive, scans, Limits(30, 0.0, 2), folder=tmp_path, on_start=lambda: started.append(len(perceive.seen))
    )
    summary = loadgen.read_summary(tmp_path)
    assert started == [2]
    assert len(samples.ms) == samples.n >= 30
    assert {"p50", "p90", "p99.9"} <= summary.keys()
    assert summary["result"] in ("VALID", "INVALID")

    def fails(scan: Any) -> Any:
        raise ModelFileError("the model is gone")

    with pytest.raises(ModelFileError, match="is gone"):
        loadgen.single_stream(fails, scans, Limits(3, 0.0, 0), folder=tmp_path)
