"""What the tests of the command line share."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edgeperc import cli
from edgeperc.types.card import CHANNELS, InputSpec, ModelCard, OutputSpec
from edgeperc.types.sensor import SensorProfile, get_sensor
from edgeperc.types.views import ObjectGeometry, RangeImageGeometry, TopViewGeometry

POINTSEG = ModelCard(
    name="pointseg",
    version="1.2.3",
    view=RangeImageGeometry((2.0, 0.0, -10.0), width=8),
    input=InputSpec("range_image", ("x", "y", "z"), (0.0,) * 3, (1.0,) * 3),
    outputs=(OutputSpec("logits", "class_logits"),),
    classes=("background", "car", "pedestrian", "cyclist"),
    training={
        "data": "streets",
        "licence": "CC0",
        "frames": list(range(40)),
        "drives": ["a", "b"],
        "seen": dict.fromkeys("abcdefghijklmnopqrstuvwxyz", 0),
    },
    metrics={
        "split": "test",
        "real": {"n_frames": 21, "n_drives": 3, "points": {"all": {"car": {"iou": 0.65123, "n_objects": 3}}}},
    },
    parity={"max_abs_diff": 1.5e-5},
    precisions={"int8": {"label_agreement": 0.99953, "loss": 0.1}},
)


SSADNET = ModelCard(
    name="ssadnet",
    version="1.0.0",
    view=TopViewGeometry(),
    input=InputSpec("top_view", ("height",), (0.0,), (1.0,)),
    outputs=(OutputSpec("map", "class_probabilities"), OutputSpec("boxes", "box_dense")),
    classes=("background", "drivable", "car", "van", "truck"),
    box_classes=("car", "van"),
)

OBJECTS = ModelCard(
    name="objects",
    version="1.0.0",
    view=ObjectGeometry(),
    input=InputSpec("candidates", CHANNELS["objects"], (0.0,) * 13, (1.0,) * 13),
    outputs=(OutputSpec("objects", "objects"),),
    classes=("background", "car"),
    box_classes=("car",),
    box_size_priors={"car": (3.9, 1.6, 1.5)},
)


def parsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parser of each command of a program; each command has a line in the program's help."""
    (commands,) = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    assert {*commands.choices} == {each.dest for each in commands._choices_actions}
    return dict(commands.choices)


def thinned(sensor: str = "hdl-64e") -> SensorProfile:
    """A built-in sensor with a third of its columns: its scans take a third of the time, and are perceived like its."""
    profile = get_sensor(sensor)
    return replace(profile, columns=profile.columns // 3)


def write_scan(path: Path, n: int = 40, first_remission: float = 0.0) -> Path:
    points = np.random.default_rng(n).uniform(-20.0, 20.0, (n, 4)).astype(np.float32)
    points[:, 3] = 0.5
    points[:1, 3] = first_remission
    path.parent.mkdir(parents=True, exist_ok=True)
    points.tofile(path)
    return path


def run(*arguments: object) -> int:
    return cli.main([str(a) for a in arguments])


class Shell:
    """Command lines of a program: each ends with the code that is expected, and gives what was printed."""

    def __init__(self, capsys: pytest.CaptureFixture[str], main: Any = cli.main) -> None:
        self._capsys, self._main = capsys, main

    def both(self, *arguments: object, code: int = 0) -> Any:
        """What was printed since the last command, ``out`` and ``err``."""
        try:
            ended = self._main([str(a) for a in arguments])
        except SystemExit as left:  # of argparse
            ended = left.code
        assert ended == code, arguments
        return self._capsys.readouterr()

    def out(self, *arguments: object, code: int = 0) -> str:
        return self.both(*arguments, code=code).out

    def err(self, *arguments: object, code: int = 2) -> str:
        return self.both(*arguments, code=code).err

    def records(self, command: str, *arguments: object, code: int = 0) -> list[dict[str, Any]]:
        """The lines of ``--json``."""
        return [json.loads(line) for line in self.out(command, "--json", *arguments, code=code).splitlines()]
