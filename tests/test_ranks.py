"""Training under torchrun: two processes give what one gives."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

from edgeperc_export.ranks import RankError, Ranks
from edgeperc_export.simulate import simulate

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="gloo and torchrun on Windows are not tested")

# Views with a quarter of the beams and columns, or with the 16 x 8 m ahead, as in test_export.
SCRIPT = """
import json, os, signal, sys
from dataclasses import replace
from pathlib import Path
import torch
from edgeperc.card import TopViewGeometry
from edgeperc_export import cards, ranks
from edgeperc_export.recipe import Recipe
from edgeperc_export.train import train

cards.RANGE_IMAGE = replace(
    cards.RANGE_IMAGE, row_elevations_deg=cards.RANGE_IMAGE.row_elevations_deg[::4], width=128
)
cards.TOP_VIEW = TopViewGeometry((6.0, 22.0), (-4.0, 4.0))
# Rounding is that of double precision: gradients of an untrained network have an error of 2 % in fp32.
autocast, from_numpy, part = torch.autocast, torch.from_numpy, ranks.Ranks.part
torch.autocast = lambda device, kind: autocast(device, kind, enabled=False)
torch.set_default_dtype(torch.float64)
torch.from_numpy = lambda array: from_numpy(array.astype("float64") if array.dtype == "float32" else array)
ranks.Ranks.part = lambda self, batch: part(self, batch).double()
network, out, simulated, changes, dies = sys.argv[1:]
if dies == os.environ.get("RANK"):
    add, calls = ranks.Ranks.add_gradients, []
    def dying(self, network):
        calls.append(1)
        if len(calls) == 4:
            os.kill(os.getpid(), signal.SIGKILL)
        add(self, network)
    ranks.Ranks.add_gradients = dying
given = {"steps": 6, "batch": 4, "context_width": 8, "redraw_every": 3, **json.loads(changes)}
recipe = Recipe(network, **given)
train(recipe, Path(out), kitti=None, simulated=Path(simulated), n_threads=1, checkpoint_every=2)
"""


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated")
    simulate(out, 3)
    return out


def trained(
    script: Path, network: str, out: Path, simulated: Path, world: int, dies: str = "", **changes: object
) -> subprocess.CompletedProcess[str]:
    """Train in ``world`` processes; rank ``dies`` is killed in its fourth step."""
    script.write_text(SCRIPT)
    command = [sys.executable]
    if world > 1:
        command += ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={world}"]
    command += [str(script), network, str(out), str(simulated), json.dumps(changes), dies]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


def checkpoint(out: Path) -> dict[str, torch.Tensor]:
    return torch.load(out / "checkpoint.pt", weights_only=True)


def distance(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> float:
    """Euclidean distance of the weights, without the statistics of batch norm."""
    names = [name for name in one if "running" not in name and one[name].is_floating_point()]
    return float(torch.cat([(one[name].double() - other[name].double()).flatten() for name in names]).norm())


SMALL = {"edge": True, "width": 0.25, "front": True}


@pytest.mark.parametrize(
    ("network", "changes"),
    [
        ("pointseg", {"accumulate": 2}),
        ("ssadnet", SMALL),
        ("lodnn", {"learning_rate": 1e-3}),
    ],
)
def test_two_ranks_train_what_one_trains(tmp_path: Path, simulated: Path, network: str, changes: dict) -> None:
    states = []
    for world in (1, 2):
        done = trained(tmp_path / "train.py", network, tmp_path / str(world), simulated, world, **changes)
        assert done.returncode == 0, done.stderr
        states.append(checkpoint(tmp_path / str(world)))
    one, two = states
    start = trained(
        tmp_path / "train.py", network, tmp_path / "0", simulated, 1, **{**changes, "learning_rate": 0.0, "steps": 1}
    )
    assert start.returncode == 0, start.stderr
    moved = distance(checkpoint(tmp_path / "0")["network"], one["network"])
    apart = distance(one["network"], two["network"])
    print(network, moved, apart)
    assert apart < 1e-3 * moved
    losses = [[row["loss"] for row in json.loads(state["curve"])] for state in states]
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)
    assert {*one["odds"]} == {*two["odds"]}
    lines = (tmp_path / "2/log.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [2, 4, 6]


def test_a_killed_rank_ends_the_run_and_it_resumes(tmp_path: Path, simulated: Path) -> None:
    script = tmp_path / "train.py"
    whole = trained(script, "ssadnet", tmp_path / "whole", simulated, 2, **SMALL)
    assert whole.returncode == 0, whole.stderr
    cut = trained(script, "ssadnet", tmp_path / "cut", simulated, 2, dies="1", **SMALL)
    assert cut.returncode != 0
    assert "another rank" in cut.stderr or re.search("Signal 9|exitcode: -9", cut.stderr), cut.stderr
    assert checkpoint(tmp_path / "cut")["step"] == 2
    resumed = trained(script, "ssadnet", tmp_path / "cut", simulated, 2, **SMALL)
    assert resumed.returncode == 0, resumed.stderr
    one, other = (checkpoint(tmp_path / name)["network"] for name in ("whole", "cut"))
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
