"""The names edgeperc promises: complete, sorted, documented, and of one version."""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
import pickle
import pkgutil
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import edgeperc
import edgeperc.errors
import edgeperc.zoo
from checkout import REPOSITORY
from edgeperc.errors import ModelFileError
from edgeperc.inference import listing, providers
from edgeperc.system.atomic import write_atomic
from edgeperc.system.names import check_picture
from edgeperc.types.sensor import SENSORS, get_sensor

MODULES = sorted(
    found.name for found in pkgutil.walk_packages(edgeperc.__path__, "edgeperc.") if not found.name.endswith("__main__")
)
ERRORS = {name for name, thing in vars(edgeperc.errors).items() if isinstance(thing, type)}


def test_all_is_sorted_and_complete() -> None:
    assert edgeperc.__all__ == sorted({*edgeperc.__all__})
    assert {*edgeperc.MODULES} | ERRORS | {"__version__"} == {*edgeperc.__all__}


def test_every_name_has_a_page() -> None:
    """Each stands once in a table of the reference, which makes a page of it; errors stand on one page."""
    page = (REPOSITORY / "docs/reference/api.md").read_text("utf-8")
    listed = re.findall(r"^   (\w+)$", page, flags=re.MULTILINE)
    assert sorted(listed) == sorted({*edgeperc.__all__} - {*ERRORS, "__version__"})
    assert "automodule:: edgeperc.errors" in page


def test_every_name_is_importable() -> None:
    for name in edgeperc.__all__:
        thing = getattr(edgeperc, name)
        assert getattr(thing, "__name__", name) == name or inspect.ismodule(thing)
        assert name in dir(edgeperc)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Perciever'"):
        edgeperc.Perciever  # noqa: B018


def test_exported_names_exist_and_are_documented() -> None:
    for module_name in ("edgeperc", "edgeperc.zoo", *MODULES):
        module = importlib.import_module(module_name)
        assert module.__doc__, f"{module_name} does not say what it is"
        public = getattr(module, "__all__", None) or [
            name
            for name, thing in vars(module).items()
            if getattr(thing, "__module__", None) == module_name and name[0] != "_"
        ]
        assert len({*public}) == len(public), module_name
        for name in public:
            thing = getattr(module, name)
            if not inspect.isclass(thing) and not inspect.isroutine(thing):
                continue
            assert inspect.getdoc(thing), f"{module_name}.{name} has no docstring"
            # A dataclass without a docstring gets its signature for one.
            assert not str(thing.__doc__).startswith(f"{name}("), f"{module_name}.{name} has no docstring of its own"
            if inspect.isclass(thing) and thing.__module__ == module_name:
                for attribute, member in vars(thing).items():
                    if inspect.isfunction(member) and not attribute.startswith("_"):
                        assert inspect.getdoc(member), f"{module_name}.{name}.{attribute} has no docstring"


def test_errors_have_one_root_and_come_out_of_other_processes() -> None:
    for name in ERRORS:
        error = getattr(edgeperc, name)("onnxruntime", "cpu", "Running a model")
        assert isinstance(error, edgeperc.EdgepercError)
        assert repr(pickle.loads(pickle.dumps(error))) == repr(error)


NO_ROAD = edgeperc.TopView(
    np.zeros((4, 4), np.uint8), ("background", "drivable"), 1.0, (0.0, 4.0), (-2.0, 2.0), np.zeros((4, 4), np.bool_)
)
WRONG = {
    "an image": (edgeperc.ImageError, edgeperc.read_image),
    "a calibration": (edgeperc.CalibrationError, lambda given: edgeperc.Calibration.from_kitti(given, 9, 9)),
    "a mounting": (edgeperc.SensorError, edgeperc.Mounting.from_file),
    "poses": (edgeperc.TrackingError, edgeperc.Trajectory.from_tum),
    "a card": (ModelFileError, edgeperc.ModelCard.read),
    "a sensor": (edgeperc.SensorError, get_sensor),
    "a file": (edgeperc.OptionError, lambda given: write_atomic(given, b"")),
    "a picture": (edgeperc.OptionError, lambda given: check_picture(given, ".png")),
    "sensors": (edgeperc.PointsError, lambda given: edgeperc.merge(given, [])),
    "their poses": (edgeperc.SensorError, lambda given: edgeperc.merge([np.zeros((1, 4))], given)),
    "scans": (edgeperc.PointsError, lambda given: next(edgeperc.accumulate(given, 0.1))),
    "a perceiver": (edgeperc.OptionError, lambda given: edgeperc.stream([], given)),
    "a tracker": (edgeperc.OptionError, lambda given: edgeperc.stream([], print, given)),
    "tracks": (edgeperc.TrackingError, edgeperc.smooth_tracks),
    "boxes": (edgeperc.OptionError, lambda given: edgeperc.free_ahead(NO_ROAD, given)),
    "rules": (edgeperc.OptionError, lambda given: edgeperc.Perceiver(agree=given)),
    "a choice": (edgeperc.OptionError, lambda given: edgeperc.Perceiver(adapt=given)),
    "the text of a card": (edgeperc.CardError, edgeperc.ModelCard.from_json),
    "the text of a sensor": (edgeperc.SensorError, edgeperc.SensorProfile.from_json),
}
PATHS = ("an image", "a calibration", "a mounting", "poses", "a card", "a sensor", "a file", "a picture")


@pytest.mark.parametrize("what", WRONG)
@pytest.mark.parametrize("given", [7, 1.5, np.array(0.5), np.zeros(3)], ids=["int", "float", "one", "array"])
def test_what_is_of_another_type_is_a_typed_error(what: str, given: Any) -> None:
    error, take = WRONG[what]
    with pytest.raises(error, match=r"expected|no sensor|is not JSON"):
        take(given)


@pytest.mark.parametrize("what", PATHS)
def test_a_null_character_in_a_path_is_a_typed_error(what: str) -> None:
    error, take = WRONG[what]
    with pytest.raises(error):
        take(Path("a\0b.json"))


def test_the_version_is_the_changelogs_newest() -> None:
    released = re.findall(r"^## \[(\d+\.\d+\.\d+)\]", (REPOSITORY / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    assert released[0] == edgeperc.__version__
    assert importlib.metadata.version("edgeperc") == edgeperc.__version__


def test_shipped_models_are_found_by_name() -> None:
    for name in edgeperc.zoo.shipped_models():
        path = edgeperc.zoo.model_path(name)
        assert path.is_file()
        assert path.stem.removesuffix("-int8") == name


@pytest.mark.parametrize("name", ["pointsegg", "", "../models/pointseg"])
def test_unknown_model_lists_the_available_ones(name: str) -> None:
    with pytest.raises(ModelFileError) as caught:
        edgeperc.zoo.model_path(name)
    for shipped in edgeperc.zoo.shipped_models():
        assert shipped in str(caught.value)


def test_models_agree_with_the_zoo() -> None:
    found = {model.name: model for model in edgeperc.models()}
    assert tuple(found) == edgeperc.zoo.shipped_models()
    assert pickle.loads(pickle.dumps(found)) == found
    assert {name for name, model in found.items() if model.default} == {*edgeperc.zoo.DEFAULT}
    for name, model in found.items():
        assert [f"{name}:{precision}" for precision in model.variants] == [str(v) for v in edgeperc.zoo.resolve(name)]
        assert model.path.stat().st_size == pytest.approx(1e6 * model.size_mb, abs=5e3)
        assert model.licence
    assert found["pointseg"].purpose == "a class for every point (car, pedestrian, cyclist)"
    assert found["ssadnet"].purpose == "drivable area and boxes of car, van, truck"
    assert found["lodnn"].purpose == "drivable area"


def test_sensors_agree_with_the_profiles() -> None:
    assert [sensor.name for sensor in edgeperc.sensors()] == [*SENSORS]
    for sensor in edgeperc.sensors():
        profile = SENSORS[sensor.name]
        assert (sensor.beams, sensor.columns) == (len(profile.elevations_deg), profile.columns)
        assert sensor.field_of_view_deg == (min(profile.elevations_deg), max(profile.elevations_deg))
        assert sensor.remission_range == profile.remission_range
        assert (sensor.rendered_as is None) == (profile.remission is None)


def test_providers_agree_with_onnxruntime(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("onnxruntime")
    assert tuple(p.name for p in edgeperc.providers() if p.available) == providers.available_providers()
    assert {p.name: p.installed_by for p in edgeperc.providers()} == {**listing.INSTALLED_BY}
    assert {*listing.INSTALLED_BY} == {*providers.PROVIDERS}

    def missing() -> None:
        raise edgeperc.MissingExtraError("onnxruntime", "cpu", "Running a model")

    monkeypatch.setattr(providers, "load_onnxruntime", missing)
    assert not any(provider.available for provider in edgeperc.providers())


def test_listings_cannot_be_changed() -> None:
    for record in (edgeperc.models()[0], edgeperc.sensors()[0], edgeperc.providers()[0]):
        with pytest.raises(AttributeError):
            record.name = "another"  # type: ignore[misc]
