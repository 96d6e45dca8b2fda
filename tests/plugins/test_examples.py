"""The example scripts, small: that they run, and that they find what they look for."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
from click.testing import CliRunner

import pssflow
from pssflow.examples import guide_any_integrator, path_lengths, recover_colour
from tests import scenes

XML = Path(__file__).parents[2] / "scenes" / "cornell-box" / "scene.xml"


def test_any_integrator_is_guided(llvm_variant):
    scene = mi.load_dict(scenes.furnace_sphere())
    records = guide_any_integrator.compare(scene, spp=16, dimensions=6)
    assert [record["integrator"] for record in records] == [
        "path",
        "direct",
        "prb_basic",
        "ambient",
    ]
    for record in records:
        plain, guided = record["mean"]
        assert abs(plain - guided) < 0.3 * plain
        assert record["chosen"] in ("vegas", "none")


def test_gains_are_printed(llvm_variant):
    arguments = [str(XML), "--spp", "8", "--size", "16", "16", "--dimensions", "6"]
    done = CliRunner().invoke(guide_any_integrator.main, arguments, catch_exceptions=False)
    assert done.exit_code == 0
    for name in guide_any_integrator.INTEGRATORS:
        assert f" {name} " in done.output


def test_a_strip_of_path_lengths(llvm_variant, tmp_path):
    target = tmp_path / "strip.png"
    arguments = [
        str(XML),
        "--spp",
        "2",
        "--size",
        "16",
        "16",
        "--max-depth",
        "3",
        "-o",
        str(target),
    ]
    outcome = CliRunner().invoke(path_lengths.main, arguments)
    assert outcome.exit_code == 0, outcome.output
    assert target.read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["strip.png"]


def test_a_colour_is_recovered(llvm_variant, tmp_path):
    """From grey, in 40 small steps, to within .1 of each component; and the chart is drawn."""
    scene = recover_colour.room(12)
    target = recover_colour.target_image(scene, 256)
    run = recover_colour.recover(scene, target, "none", seconds=1e9, steps=40, spp=8)
    assert len(run.loss) == 40
    assert run.error[0] > 0.35
    assert run.error[-1] < 0.1, run.colour
    own = np.array(mi.traverse(scene)[recover_colour.PARAMETER]).ravel()
    np.testing.assert_allclose(own, recover_colour.COLOUR, atol=1e-6)
    recover_colour.chart({"none": run}, tmp_path / "colour.png", 1.0)
    assert (tmp_path / "colour.png").exists()


def test_the_hidden_wall_is_seen_by_two_bounces_alone(llvm_variant):
    """Its colour is in the light of k = 2, and not in that of k = 1."""
    scene = recover_colour.room(12)
    one, two = (
        pssflow.render(scene, "none", 64, k=k, progress=False).image.mean(axis=(0, 1))
        for k in (1, 2)
    )
    np.testing.assert_allclose(one, one[0], rtol=1e-5)
    assert two[0] > 2 * two[2] > 0
