"""Names from strangers are names, not paths: nothing is written outside of the folder that was asked for."""

from __future__ import annotations

import contextlib
import json
import re
import tempfile
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_pictures import a_perception, a_scan
from tiny_model import CONVOLUTION, INITIALIZER, graph, model, tiny_card

from cli_helpers import POINTSEG
from edgeperc.datasets.kitti import KittiObjects
from edgeperc.errors import CardError, OptionError, PointsError, SensorError
from edgeperc.records import PerceivedScan
from edgeperc.sinks.prelabels import KINDS, PrelabelSink
from edgeperc.system.names import check_file, check_name, check_text, stem_of
from edgeperc.types.card import ModelCard
from edgeperc.types.perception import Box
from edgeperc.types.sensor import get_sensor
from edgeperc.view import write_html
from edgeperc.zoo import listed

PATHS = ("../../evil", "/abs/evil", "..", ".", "a/b", "a\\b", "C:evil", "~", "a/../b", "\\\\host\\share", "x\0", "")
OTHERS = (
    ".hidden",
    "-option",
    "dot.",
    "nul",
    "CON.txt",
    "com1",
    "a..b",
    "a b",
    "a\nb",
    "x\u202ey",
    "ä",
    "x" * 201,
    "*",
)
REASONABLE = ("pointseg", "ssadnet-edge-int8", "kulseg", "my_net.v2", "Net+", "_tiny", "3d", "console", "x" * 200)

names = st.one_of(
    st.text(max_size=30),
    st.text("./\\:-_a\0 \n", max_size=12),
    st.sampled_from((*PATHS, *OTHERS, *REASONABLE)),
    st.tuples(st.sampled_from(PATHS), st.text(max_size=5)).map("".join),
)


class Tags(HTMLParser):
    """The tags of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.found.append(tag)


def is_allowed(name: str) -> bool:
    try:
        check_name("name", name, CardError)
    except CardError:
        return False
    return True


@pytest.mark.parametrize("name", [*PATHS, *OTHERS])
def test_what_is_not_the_name_of_one_file_everywhere_is_refused(name: str) -> None:
    with pytest.raises(CardError, match=r"^name .*; expected "):
        replace(POINTSEG, name=name)
    document = json.loads(POINTSEG.to_json()) | {"name": name}
    with pytest.raises(CardError, match="expected "):
        ModelCard.from_json(json.dumps(document))


def test_names_that_were_used_so_far_are_accepted() -> None:
    for name in (*REASONABLE, *(variant.name for variant in listed())):
        assert replace(POINTSEG, name=name).name == name


@given(names)
def test_an_allowed_name_is_one_part_of_a_path(name: str) -> None:
    if is_allowed(name):
        assert Path("out", name).name == Path("out", f"{name}.onnx").stem == name
        assert Path("out", name).resolve().parent == Path("out").resolve()
        assert len(f".{name}.onnx".encode()) <= 255
        check_file("name", name, CardError)
        check_text("name", name, CardError)


@settings(max_examples=60)
@given(names)
@example("../../evil")
def test_a_repository_for_triton_stays_in_its_folder(name: str) -> None:
    triton = pytest.importorskip("edgeperc_export.release.triton")
    card = json.loads(tiny_card().to_json()) | {"name": name}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        file, out = root / "network.onnx", root / "a" / "b" / "out"
        text = json.dumps(card).encode()
        file.write_bytes(model(graph(CONVOLUTION, INITIALIZER), card=text))
        try:
            written = triton.write_repository(out, [file])
        except CardError:
            assert not is_allowed(name)
            assert not out.exists()
        except triton.ModelError:
            assert name.lower() == "edgeperc"
        else:
            assert {path.parent for path in written} == {out}
            assert (out / name / "1" / "model.onnx").is_file()
        outside = {path for path in root.rglob("*") if path.is_file() and not path.is_relative_to(out)}
        assert outside == {file}


@pytest.mark.parametrize(
    "text", ["plain", 'quo"te', "back\\slash", "stra\u00dfe \U0001f600", "a\nb", '" } model { name: "x']
)
def test_strings_of_configurations_are_one_string(text: str) -> None:
    triton = pytest.importorskip("edgeperc_export.release.triton")
    quoted = triton.quoted(text)
    assert quoted.isascii()
    assert quoted.isprintable()
    # Octal escapes are those of Python's bytes.
    assert eval(f"b{quoted}").decode() == text


@pytest.mark.parametrize("name", ["", "a\nb", "\x1b[31m", "x" * 201, " "])
def test_texts_that_no_line_can_show_are_refused(name: str) -> None:
    with pytest.raises(SensorError, match="name is"):
        replace(get_sensor("hdl-64e"), name=name)
    with pytest.raises(CardError, match="class "):
        replace(POINTSEG, classes=("background", name))
    pytest.importorskip("rosbags")
    from edgeperc.ros2.messages import RosMessages

    with pytest.raises(OptionError, match="the frame is"):
        RosMessages(name)


def test_classes_and_sensors_may_have_blanks_and_letters_of_any_script() -> None:
    for name in ("road sign", "Fußgänger", "行人", "a/b"):
        assert replace(POINTSEG, classes=("background", name)).classes[1] == name
        assert replace(get_sensor("hdl-64e"), name=name).name == name


@pytest.mark.parametrize("name", [name for name in PATHS if name not in ("", "~") and "\0" not in name])
def test_a_table_of_scans_names_no_path(name: str, tmp_path: Path) -> None:
    (tmp_path / "training").mkdir()
    (tmp_path / "frames.csv").write_text(f'name,drive\n"{name}",d\n')
    with pytest.raises(PointsError, match="plain file name"):
        KittiObjects(tmp_path)


@settings(max_examples=25)
@given(st.sampled_from(KINDS), names, names)
@example("kitti", "", " ")
def test_labels_of_a_run_stay_in_its_folder(kind: str, name: str, label: str) -> None:
    scan = a_scan()
    perception = replace(
        a_perception(scan), boxes=(Box(label or "x", 0.5, (8.0, 0.0, -1.0), (4.0, 2.0, 1.5), 0.0),), points=None
    )
    if "\0" in name:
        return  # no file has such a name
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "a" / "out"
        sink = PrelabelSink(out, kind)
        try:
            sink.write(PerceivedScan(name or "0.bin", 0.0, scan, perception, None, get_sensor("hdl-64e")))
        except (OSError, OptionError):  # longer than names of files are
            assert len(stem_of(name)[0].encode(errors="replace")) > 100 or kind == "cvat"
        finally:
            sink.close()
        assert all(path.is_relative_to(out) for path in Path(folder).rglob("*") if path.is_file())
        for file in out.glob("label_2/*.txt"):
            assert [len(line.split()) for line in file.read_text("utf-8").splitlines()] == [15]


@given(names)
def test_a_topic_is_a_name_of_ros_or_refused(name: str) -> None:
    from edgeperc.ros2.graph import full_name

    with contextlib.suppress(OptionError):
        assert re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", full_name(name))


@settings(max_examples=25)
@given(st.one_of(names, names.map(lambda name: f"</script><script>{name}"), names.map(lambda name: f"<img {name}>")))
def test_a_page_shows_names_as_text(name: str) -> None:
    scan = a_scan()
    label = name or "x"
    perception = replace(a_perception(scan), boxes=(Box(label, 0.5, (8.0, 0.0, -1.0), (4.0, 2.0, 1.5), 0.0),))
    plain = replace(perception, boxes=(replace(perception.boxes[0], label="x"),))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "page.html"
        tags = []
        for each, title in ((perception, name), (plain, "x")):
            write_html(each, scan, file, title=title)
            tags.append(Tags(file.read_text("utf-8")).found)
        assert tags[0] == tags[1]
