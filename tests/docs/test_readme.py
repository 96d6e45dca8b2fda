"""The documents tell the truth: the README's commands and snippets run as they stand, links and paths exist."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import pssflow

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCUMENTS = [
    *("README.md", "ARCHITECTURE.md", "CHANGELOG.md", "rust/embree4/README.md"),
    *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("scenes/*/README.md")),
]


def blocks(language: str) -> list[str]:
    """The README's fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.M | re.S)


COMMANDS = [
    line
    for block in blocks("sh")
    for line in block.replace("\\\n", " ").splitlines()
    if line.startswith(".venv/bin/pssflow ")
]


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that looks like the repository's root after `make demo`, but whose `out` is the test's own.

    Its `.venv` is the environment of this interpreter, and references are cached in it, not in the user's home.
    """
    folder = tmp_path / "clone"
    (folder / "out").mkdir(parents=True)
    (folder / ".venv").symlink_to(sys.prefix, target_is_directory=True)
    (folder / "scenes").symlink_to(ROOT / "scenes", target_is_directory=True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return folder


def run(command: list[str], folder: Path) -> str:
    """Standard output of a command that succeeds in `folder`."""
    result = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=100, check=False
    )
    assert result.returncode == 0, f"{shlex.join(command)}\n{result.stderr}"
    return result.stdout


def test_a_command_of_each_kind_is_shown() -> None:
    assert {shlex.split(command)[1] for command in COMMANDS} == {
        "info",
        "render",
        "compare",
        "inspect",
    }


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: shlex.split(command)[1])
def test_a_command_works_as_it_stands(command: str, clone: Path) -> None:
    words = shlex.split(command, comments=True)
    run(words, clone)
    if "-o" in words:
        output = clone / words[words.index("-o") + 1]
        written = [output] if output.suffix else [output / "comparison.png", output / "none.exr"]
        assert all(path.stat().st_size > 1000 for path in written)


def test_options_in_the_text_exist() -> None:
    helps = "".join(
        run([sys.executable, "-m", "pssflow", *name.split(), "--help"], ROOT)
        for name in ("info", "render", "compare", "inspect", "study guides")
    )
    named = set(re.findall(r"`(--[a-z-]+)", README))
    assert named
    assert not {option for option in named if f"{option} " not in helps}


def test_targets_of_make_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", makefile, flags=re.M))
    named = set(re.findall(r"\bmake ([a-z-]+)\b", "".join(blocks("sh")))) | set(
        re.findall(r"`make ([a-z-]+)`", README)
    )
    assert "demo" in named
    assert named <= targets


def test_the_python_block_runs(clone: Path) -> None:
    """As it stands, and its promise that the pilot's f comes again is kept."""
    (block,) = blocks("python")
    check = "\nimport numpy\nnumpy.testing.assert_array_equal(f, pilot.f)\n"
    printed = run([f"{sys.prefix}/bin/python", "-W", "error", "-c", block + check], clone)
    shape, _, share = printed.partition(") ")
    assert shape == "(256, 256, 3"
    assert 0.0 < float(share) < 1.0


def test_the_xml_snippet_renders(variant: str, tmp_path: Path) -> None:
    (snippet,) = blocks("xml")
    scene = (ROOT / "scenes" / "cornell-box" / "scene.xml").read_text(encoding="utf-8")
    edited, replaced = re.subn(r"<integrator .*?</integrator>", snippet, scene, flags=re.S)
    assert replaced == 1
    (tmp_path / "scene.xml").write_text(edited, encoding="utf-8")
    loaded = mi.load_file(str(tmp_path / "scene.xml"), resolution=16, spp=4)
    image = np.array(mi.render(loaded))
    assert image.shape == (16, 16, 3)
    assert image.mean() > 0
    result = loaded.integrator().result
    assert isinstance(result, pssflow.Result)
    assert (result.stats["guide"], result.stats["k"]) == ("auto", 2)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_relative_links_lead_somewhere(document: str) -> None:
    path = ROOT / document
    links = re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8"))
    relative = [link.partition("#")[0] for link in links if not re.match(r"[a-z]+:|#", link)]
    assert not [link for link in relative if not (path.parent / link).exists()]


def test_paths_in_the_text_exist() -> None:
    """Every path in backquotes or in a diagram of README and ARCHITECTURE.md that names a room of the repository.

    In a row of the table of rooms, a path counts from the root or from the row's room.
    """
    text = README + (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    named = {("", n) for n in re.findall(r"\b(?:rust|python|scenes|tests)/[\w./-]*\w", text)}
    for room, rest in re.findall(r"^\| `([\w/-]+?)/?` \|(.*)$", text, flags=re.M):
        words = " ".join(re.findall(r"`([^`]+)`", rest)).replace(",", " ").split()
        named |= {(room, word) for word in words if re.fullmatch(r"[\w/]+(\.(rs|py)|/)", word)}
    assert len(named) > 20
    # A folder of kinds (`bsdf/`) may stand without the `src/` before it.
    missing = {
        (room, name)
        for room, name in named
        if not any((ROOT / part / name).exists() for part in ("", room, f"{room}/src"))
    }
    assert not missing
