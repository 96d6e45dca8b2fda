"""The command: what it writes and prints, and that each wrong input ends in one clear line."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import pytest

from pssflow.cli import main
from pssflow.output import dump_json

ROOT = Path(__file__).parents[2]
CORNELL = ROOT / "scenes" / "cornell-box" / "scene.xml"
TINY = ("--variant", "scalar_rgb", "-D", "resolution=16")
"""Options under which the Cornell box renders in milliseconds."""

RUN_KEYS = {
    "scene", "guide", "chosen", "a", "k", "parametrisation", "seed", "threads", "camera_rays", "paths_found",
    "nonzero", "nonzero_share", "pilot", "mean", "variance", "relmse", "relmse_trimmed", "max_weight",
    "max_contribution", "ess", "diagnostics", "seconds",
}  # fmt: skip
"""What `--json` promises."""


class Outcome(NamedTuple):
    """Of one call of the command."""

    code: int
    out: str
    err: str


Command = Callable[..., Outcome]


@pytest.fixture
def command(capfd, tmp_path, monkeypatch) -> Iterator[Command]:
    """The command in this process, in a folder of its own; importing Mitsuba anew would cost a second each time."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    level = mi.log_level() if mi.variant() else None

    def run(*arguments: object) -> Outcome:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        return Outcome(code, *capfd.readouterr())

    yield run
    if level is not None:
        mi.set_log_level(level)


def process(*arguments: object, folder: Path, **variables: str) -> Outcome:
    """The command in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "pssflow", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=folder,
        env=os.environ | variables,
        timeout=100,
    )
    return Outcome(done.returncode, done.stdout, done.stderr)


# --- scenes of a few lines ------------------------------------------------------------------------------------------

CAMERA = """<sensor type="perspective">
  <transform name="to_world"><lookat origin="0,0,5" target="{target}" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
</sensor>"""
FRONT = CAMERA.format(target="0,0,0")
PLATE = '<shape type="rectangle"/>'
LAMP = """<shape type="rectangle">
  <transform name="to_world"><rotate x="1" angle="180"/><translate z="3"/></transform>
  <emitter type="area"><rgb name="radiance" value="1"/></emitter>
</shape>"""


def scene_file(*parts: str) -> str:
    return "\n".join(('<scene version="3.0.0">', *parts, "</scene>"))


def mesh_scene(name: str) -> str:
    plugin = Path(name).suffix[1:]
    return scene_file(
        FRONT, LAMP, f'<shape type="{plugin}"><string name="filename" value="{name}"/></shape>'
    )


def ply(vertices: Sequence[Sequence[float]], face: Sequence[int]) -> bytes:
    """A binary mesh of one triangle: Mitsuba reads NaN from binary files only."""
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    body = np.array(vertices, "<f4").tobytes() + bytes([3]) + np.array(face, "<i4").tobytes()
    return head.encode() + body


CORNERS = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
BROKEN_CORNERS = [(0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0), (0.0, 1.0, 0.0)]

FILES: dict[str, str | bytes] = {
    "good.xml": scene_file(FRONT, PLATE, LAMP),
    "malformed.xml": '<scene version="3.0.0">\n<shape type="sphere">\n</scene>',
    "text.xml": "this is no XML",
    "misspelt.xml": scene_file(FRONT, '<shape type="rectangel"/>'),
    "property.xml": scene_file(FRONT, '<shape type="sphere"><float name="radios" value="1"/></shape>'),
    "hair.xml": scene_file(FRONT, LAMP, '<shape type="sphere"><bsdf type="hair"/></shape>'),
    "no-mesh.xml": mesh_scene("none.ply"),
    "nan.xml": mesh_scene("nan.ply"),
    "nan.ply": ply(BROKEN_CORNERS, (0, 1, 2)),
    "index.xml": mesh_scene("index.ply"),
    "index.ply": ply(CORNERS, (0, 1, 99)),
    "empty.xml": scene_file(),
    "no-shape.xml": scene_file(FRONT),
    "no-sensor.xml": scene_file(PLATE, LAMP),
    "shape.xml": '<shape type="sphere" version="3.0.0"/>',
    "guide.safetensors": b"\x10\x00\x00\x00\x00\x00\x00\x00 this is no guide",
    "truncated.safetensors": b"\xff\xff",
    "empty.safetensors": b"",
    "broken.json": '{"passes": [',
    "foreign.json": '{"name": "value"}',
    "list.json": "[1, 2]",
    "runs.json": '{"reference": {}, "runs": [{}, {}]}',
    "image.exr": b"this is no image",
    "file": b"",
}  # fmt: skip


@pytest.fixture
def files(tmp_path) -> Path:
    """All of `FILES` in a folder."""
    for name, content in FILES.items():
        data = content.encode() if isinstance(content, str) else content
        (tmp_path / name).write_bytes(data)
    return tmp_path


def tree(folder: Path) -> dict[str, bytes | None]:
    """All that lies in a folder, with what files hold."""
    return {str(p): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


# --- wrong input ----------------------------------------------------------------------------------------------------


class Case(NamedTuple):
    """A wrong call: its arguments, a part of the message, the exit code."""

    name: str
    arguments: str
    message: str
    code: int = 2


RENDER = "render good.xml -o out.exr --variant scalar_rgb "
CASES = [
    Case("no command", "paint", "No such command 'paint'"),
    Case("no scene given", "render -o out.exr", "Missing argument 'SCENE.xml'"),
    Case("no output given", "render good.xml", "Missing option '-o'"),
    Case("unknown option", RENDER + "--sp 3", "--sp"),
    Case("missing file", "render missing.xml -o out.exr", "missing.xml: there is no such file"),
    Case("a folder", "render . -o out.exr", "is a folder"),
    Case("malformed XML", "render malformed.xml -o out.exr", "Start-end tags mismatch (line 3"),
    Case("no XML", "render text.xml -o out.exr", "No document element found"),
    Case("misspelt plugin", "render misspelt.xml -o out.exr", '"rectangel" not found'),
    Case("unread property", "render property.xml -o out.exr", '"radios"'),
    Case("unsupported plugin", "render hair.xml -o out.exr", 'BSDF "hair"'),
    Case("missing mesh", "render no-mesh.xml -o out.exr", "none.ply"),
    Case("NaN vertex", "render nan.xml -o out.exr", "invalid vertex position"),
    Case("index out of range", "render index.xml -o out.exr", "face 0 refers to vertex 99"),
    Case("empty scene", "render empty.xml -o out.exr", "sensor"),
    Case("no shape", "render no-shape.xml -o out.exr", "no shape"),
    Case("no sensor", "render no-sensor.xml -o out.exr", "sensor"),
    Case("no such sensor", RENDER + "--sensor 3", "`sensor` = 3"),
    Case("not a scene", "render shape.xml -o out.exr", "not a scene"),
    Case("wrong variant", "render good.xml -o out.exr --variant scalar_spectral", "scalar_spectral"),
    Case("unknown variant", "render good.xml -o out.exr --variant scalar", "scalar_rgb, llvm_ad_rgb"),
    Case("spp 0", RENDER + "--spp 0", "0 is not in the range"),
    Case("spp and time", RENDER + "--spp 4 --time 1", "both given"),
    Case("too few for a pilot", RENDER + "--guide realnvp --spp 1", "`spp` = 1"),
    Case("negative time", RENDER + "--time -1", "'-1' is no number of seconds"),
    Case("NaN seconds", RENDER + "--time nan", "'nan' is no number of seconds"),
    Case("k 0", RENDER + "--k 0", "0 is not in the range"),
    Case("uniform fraction 2", RENDER + "--uniform-fraction 2", "2.0 is not in the range"),
    Case("NaN fraction", RENDER + "--uniform-fraction nan", "uniform"),
    Case("emitter strategy", RENDER + "--emitter-strategy best", "'best' is not one of"),
    Case("parametrisation", RENDER + "--parametrisation sphere", "'sphere' is not one of"),
    Case("preset", RENDER + "--preset paper", "'paper'"),
    Case("negative seed", RENDER + "--seed -1", "-1 is not in the range"),
    Case("threads 0", RENDER + "--threads 0", "0 is not in the range"),
    Case("size", RENDER + "--size 640", "expected WIDTHxHEIGHT"),
    Case("size 0", RENDER + "--size 0x4", "`size` = 0"),
    Case("huge size", RENDER + "--scale 9999", "pixels"),
    Case("negative scale", RENDER + "--scale -1", "'-1' is no factor"),
    Case("size and scale", RENDER + "--size 4x4 --scale 2", "both given"),
    Case("-D without =", RENDER + "-D resolution", "expected key=value"),
    Case("unknown -D", RENDER + "-D resolution=4", "resolution"),
    Case("unknown guide", RENDER + "--guide nvp", "realnvp"),
    Case("unknown part", RENDER + "--guide realnvp+nvp", "nvp"),
    Case("unknown guide option", RENDER + "--set realnvp.epoch=3", "epoch"),
    Case("value of an option", RENDER + "--set realnvp.epochs=-3", "epochs"),
    Case("option without a guide", RENDER + "--set epochs=3", "expected guide.option=value"),
    Case("another guide's option", RENDER + "--set vegas.bins=3", "'vegas' is not among"),
    Case("option of none", RENDER + "--guide none --set none.a=3", "takes no options"),
    Case("guide file missing", RENDER + "--load-guide no.safetensors", "no.safetensors"),
    Case("foreign guide file", RENDER + "--load-guide guide.safetensors", "guide.safetensors"),
    Case("truncated guide file", RENDER + "--load-guide truncated.safetensors", "truncated"),
    Case("empty guide file", RENDER + "--load-guide empty.safetensors", "empty.safetensors"),
    Case("two guides", RENDER + "--guide none --load-guide guide.safetensors", "both given"),
    Case("nothing to save", RENDER + "--guide none --save-guide g.safetensors", "learns nothing"),
    Case("replay missing", RENDER + "--replay no.json", "no.json: there is no such file"),
    Case("replay broken", RENDER + "--replay broken.json", "is no JSON"),
    Case("replay foreign", RENDER + "--replay foreign.json", "lacks `passes`"),
    Case("replay a list", RENDER + "--replay list.json", "holds a list"),
    Case("replay of many", RENDER + "--replay runs.json", "holds 2 runs"),
    Case("replay and a guide", RENDER + "--replay broken.json --guide none", "both given"),
    Case("replay and spp", RENDER + "--replay broken.json --spp 4", "both given"),
    Case("not an EXR", "render good.xml -o out.png", "must end in .exr"),
    Case("no output folder", "render good.xml -o no/out.exr", "no folder no", 1),
    Case("output is a folder", "render good.xml -o /proc/out.exr", "cannot be written", 1),
    Case("guide unwritable", RENDER + "--save-guide file/g.safetensors", "cannot be written", 1),
    Case("no guides", "compare good.xml --guides ,", "names no guide"),
    Case("a guide twice", "compare good.xml --guides none,none", "twice"),
    Case("unknown in compare", "compare good.xml --guides none,nvp", "realnvp"),
    Case("reference missing", "compare good.xml --reference no.exr", "no.exr: there is no such"),
    Case("reference broken", "compare good.xml -o new/dir --reference image.exr", "image.exr"),
    Case("reference time", "compare good.xml --reference-time 0", "'0' is no number of seconds"),
    Case("folder is a file", "compare good.xml -o file", "file: cannot be written", 1),
    Case("compare missing", "compare missing.xml -o new/dir", "there is no such file"),
    Case("info missing", "info missing.xml", "there is no such file"),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_wrong_input_is_one_line(case, command, files):
    before = tree(files)
    outcome = command(*case.arguments.split())
    assert outcome.err.startswith("pssflow: error: ")
    assert outcome.err.count("\n") == 1, outcome.err
    assert case.message in outcome.err
    assert "Traceback" not in outcome.err
    assert outcome.out == ""
    assert outcome.code == case.code
    assert tree(files) == before


def test_embree_missing(files):
    outcome = process(*RENDER.split(), folder=files, EMBREE4_LIBRARY="/nonexistent/libembree4.so")
    assert outcome.code == 1
    assert outcome.err.startswith("pssflow: error: ")
    assert outcome.err.count("\n") == 1, outcome.err
    assert "/nonexistent/libembree4.so" in outcome.err
    assert not (files / "out.exr").exists()


@pytest.mark.parametrize(
    ("parts", "reason"),
    [((FRONT, PLATE), "no emitter"), ((CAMERA.format(target="0,0,9"), PLATE, LAMP), "no path")],
    ids=["no emitter", "no path found"],
)
@pytest.mark.parametrize("guide", ["none", "realnvp"])
def test_a_scene_without_light_is_black_with_a_notice(parts, reason, guide, command, tmp_path):
    (tmp_path / "dark.xml").write_text(scene_file(*parts))
    options = ("--variant", "scalar_rgb", "--guide", guide, "--json")
    outcome = command("render", "dark.xml", "-o", "dark.exr", *options)
    assert outcome.code == 0
    assert "pssflow: note: " in outcome.err
    run = json.loads(outcome.out)
    assert run["mean"] == [0, 0, 0]
    assert any(reason in note for note in run["notes"]), run["notes"]
    assert reason in outcome.err
    assert not pixels(tmp_path / "dark.exr").any()


def test_ctrl_c_ends_soon_and_leaves_nothing(tmp_path):
    """From the start of the command on: while loading, learning or rendering."""
    script = (
        "import signal, sys; from pssflow.cli import main; "
        # A shell's background job, as these tests may be, ignores the signal and hands that on.
        "signal.signal(signal.SIGINT, signal.default_int_handler); "
        "print('up', flush=True); sys.exit(main())"
    )
    arguments = ["render", CORNELL, "-o", "out.exr", "--time", "60", "--variant", "scalar_rgb"]
    with subprocess.Popen(
        [sys.executable, "-c", script, *map(str, arguments)],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        assert running.stdout is not None
        assert running.stdout.readline() == "up\n"
        time.sleep(2.5)
        assert running.poll() is None, "it was to render for a minute"
        start = time.perf_counter()
        running.send_signal(signal.SIGINT)
        _, err = running.communicate(timeout=30)
        took = time.perf_counter() - start
    assert running.returncode == 130
    assert "interrupted" in err
    assert "Traceback" not in err
    assert took < 3.0  # a second on an idle machine
    assert list(tmp_path.iterdir()) == []


# --- what it does ---------------------------------------------------------------------------------------------------


def pixels(path: Path) -> np.ndarray[Any, Any]:
    """The image of an EXR, (H, W, 3)."""
    layers = dict(mi.Bitmap(str(path)).split())
    return np.array(layers["<root>"])


def test_render_writes_image_variance_and_record(command, tmp_path):
    outcome = command("render", CORNELL, "-o", "out.exr", "--guide", "none", "--spp", 32, *TINY)
    assert outcome.code == 0, outcome.err
    assert outcome.err == ""
    assert "wrote out.exr and out.json" in outcome.out
    layers = {name: np.array(part) for name, part in mi.Bitmap("out.exr").split()}
    assert layers.keys() == {"<root>", "variance"}
    assert layers["<root>"].shape == layers["variance"].shape == (16, 16, 3)
    assert layers["<root>"].mean() > 0.01
    record = json.loads(Path("out.json").read_text())
    assert record.keys() >= RUN_KEYS
    np.testing.assert_allclose(record["mean"], layers["<root>"].mean(axis=(0, 1)), rtol=1e-4)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.exr", "out.json"]


def test_json_is_one_object_alone_on_stdout(command):
    outcome = command(
        "render", CORNELL, "-o", "out.exr", "--spp", 8, *TINY, "--json",
        "--guide", "realnvp", "--set", "realnvp.epochs=1",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    assert outcome.out.count("\n") == 1
    run = json.loads(outcome.out)
    assert run.keys() >= RUN_KEYS
    assert run["guide"] == run["chosen"] == "realnvp"
    assert run["camera_rays"] + run["pilot"]["camera_rays"] == 8 * 16 * 16
    assert run["nonzero_share"] == pytest.approx(run["nonzero"] / run["paths_found"])
    assert run["relmse"] is None


@pytest.mark.parametrize("guide", ["realnvp", "table", "auto"])
def test_replay_repeats_a_run_bit_for_bit(guide, command):
    setting = ("--set", "realnvp.epochs=1") if guide == "realnvp" else ()
    arguments = ("--guide", guide, "--spp", 8, *TINY, "--seed", 5, *setting, "-q")
    first = command("render", CORNELL, "-o", "a.exr", *arguments)
    assert first.code == 0, first.err
    second = command("render", CORNELL, "-o", "b.exr", *TINY, "--replay", "a.json", "--threads", 1)
    assert second.code == 0, second.err
    np.testing.assert_array_equal(pixels(Path("a.exr")), pixels(Path("b.exr")))


def test_auto_says_why(command):
    arguments = ("render", CORNELL, "-o", "a.exr", "--spp", 16, *TINY)
    plain, explained = command(*arguments), command(*arguments, "--explain")
    assert "auto: " in plain.out
    assert "what auto considered" in explained.out
    assert "direction-table" in explained.out


@pytest.mark.parametrize(
    ("guide", "chosen"),
    [("realnvp", "realnvp"), ("table", "direction-table+emitter-table+light-table+ray-table")],
)
def test_a_saved_guide_is_used_again_and_refused_elsewhere(guide, chosen, command):
    learned = ("--guide", guide, "--save-guide", "g.safetensors")
    command("render", CORNELL, "-o", "a.exr", "--spp", 8, *TINY, *learned)
    again = command(
        "render",
        CORNELL,
        "-o",
        "b.exr",
        "--spp",
        4,
        *TINY,
        "--load-guide",
        "g.safetensors",
        "--json",
    )
    assert again.code == 0, again.err
    run = json.loads(again.out)
    assert run["chosen"] == chosen
    assert run["pilot"]["camera_rays"] == 0
    assert run["camera_rays"] == 4 * 16 * 16
    # Another number of bounces has other columns, another film size is another scene.
    for option in (("--k", 3), ("-D", "max_depth=3", "--size", "8x8")):
        refused = command(
            "render", CORNELL, "-o", "c.exr", *TINY, "--load-guide", "g.safetensors", *option
        )
        assert refused.code == 2
        assert refused.err.count("\n") == 1
        assert "g.safetensors" in refused.err
    assert not Path("c.exr").exists()
    damaged = Path("g.safetensors").read_bytes()
    Path("half.safetensors").write_bytes(damaged[: len(damaged) // 2])
    refused = command("render", CORNELL, "-o", "c.exr", *TINY, "--load-guide", "half.safetensors")
    assert refused.code == 2
    assert "half.safetensors" in refused.err


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
@pytest.mark.parametrize(
    ("option", "shape"), [(("--size", "24x10"), (10, 24, 3)), (("--scale", "0.5"), (8, 8, 3))]
)
def test_the_film_has_the_size_asked_for(variant, option, shape, command):
    arguments = ("--guide", "none", "--spp", 1, "-D", "resolution=16", "--variant", variant)
    outcome = command("render", CORNELL, "-o", "out.exr", *arguments, *option)
    assert outcome.code == 0, outcome.err
    assert pixels(Path("out.exr")).shape == shape


def test_preset_thesis(command):
    outcome = command(
        "render",
        CORNELL,
        "-o",
        "out.exr",
        *TINY,
        "--preset",
        "thesis",
        "--json",
        "--set",
        "realnvp.epochs=1",
    )
    run = json.loads(outcome.out)
    assert (run["emitter_strategy"], run["a"]) == ("nee", 0.0)
    assert [(entry["kind"], entry["spp"]) for entry in run["passes"]] == [
        ("pilot", 16),
        ("guided", 16),
    ]
    assert run["camera_rays"] == 16 * 16 * 16


def test_quiet_says_nothing(command):
    outcome = command("render", CORNELL, "-o", "out.exr", "--guide", "none", *TINY, "-q", "--json")
    assert outcome.err == ""


def test_compare_writes_everything(command):
    outcome = command(
        "compare", CORNELL, "--guides", "none,realnvp", "--spp", 8, *TINY, "--set", "realnvp.epochs=1",
        "--reference-time", 1, "-o", "new/results", "--json",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    record = json.loads(outcome.out)
    assert [run["guide"] for run in record["runs"]] == ["none", "realnvp"]
    # No sign is asserted: against a truth of one second, an error may drown in the truth's own noise.
    assert all(run["relmse"] > run["relmse_trimmed"] for run in record["runs"])
    assert record["reference"]["standard_error"] > 0
    names = {
        "none.exr",
        "none.json",
        "realnvp.exr",
        "realnvp.json",
        "reference.exr",
        "comparison.png",
        "results.json",
    }
    assert {path.name for path in Path("new/results").iterdir()} == names
    assert json.loads(Path("new/results/results.json").read_text()) == record
    assert Path("new/results/comparison.png").read_bytes().startswith(b"\x89PNG")

    # The same again: a given reference is taken as it is, and nothing is rendered by Mitsuba.
    again = command(
        "compare", CORNELL, "--guides", "none", "--spp", 8, *TINY, "--reference", "new/results/reference.exr",
        "--thesis", "san-miguel",
    )  # fmt: skip
    assert again.code == 0, again.err
    # The thesis' share of random numbers stands beside ours, and why the levels differ.
    assert "2.30 %" in again.out
    assert "the one that tests use is reduced" in again.out
    assert "read from new/results/reference.exr" in again.out
    written = json.loads(Path("out/compare/results.json").read_text())
    assert written["runs"][0]["relmse"] == pytest.approx(record["runs"][0]["relmse"], rel=1e-3)

    other = command(
        "compare", CORNELL, "--guides", "none", "--size", "8x8", *TINY, "--reference", "new/results/reference.exr",
        "-o", "other",
    )  # fmt: skip
    assert other.code == 2
    assert "has 16×16 pixels, the scene's crop 8×8" in other.err
    assert not Path("other").exists()


def test_info_says_what_was_understood(command):
    outcome = command("info", CORNELL, *TINY)
    assert outcome.code == 0, outcome.err
    for word in ("rectangle", "diffuse", "area", "36", "realnvp", "Everything in it is supported"):
        assert word in outcome.out
    record = json.loads(command("info", CORNELL, *TINY, "--json").out)
    assert record["supported"]
    assert record["triangles"] == 36
    assert record["auto"]["emitter_strategy"] in outcome.out
    assert record["auto"]["why"]
    assert {bsdf["id"] for bsdf in record["bsdfs"]} == {"white", "black", "red", "green"}
    assert record["bsdfs"][0]["what"].startswith("twosided(diffuse(reflectance=(")
    assert record["memory"]["bvh"] > 0
    assert [row["k"] for row in record["probe"]] == [1, 2, 3]
    assert sum(row["share"] for row in record["probe"]) == pytest.approx(1)
    assert record["probe"][0]["mean"] > 10 * record["probe"][0]["standard_error"]


def test_info_lists_what_is_not_supported(command, files):
    record = json.loads(command("info", "hair.xml", "--variant", "scalar_rgb", "--json").out)
    assert not record["supported"]
    assert "hair" in record["unsupported"][0]
    assert record["probe"] is None
    outcome = command("info", "hair.xml", "--variant", "scalar_rgb")
    assert outcome.code == 0
    assert "with --approximate: " in outcome.out
    assert "replaced by a diffuse one" in outcome.out.replace("\n", " ")
    record = json.loads(
        command("info", "hair.xml", "--variant", "scalar_rgb", "--approximate", "--json").out
    )
    assert record["supported"]
    assert record["probe"]
    assert "hair" in record["notes"][0]


def test_what_is_not_supported_is_rendered_approximately(command, files):
    arguments = ("render", "hair.xml", "-o", "a.exr", "--guide", "none", "--spp", 1, "--k", 1)
    outcome = command(*arguments, "--variant", "scalar_rgb")
    assert outcome.code != 0
    assert "--approximate" in outcome.err
    assert not Path("a.exr").exists()
    outcome = command(*arguments, "--variant", "scalar_rgb", "--approximate")
    assert outcome.code == 0, outcome.err
    assert "approximated" in outcome.err
    assert Path("a.exr").exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [(("--version",), "pssflow 0."), (("--help",), "compare"), (("render", "--help"), "--replay")],
)
def test_help_and_version(arguments, word, command):
    outcome = command(*arguments)
    assert outcome.code == 0
    assert word in outcome.out
    assert outcome.err == ""


def test_the_module_is_the_command(files):
    arguments = ["render", "good.xml", "-o", "out.exr", "--guide", "none", "--json", "-q"]
    outcome = process(*arguments, folder=files)
    assert outcome.code == 0, outcome.err
    assert json.loads(outcome.out).keys() >= RUN_KEYS
    assert outcome.err == ""


def test_mistakes_of_our_own_show_no_traceback_either(command, monkeypatch):
    def broken(*_args: object, **_options: object) -> None:
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr("pssflow.scene.Scene.render", broken)
    outcome = command("render", CORNELL, "-o", "out.exr", *TINY)
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert "ZeroDivisionError: of all things (this is a mistake in pssflow" in outcome.err


def test_json_has_no_nan():
    values = {"a": float("nan"), "b": [np.float32(np.inf), np.int64(3)], "c": np.ones(2), "d": None}
    assert json.loads(dump_json(values)) == {"a": None, "b": [None, 3], "c": [1, 1], "d": None}
