"""Training under torchrun: two processes give what one gives."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from edgeperc_export.data.simulate import simulate
from edgeperc_export.training.ranks import RankError, Ranks

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="gloo and torchrun on Windows are not tested")

# Views with a quarter of the beams and columns, or with the 16 x 8 m ahead, as in test_export.
SCRIPT = """
import json, os, shutil, signal, sys
from dataclasses import replace
from pathlib import Path
import torch
import torch._dynamo  # which every optimizer imports
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
from torch.distributed.launcher.api import LaunchConfig, elastic_launch
from edgeperc.types.views import TopViewGeometry
from edgeperc_export import cards
from edgeperc_export.recipe import Recipe
from edgeperc_export.training import ranks
from edgeperc_export.training.train import Data, Run, train

cards.RANGE_IMAGE = replace(
    cards.RANGE_IMAGE, row_elevations_deg=cards.RANGE_IMAGE.row_elevations_deg[::4], width=128
)
cards.TOP_VIEW = TopViewGeometry((6.0, 22.0), (-4.0, 4.0))
# Rounding is that of double precision: gradients of an untrained network have an error of 2 % in fp32.
autocast, from_numpy, part = torch.autocast, torch.from_numpy, ranks.Ranks.part
torch.autocast = lambda device, kind, enabled: autocast(device, kind, enabled=False)
torch.set_default_dtype(torch.float64)
torch.from_numpy = lambda array: from_numpy(array.astype("float64") if array.dtype == "float32" else array)
ranks.Ranks.part = lambda self, batch: part(self, batch).double()

def rank(runs, simulated, dies=None):
    # One after the other; `dies` is killed in its fourth step.
    if dies is not None and dies == os.environ["RANK"]:
        add, calls = ranks.Ranks.add_gradients, []
        def dying(self, network):
            calls.append(1)
            if len(calls) == 4:
                os.kill(os.getpid(), signal.SIGKILL)
            add(self, network)
        ranks.Ranks.add_gradients = dying
    for out, changes in runs.items():
        recipe = Recipe(**{"steps": 4, "batch": 4, "context_width": 8, "redraw_every": 3, **changes})
        train(recipe, Path(out), Data(simulated=Path(simulated)), Run(n_threads=1, checkpoint_every=2))

if __name__ == "__main__":
    alone, launches, simulated = json.loads(sys.argv[1])
    rank(alone, simulated)
    for world, runs, dies in launches:  # what torchrun does with a script: here its processes are forked
        local = {"rdzv_backend": "c10d", "rdzv_endpoint": "localhost:0", "start_method": "fork"}
        try:
            elastic_launch(LaunchConfig(1, 1, world, max_restarts=0, **local), rank)(runs, simulated, dies)
        except ChildFailedError as error:
            if dies is None:
                raise
            print(error, file=sys.stderr)
            for out in runs:
                shutil.copy(Path(out, "checkpoint.pt"), Path(out, "killed.pt"))
"""

RUNS = {
    "pointseg": {"network": "pointseg", "accumulate": 2, "edge": True, "width": 0.25},
    "ssadnet": {"network": "ssadnet", "edge": True, "width": 0.25, "front": True},
}


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated")
    simulate(out, 3)
    return out


def checkpoint(out: Path, name: str = "checkpoint.pt") -> dict[str, torch.Tensor]:
    return torch.load(out / name, weights_only=True)


def distance(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> float:
    """Euclidean distance of the weights, without the statistics of batch norm."""
    names = [name for name in one if "running" not in name and one[name].is_floating_point()]
    return float(torch.cat([(one[name].double() - other[name].double()).flatten() for name in names]).norm())


def test_two_ranks_train_what_one_trains_and_resume(tmp_path: Path, simulated: Path) -> None:
    def of(world: str, runs: dict[str, Any] = RUNS) -> dict[str, Any]:
        return {str(tmp_path / world / name): run for name, run in runs.items()}

    # A killed rank ends the run, which resumes. Connected ranks are not connected again.
    cut = of("cut", {"ssadnet": RUNS["ssadnet"]})
    starts = {f"{name}-start": {**run, "learning_rate": 0.0, "steps": 1} for name, run in RUNS.items()}
    each = [(2, {out: run}, None) for out, run in (of("two") | cut).items()]
    launches = [(2, cut, "1"), *each]
    (tmp_path / "train.py").write_text(SCRIPT)
    # In one process, whose ranks are forked, for to import torch takes seconds.
    given = json.dumps([of("one", RUNS | starts), launches, str(simulated)])
    command = [sys.executable, str(tmp_path / "train.py"), given]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr
    assert "another rank" in done.stderr or re.search(r"Signal 9|exitcode\s*: -9", done.stderr), done.stderr
    assert checkpoint(tmp_path / "cut/ssadnet", "killed.pt")["step"] == 2
    for network in RUNS:
        one, two = states = [checkpoint(tmp_path / world / network) for world in ("one", "two")]
        moved = distance(checkpoint(tmp_path / f"one/{network}-start")["network"], one["network"])
        apart = distance(one["network"], two["network"])
        print(network, moved, apart)
        assert apart < 1e-3 * moved
        losses = [[row["loss"] for row in json.loads(state["curve"])] for state in states]
        assert losses[1] == pytest.approx(losses[0], rel=1e-4)
        assert {*one["odds"]} == {*two["odds"]}
        lines = (tmp_path / "two" / network / "log.jsonl").read_text().splitlines()
        assert [json.loads(line)["step"] for line in lines] == [2, 4]
    one, other = (checkpoint(tmp_path / name / "ssadnet")["network"] for name in ("two", "cut"))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_what_ranks_cannot_share(monkeypatch: pytest.MonkeyPatch) -> None:
    Ranks().check(7, 1, True)
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "4")
    Ranks().check(8, 2, False)
    with pytest.raises(RankError, match="multiple of 8"):
        Ranks().check(12, 2, False)
    with pytest.raises(RankError, match="--compile"):
        Ranks().check(8, 1, True)
