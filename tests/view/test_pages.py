"""Names from strangers (files, models, classes, messages) are only ever text: on pages, in reports and in pictures."""

from __future__ import annotations

import io
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_pictures import a_perception, a_scan, has_webgl, opened, scene_of

from edgeperc import Tracker
from edgeperc.evaluation.mistakes import Mistakes, draw_mistakes
from edgeperc.system.printable import printable
from edgeperc.types.perception import Box, Perception, PointLabels, TopView
from edgeperc.view import draw, draw_tracks, write_html
from edgeperc.view.canvas import as_png, new_figure, shorten, write_at
from edgeperc_bench.render import Section, html_page, markdown, text

RUN = "window.stolen = 1"
HOSTILE = (
    f"</script><script>{RUN}</script>",
    f"</title><script>{RUN}</script>",
    "<!--<script>",
    f"--><img src=x onerror='{RUN}'>",
    f"\"'><svg/onload={RUN}>",
    f"' onclick='{RUN}' \" onclick=\"{RUN}",
    "&lt;b&gt;",
    "lines\n\r\u2028\u2029\x85",
    "@@SCENE@@ @@TITLE@@ @@POLICY@@",
    "{{7*7}} ${stolen=1} \\1 \\g<0> %s {0}",
    "$x_{$ $\\frac{1}{",
    "\u202egpj.exe\u2066\u200f",
    "\x00\x1b[31m\x9b31m\x7f",
    "\udcff \ud83d",
    "\U0001f600 \u6f22 \u0416 \U000e0041",
    "__proto__",
    "constructor",
    "a" * 1000,
)


def perceived(scan: np.ndarray, names: tuple[str, ...]) -> Perception:
    """A perception whose classes and messages are ``names``."""
    perception = a_perception(scan)
    labels = (np.arange(len(scan)) % len(names)).astype(np.uint8)
    top = replace(perception.require_top_view(), classes=("background", "drivable", *names))
    boxes = tuple(Box(name, 0.9, (8.0 + 2 * k, 3.0, -0.9), (4.2, 1.8, 1.6), 0.3) for k, name in enumerate(names))
    return replace(
        perception,
        points=PointLabels(labels, perception.require_points().in_view, names),
        top_view=TopView(top.labels, top.classes, 0.1, top.x_range_m, top.y_range_m, np.ones_like(top.labels, bool)),
        boxes=boxes,
        fitness=names,
        providers={name: name for name in names},
        stage_ms=dict.fromkeys(names, 1.0),
    )


class Elements(HTMLParser):
    """The elements of a page with their attributes, and the text of each kind of element."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text: dict[str, str] = {}
        self._open = ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        self._open = tag

    def handle_data(self, data: str) -> None:
        self.text[self._open] = self.text.get(self._open, "") + data

    def tags(self) -> list[str]:
        return [tag for tag, _ in self.found]


def test_names_are_only_text_on_the_page(tmp_path: Path) -> None:
    scan = a_scan()[:7000]
    for k, names in enumerate((("plain", *HOSTILE), tuple(f"name {k}" for k in range(len(HOSTILE) + 1)))):
        for title in HOSTILE:
            write_html(perceived(scan, names), scan, tmp_path / "page.html", title=title)
            page = (tmp_path / "page.html").read_text()
            assert all(line.isprintable() for line in page.split("\n"))
            elements = Elements(page)
            if k == 0:
                hostile = elements.tags()
            assert elements.tags() == hostile  # the same elements with any names
            assert elements.text["title"].strip() == printable(title)
            assert not any(name.startswith("on") for _, attributes in elements.found for name in attributes)


def test_the_data_of_the_page_is_complete(tmp_path: Path) -> None:
    scan = a_scan()
    write_html(perceived(scan, ("plain", *HOSTILE)), scan, tmp_path / "page.html")
    scene = scene_of(tmp_path / "page.html")
    names = {one["name"] for one in scene["classes"]}
    assert set(map(printable, HOSTILE)) < names
    assert {box["name"] for box in scene["scans"][0]["boxes"]} <= names


# Any character, lone surrogates too.
ANY = st.characters(exclude_categories=())


@settings(max_examples=60)
@given(st.text(ANY, max_size=40), st.text(ANY, min_size=1))
def test_any_name_is_only_text(tmp_path_factory: pytest.TempPathFactory, title: str, name: str) -> None:
    scan = a_scan()[5990:6700]
    path = tmp_path_factory.getbasetemp() / "page.html"
    write_html(perceived(scan, ("background", name)), scan, path, title=title)
    elements = Elements(path.read_text())
    assert elements.tags().count("script") == 2
    assert elements.text["h1"].strip() == printable(title or "A scan").strip()


def test_no_name_runs_on_the_page(browser: Any, tmp_path: Path) -> None:
    scan = a_scan()[5990:6700]
    for title in HOSTILE[:12]:
        write_html(perceived(scan, ("plain", *HOSTILE)), scan, tmp_path / "page.html", title=title)
        page, wrong = opened(browser, tmp_path / "page.html")
        assert page.text_content("h1") == printable(title)
        assert page.evaluate("window.stolen") is None
        if has_webgl(page):
            listed = page.evaluate(
                "[...document.querySelectorAll('#classes label')].map(row => row.childNodes[2].textContent)"
            )
            assert set(map(printable, HOSTILE)) < set(listed)
            for box in page.query_selector_all("#classes input")[:3]:
                box.click()
        assert page.evaluate("window.stolen") is None
        assert not wrong
        page.close()


def test_no_other_script_runs_on_the_page(browser: Any, tmp_path: Path) -> None:
    """If a text should ever escape its place, the page's policy still stops it."""
    scan = a_scan()
    write_html(a_perception(scan), scan, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    added = f"<script>{RUN}</script><img src=x onerror='{RUN}'><base href='http://site.example/'><body onload='{RUN}'>"
    assert page.count("<footer>") == 1
    for policy in (True, False):
        (tmp_path / "page.html").write_text(page.replace("<footer>", f"{added}<footer>"))
        if not policy:  # what is added does run elsewhere
            start = page.index("<meta http-equiv")
            meta = page[start : page.index(">", start) + 1]
            (tmp_path / "page.html").write_text(page.replace(meta, "").replace("<footer>", f"{added}<footer>"))
        shown, _ = opened(browser, tmp_path / "page.html")
        assert shown.evaluate("window.stolen") == (None if policy else 1)
        assert shown.evaluate("document.querySelectorAll('#classes label').length") > 3
        shown.close()


def parts_of(names: tuple[str, ...]) -> list[Section]:
    rows = [("name", "ms"), *((name, name) for name in names)]
    return [Section(name, (name, name), rows) for name in names]


def test_names_are_only_text_in_reports(browser: Any, tmp_path: Path) -> None:
    plain = tuple(f"name {k}" for k in range(len(HOSTILE)))
    page = html_page(parts_of(HOSTILE), HOSTILE[0], ["<svg></svg>"])
    assert Elements(page).tags() == Elements(html_page(parts_of(plain), "title", ["<svg></svg>"])).tags()
    for report in (page, markdown(parts_of(HOSTILE), HOSTILE[7]), text(parts_of(HOSTILE))):
        assert all(line.isprintable() for line in report.split("\n"))
        report.encode()
    for form in (lambda names: markdown(parts_of(names), "title"), lambda names: text(parts_of(names))):
        assert form(HOSTILE).count("\n") == form(plain).count("\n")
    path = tmp_path / "report.html"
    path.write_text(page)
    shown, wrong = opened(browser, path)
    assert shown.evaluate("window.stolen") is None
    assert shown.text_content("h1") == HOSTILE[0]
    assert shown.text_content("td >> nth=0") == HOSTILE[0]
    assert not wrong
    path.write_text(page.replace("</body>", f"<script>{RUN}</script><img src=x onerror='{RUN}'></body>"))
    shown, _ = opened(browser, path)
    assert shown.evaluate("window.stolen") is None


@pytest.mark.usefixtures("matplotlib")
@pytest.mark.filterwarnings("error")
def test_names_are_only_text_in_pictures() -> None:
    """No formula, no missing glyph, no line break: each is drawn as one line, or not at all."""
    image = pytest.importorskip("PIL.Image")
    scan = a_scan()[5000:]
    box = Box("car", 0.9, (20.0, 3.0, -0.9), (4.2, 1.8, 1.6), 0.3)
    points = np.zeros((3, 4), np.float32)
    scans = []
    for names in zip(HOSTILE[::2], HOSTILE[1::2], strict=True):
        found = tuple(replace(box, label=name) for name in names)
        missed = tuple((each, 3) for each in found)
        scans.append(Mistakes(*names, points, np.zeros(3, np.uint8), found, missed, found))
    titles = new_figure(1600, 600)
    for k, title in enumerate(HOSTILE):
        write_at(titles, 28, 30 + 30 * k, shorten(titles, title, 1500, fontsize=16.0), fontsize=16.0)
    pictures = [draw(perceived(scan, ("background", *HOSTILE)), scan, title=HOSTILE[0])]
    pictures += [draw_mistakes(scans, title=HOSTILE[10]), as_png(titles, None)]
    for title in HOSTILE:
        tracker = Tracker()
        draw_tracks([tracker.update([replace(box, label=title)], 0.1 * k) for k in (1, 2)], title=title)
    for picture in pictures:
        with image.open(io.BytesIO(picture)) as shown:
            assert shown.width == 1600
