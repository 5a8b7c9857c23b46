"""The command line of edgeperc-export: commands, options and wrong usage."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")


from training_helpers import ablate

from checkout import printed
from cli_helpers import Shell, parsers
from edgeperc.errors import PointsError
from edgeperc.types.card import ModelCard
from edgeperc.zoo import model_path
from edgeperc_export.cli import build_parser, recipe_of
from edgeperc_export.networks import build
from edgeperc_export.recipe import MODELS, NETWORKS, Recipe
from edgeperc_export.release.to_onnx import write_card


def test_every_model_can_be_made() -> None:
    for name in MODELS:
        if not name.endswith("-start"):
            assert build_parser().parse_args(["make", name, "out"]).name == name


def test_every_option_has_a_help_text() -> None:
    for name, parser in parsers(build_parser()).items():
        for action in parser._actions:  # none of them has commands
            assert action.help, f"{name} {action.option_strings or action.dest} has no help"
            assert len(action.help.split()) > 1, f"{name} {action.option_strings}: {action.help}"
        assert parser.description, name
        parser.format_help()  # raises ValueError for a stray % in a help text


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        # Mistyped words name the nearest.
        ("database-biuld", "(did you mean database-build?)"),
        ("train pointsg out", "(did you mean pointseg?)"),
        ("train pointseg out --kitty root", "--kitty root (did you mean --kitti?)"),
        # Options without effect
        ("train pointseg out --head slots", "--head has no effect on pointseg, only on ssadnet"),
        ("train lodnn out --no-class-weights", "--class-weights has no effect on lodnn"),
        ("train kulseg out --edge", "--edge has no effect on kulseg, only on lodnn, pointseg, ssadnet"),
        ("train ssadnet out --swap 0.1", "--swap has no effect on ssadnet"),
        (
            "train ssadnet out --edge --context-width 8",
            "--context-width has no effect on a network for small computers",
        ),
        ("train kulseg out --recipe paper", "--recipe paper is for ssadnet, pointseg, lodnn, fcn16,"),
        ("train pointseg out", "no scans to train on"),
        ("train pointseg out --simulated scanz", "scanz holds no simulated scan; expected a folder written by"),
        ("train pointseg out --classes car,pedestrian", "--classes begins with car; expected background"),
        ("train camseg out --image-width 50", "expected multiples of 4 as --image-width and --image-height"),
        ("export no.pt no.onnx --metrics /dev/null", "/dev/null has no figures, as edgeperc eval --json writes them"),
        # Numbers that no run can be made with
        ("train pointseg out --steps 0", "--steps is 0; expected 1 or more"),
        ("train pointseg out --swap nan", "--swap is nan; expected 0 to 1"),
        ("train pointseg out --learning-rate inf", "--learning-rate is inf; expected 0 or more"),
        ("train kulseg out --dropout 1", "--dropout is 1.0; expected 0 to 0.999"),
        ("train pointseg out --checkpoint-every 0", "0 is too small; expected 1 or more"),
        ("train pointseg out --threads 0", "0 is too small; expected 1 or more"),
        ("train pointseg out --workers -1", "-1 is too small; expected 0 or more"),
        ("agree pointseg --scans 0", "0 is too small; expected 1 or more"),
        ("simulate out -n 0", "0 is too small; expected 1 or more"),
        ("ablate ssadnet . --kitti . --simulated . --plot a.png", "--plot draws variants of lodnn, not of ssadnet"),
        ("ablate camvid out --size 0x90", "0 is too small; expected 1 or more"),
    ],
)
def test_wrong_words_are_refused(
    typed: str, message: str, shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in shell.err(*typed.split())


def test_help_and_recipes_load_no_torch() -> None:
    code = """
import sys
from edgeperc_export import recipe
assert recipe.MODELS and recipe.PAPER
assert not {"torch", "numpy", "onnx"} & {*sys.modules}, "recipe"
from edgeperc_export.cli import main
for arguments in (["--help"], ["train", "--help"], ["database-build", "--help"]):
    try:
        main(arguments)
    except SystemExit as end:
        assert end.code == 0
assert not {"torch", "numba", "onnx"} & {*sys.modules}, "--help"
"""
    printed(code)


def test_every_field_of_a_recipe_is_an_option() -> None:
    train = parsers(build_parser())["train"]
    options = {action.dest: action for action in train._actions}
    for field in dataclasses.fields(Recipe):
        if field.name != "network":
            assert field.metadata["help"] in str(options[field.name].help)
            assert {*field.metadata["networks"]} <= {*NETWORKS}
    # All options of a network, given with their defaults, result in the default recipe.
    for network in NETWORKS:
        arguments = ["train", network, "out"]
        for field in dataclasses.fields(Recipe):
            if field.metadata and network in field.metadata["networks"]:
                option = f"--{field.name.replace('_', '-')}"
                if isinstance(field.default, bool):
                    arguments += [option if field.default else option.replace("--", "--no-", 1)]
                else:
                    arguments += [option, "" if field.default == () else str(field.default)]
        assert recipe_of(build_parser().parse_args(arguments)) == Recipe(network)


@pytest.mark.parametrize(("licence", "calibrates"), [("KITTI: CC BY-NC-SA 3.0", True), ("CC BY 4.0", False)])
def test_weights_without_the_terms_of_kitti_are_not_calibrated_on_it(
    tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch, licence: str, calibrates: bool
) -> None:
    model = onnx.load(model_path("objects:fp32"))
    card = ModelCard.read(model_path("objects:fp32"))
    write_card(model, dataclasses.replace(card, training={**card.training, "licence": licence}), tmp_path / "mine.onnx")

    def calibration(*_: object, kitti: Path | None, **__: object) -> None:
        raise PointsError(f"calibrates on KITTI: {kitti is not None}")

    monkeypatch.setattr("edgeperc_export.release.quantize.calibration_scans", calibration)
    said = shell.err("quantize", tmp_path / "mine.onnx", tmp_path / "int8.onnx", "--kitti", tmp_path)
    assert f"calibrates on KITTI: {calibrates}" in said


def test_wrong_usage_is_reported_in_one_line(tmp_path: Path, shell: Shell) -> None:
    with pytest.raises(
        ValueError, match="kulseg has no network for small computers; expected lodnn or pointseg or ssadnet"
    ):
        build(Recipe("kulseg", edge=True))
    with pytest.raises(ValueError, match="network is 'yolo'; expected camseg, fcn16, fcn8, kulseg, lodnn, objects"):
        build(Recipe("yolo"))
    assert "no.pt" in shell.err("verify", tmp_path / "no.pt", tmp_path / "no.onnx")
    for command in (["quantize", "pointseg"], ["export", tmp_path / "no.pt"]):  # before minutes of work
        assert f"{tmp_path} is a folder; expected the name of a file" in shell.err(*command, tmp_path)
    arguments = {"kitti": tmp_path, "simulated": tmp_path, "start_from": None, "fold": 0, "steps": 1}
    with pytest.raises(ValueError, match="pointseg has no variant 'half'; expected one of: as shipped; nothing pasted"):
        ablate("pointseg", tmp_path, **arguments, variants=["half"])


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["train", "pointseg", "out", "--start-from", "MODEL"], "start_from"),
        (["train", "pointseg", "out", "--teacher", "MODEL"], "teacher"),
        (["quantize", "MODEL", "int8.onnx"], "model"),
        (["verify", "checkpoint.pt", "MODEL"], "model"),
        (["ablate", "pointseg", "out", "--start-from", "MODEL"], "start_from"),
    ],
)
def test_models_have_names(words: list[str], option: str, capsys: pytest.CaptureFixture[str]) -> None:
    def parsed(model: str) -> Path:
        path: Path = getattr(build_parser().parse_args([model if word == "MODEL" else word for word in words]), option)
        return path

    assert parsed("pointseg") == model_path("pointseg")
    assert parsed("pointseg:int8") == model_path("pointseg:int8")
    for file in ("runs/checkpoint.pt", "pointseg.onnx", "runs/pointseg"):
        assert parsed(file) == Path(file)
    with pytest.raises(SystemExit):
        parsed("pointsg")
    assert "did you mean pointseg" in capsys.readouterr().err
