"""The names edgeperc promises: complete, sorted, documented, and of one version."""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
import pkgutil
import re
from pathlib import Path

import pytest

import edgeperc
import edgeperc.errors
import edgeperc.zoo
from edgeperc.errors import ModelFileError

REPOSITORY = Path(__file__).resolve().parent.parent
MODULES = sorted(
    found.name for found in pkgutil.walk_packages(edgeperc.__path__, "edgeperc.") if not found.name.endswith("__main__")
)


def test_all_is_sorted_and_complete() -> None:
    assert edgeperc.__all__ == sorted({*edgeperc.__all__})
    assert {*edgeperc.errors.__all__} < {*edgeperc.__all__}
    lazy = {*edgeperc._MODULES}
    assert lazy | {*edgeperc.errors.__all__} | {"__version__"} == {*edgeperc.__all__}


@pytest.mark.parametrize("name", edgeperc.__all__)
def test_every_name_is_importable(name: str) -> None:
    assert getattr(edgeperc, name) is not None
    assert name in dir(edgeperc)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Perciever'"):
        edgeperc.Perciever  # noqa: B018


@pytest.mark.parametrize("module_name", ["edgeperc", "edgeperc.zoo", *MODULES])
def test_what_a_module_exports_is_there_and_documented(module_name: str) -> None:
    module = importlib.import_module(module_name)
    assert module.__doc__, f"{module_name} does not say what it is"
    assert len({*module.__all__}) == len(module.__all__)
    for name in module.__all__:
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


def test_errors_have_one_root() -> None:
    for name in edgeperc.errors.__all__:
        assert issubclass(getattr(edgeperc, name), edgeperc.EdgepercError)


def test_the_version_is_the_changelogs_newest() -> None:
    released = re.findall(r"^## \[(\d+\.\d+\.\d+)\]", (REPOSITORY / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    assert released[0] == edgeperc.__version__
    assert importlib.metadata.version("edgeperc") == edgeperc.__version__


def test_shipped_models_are_found_by_name() -> None:
    for name in edgeperc.zoo.shipped_models():
        path = edgeperc.zoo.model_path(name)
        assert path.is_file()
        assert path.name == f"{name}.onnx"


@pytest.mark.parametrize("name", ["pointsegg", "", "../models/pointseg", "pointseg.onnx"])
def test_an_unknown_model_lists_those_there_are(name: str) -> None:
    with pytest.raises(ModelFileError) as caught:
        edgeperc.zoo.model_path(name)
    for shipped in edgeperc.zoo.shipped_models():
        assert shipped in str(caught.value)
