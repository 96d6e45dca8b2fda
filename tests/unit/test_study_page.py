"""report.html of a study: it needs no network, holds what it shows, and its viewer answers to keys and clicks."""

from __future__ import annotations

import base64
import html
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pssflow import metrics
from pssflow.reference import read_exr
from pssflow.study import harness, page, report
from pssflow.study.charts import error_chart
from pssflow.study.harness import Study
from pssflow.study.page import Chart
from pssflow.study.report import publish
from tests.unit.test_study_guides import study, synthetic

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


class Links(HTMLParser):
    """All that a page would load, and its scripts' text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.inside: list[str] = []
        self.scripts: dict[str, str] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        if tag != "a":
            self.loaded += [values[name] for name in ("src", "href", "data") if name in values]
        self.inside = [values.get("type", "code")] if tag == "script" else []

    def handle_data(self, data: str) -> None:
        for kind in self.inside:
            self.scripts[kind] = self.scripts.get(kind, "") + data


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> Study:
    """Two scenes, three methods (one has no image at first), one of them biased; one chart."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(harness, "flip", lambda image, truth: 0.25)
        patch.setattr(report, "_charts", _one_chart)
        methods = [synthetic("none"), synthetic("better", noise=0.5), synthetic("off", bias=0.2)]
        made = study(tmp_path_factory.mktemp("page"), *methods, scenes=2)
        name = "<b>scene & 1"  # what a folder may be called
        made.sceneries = [made.sceneries[0], harness.Scenery(name, made.sceneries[1].open)]
        publish(made, made.run(), "synthetic noise; training inside")
    return made


def _one_chart(study: Study, rows: Any, methods: Any, *_: Any) -> list[Chart]:
    path = study.folder / "error.png"
    error_chart(path, "Error", rows, methods)
    return [Chart(path.with_suffix(".svg"), "Error: x", first=True)]


@pytest.fixture(scope="module")
def text(done: Study) -> str:
    return (done.folder / "report.html").read_text(encoding="utf-8")


def test_it_loads_nothing_from_elsewhere(text):
    links = Links(text)
    assert links.loaded
    assert all(link.startswith("data:") for link in links.loaded)
    for forbidden in ("@import", "url(", "fetch(", "XMLHttpRequest", "import("):
        assert forbidden not in text
    # Addresses in a chart's SVG name its vocabulary; nothing else names any.
    assert "http" not in re.sub(r"data:image[^\"]*", "", text)


def test_it_says_what_was_found(text):
    plain = html.unescape(re.sub("<[^>]*>", " ", text.partition('<script type="application')[0]))
    assert "Synthetic noise; training inside" in plain
    assert "BIASED? off on scene 0" in plain
    assert 'class="warn"' in text
    for told in ("Summary", "Time to an error", "wins / ties / losses", "load average"):
        assert told in plain


def test_names_cannot_break_out(text):
    assert "<b>scene" not in text
    data = json.loads(Links(text).scripts["application/json"])
    assert data["scenes"][1]["name"] == "<b>scene & 1"


def test_images_and_errors_are_those_of_the_exrs(done, text):
    data = json.loads(Links(text).scripts["application/json"])
    assert [len(scene["views"]) for scene in data["scenes"]] == [7, 7]  # a reference, 3 × 2 times
    scene = data["scenes"][0]
    views = {(view["name"], view["time"]): view for view in scene["views"]}
    truth = read_exr(done.reference_path(done.rows[0])).image
    row = next(r for r in done.rows if (r.method, r.seed, r.time) == ("none", 0, 4.0))
    image = read_exr(done.image_path(row)).image
    view = views["none", 4.0]
    assert _decoded(view["image"]).shape == (64, 64, 3)
    grey = _decoded(view["error"]).astype(float)
    low, high = page.ERROR_RANGE
    shown = 10 ** (low + grey / 255 * (high - low))
    error = ((image - truth) ** 2 / metrics.local_scale(truth)).mean(axis=2)
    lit = (error > 10**low) & (error < 10**high)
    step = (high - low) / (page.LEVELS - 1)
    assert (
        np.abs(np.log10(shown[lit] / error[lit])).max() < 0.7 * step
    )  # rounded to a level, and that to a byte
    assert views["reference", None]["error"] is None
    assert "32 spp" in view["text"]


def test_a_large_study_keeps_its_longest_time_only(done, monkeypatch):
    monkeypatch.setattr(page, "MOST_PIXELS", 1000)
    scenes = page.study_scenes(done, done.rows)
    assert {view["time"] for view in scenes[0]["views"]} == {None, 4.0}


def _decoded(uri: str) -> np.ndarray:
    data = base64.b64decode(uri.removeprefix("data:image/png;base64,"))
    return np.array(Image.open(io.BytesIO(data)))


SCRIPT = """<script>
(async () => {
  const root = document.documentElement, seen = [];
  const settled = async () => { for (let i = 0; i < 40; i++) await new Promise(f => setTimeout(f, 10)); };
  const press = async key => {
    document.dispatchEvent(new KeyboardEvent("keydown", { key }));
    await settled(); seen.push(root.dataset.ready);
  };
  const sum = c => c.getContext("2d").getImageData(0, 0, c.width, c.height).data.reduce((a, b) => a + b, 0);
  await settled(); seen.push(root.dataset.ready);
  const image = sum(document.getElementById("main"));
  for (const key of ["0", "2", "e", "ArrowRight", "ArrowDown", "+"]) await press(key);
  const crops = [...document.querySelectorAll("#crops canvas")];
  const before = crops.map(sum), main = document.getElementById("main"), r = main.getBoundingClientRect();
  main.dispatchEvent(new PointerEvent("pointermove", { clientX: r.left + 5, clientY: r.top + 5 }));
  await settled();
  const moved = crops.map((c, i) => sum(c) !== before[i]);
  await press("r");
  document.querySelectorAll("#methods button")[3].click();
  await settled(); seen.push(root.dataset.ready);
  root.dataset.seen = JSON.stringify({ seen, moved, changed: image !== sum(main), image });
})();
</script></body>"""


@pytest.mark.long
@pytest.mark.timeout(180)
def test_the_viewer_in_a_browser(text, tmp_path):
    """Keys, clicks, zoom, false colours and crops that follow the pointer, in a headless browser without a network."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no Chromium is installed (apt install chromium)")
    path = tmp_path / "report.html"
    path.write_text(text.replace("</body>", SCRIPT), encoding="utf-8")
    command = [
        browser,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=20000",
    ]
    command += [
        "--proxy-server=127.0.0.1:9",
        f"--user-data-dir={tmp_path}",
        "--window-size=1200,900",
    ]
    done = subprocess.run(
        [*command, "--dump-dom", path.as_uri()], capture_output=True, text=True, timeout=120
    )
    found = re.search(r'data-seen="([^"]*)"', done.stdout)
    assert found, done.stderr[-2000:]
    told = json.loads(html.unescape(found[1]))
    states = [tuple(state.split("|")) for state in told["seen"]]
    assert states[0] == ("scene 0", "none", "4", "image", "1.00", "4")
    assert states[1][1:4] == ("reference", "null", "image")
    assert states[2][1:4] == ("better", "4", "image")
    assert states[3][1:4] == ("better", "4", "error")
    assert states[4][0] == "<b>scene & 1"
    assert states[5][1:3] == ("better", "1")
    assert states[6][4] == "1.25"
    assert states[7][4] == "1.00"
    assert states[8][1:4] == ("off", "1", "error")
    assert told["image"] > 0
    assert told["changed"]
    assert all(told["moved"])
