"""What crosses the border between Mitsuba and the core, whole and damaged: the cases that forked workers run."""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

import pssflow
from pssflow import _core
from pssflow.export import export
from pssflow.scene import embree_dirs, load_scene
from tests.support.meshes import write_octahedron
from tests.support.mutations import mutate_export, mutate_xml

SCENE = """<scene version="3.0.0">
  <default name="side" value="16"/>
  <integrator type="path"><integer name="max_depth" value="3"/></integrator>
  <sensor type="thinlens" id="camera">
    <float name="fov" value="45"/><float name="aperture_radius" value="0.05"/>
    <float name="focus_distance" value="4"/>
    <transform name="to_world"><lookat origin="3, -4, 2.5" target="0, 0, 0.4" up="0, 0, 1"/></transform>
    <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="$side"/><integer name="height" value="12"/>
      <integer name="crop_offset_x" value="2"/><integer name="crop_width" value="12"/>
      <rfilter type="gaussian"/>
    </film>
  </sensor>
  <emitter type="envmap">
    <string name="filename" value="sky.exr"/><float name="scale" value="1.5"/>
    <transform name="to_world"><rotate x="1" angle="90"/></transform>
  </emitter>
  <emitter type="directional">
    <vector name="direction" x="0.3" y="0.2" z="-1"/><rgb name="irradiance" value="2, 1.8, 1.5"/>
  </emitter>
  <emitter type="spot">
    <transform name="to_world"><lookat origin="-2, -2, 3" target="0, 0, 0" up="0, 0, 1"/></transform>
    <rgb name="intensity" value="5, 6, 7"/><float name="cutoff_angle" value="30"/>
  </emitter>
  <emitter type="point"><point name="position" x="1" y="-1" z="2"/><rgb name="intensity" value="3"/></emitter>
  <bsdf type="twosided" id="floor">
    <bsdf type="diffuse">
      <texture type="bitmap" name="reflectance">
        <string name="filename" value="checks.png"/><string name="wrap_mode" value="mirror"/>
        <transform name="to_uv"><scale x="2" y="3"/></transform>
      </texture>
    </bsdf>
  </bsdf>
  <bsdf type="blendbsdf" id="mixed">
    <float name="weight" value="0.3"/>
    <bsdf type="roughconductor">
      <string name="material" value="Cu"/><string name="distribution" value="ggx"/>
      <float name="alpha_u" value="0.2"/><float name="alpha_v" value="0.4"/>
    </bsdf>
    <bsdf type="roughplastic"><float name="alpha" value="0.2"/><boolean name="nonlinear" value="true"/></bsdf>
  </bsdf>
  <bsdf type="bumpmap" id="bumpy">
    <texture type="bitmap" name="heights">
      <string name="filename" value="checks.png"/><boolean name="raw" value="true"/>
    </texture>
    <float name="scale" value="0.1"/>
    <bsdf type="principled"><float name="roughness" value="0.4"/><float name="metallic" value="0.5"/></bsdf>
  </bsdf>
  <shape type="rectangle">
    <transform name="to_world"><scale value="3"/></transform><ref id="floor"/>
  </shape>
  <shape type="ply" id="ball">
    <string name="filename" value="ball.ply"/>
    <transform name="to_world"><scale value="0.5"/><translate x="-0.7" z="0.5"/></transform><ref id="mixed"/>
  </shape>
  <shape type="sphere">
    <point name="center" x="0.7" y="0.2" z="0.5"/><float name="radius" value="0.5"/>
    <bsdf type="dielectric"><float name="int_ior" value="1.5"/></bsdf>
  </shape>
  <shape type="cylinder">
    <point name="p0" x="0" y="1" z="0"/><point name="p1" x="0.2" y="1" z="1.5"/><float name="radius" value="0.2"/>
    <ref id="bumpy"/>
  </shape>
  <shape type="disk">
    <transform name="to_world"><rotate y="1" angle="160"/><translate x="0.5" z="2.5"/></transform>
    <bsdf type="mask"><float name="opacity" value="0.5"/><bsdf type="diffuse"/></bsdf>
    <emitter type="area"><rgb name="radiance" value="4, 3, 2"/></emitter>
  </shape>
  <shape type="shapegroup" id="group">
    <shape type="cube"><transform name="to_world"><scale value="0.2"/></transform><ref id="floor"/></shape>
  </shape>
  <shape type="instance">
    <ref id="group"/><transform name="to_world"><translate x="-1" y="-1" z="0.3"/></transform>
  </shape>
</scene>
"""
"""One of nearly everything that is understood."""


def write_assets(folder: Path) -> None:
    """The files that `SCENE` names; a variant must be set."""
    rng = np.random.default_rng(71)
    checks = mi.Bitmap((rng.random((6, 8, 3)) * 255).astype(np.uint8))
    checks.write(str(folder / "checks.png"))
    sky = rng.random((8, 16, 3)).astype(np.float32)
    mi.Bitmap(sky).write(str(folder / "sky.exr"))
    write_octahedron(folder / "ball.ply")


class Case(NamedTuple):
    """One damaged input: where its files lie and which damage."""

    folder: str
    seed: int


class Answer(NamedTuple):
    """How the border answered."""

    kind: str
    """`rendered`, `refused` (a clear error), or `bad`."""
    text: str
    """The error's line, or what was bad about it."""


Report = Callable[[str], None]


def scene_file(case: Case, report: Report) -> Answer:
    """Loads and renders a mutated `SCENE`. Stages: `mitsuba` while the file is loaded, then `pssflow`."""
    text = SCENE if case.seed < 0 else mutate_xml(SCENE, case.seed)
    path = Path(case.folder) / f"case-{case.seed}.xml"
    path.write_text(text, encoding="utf-8")

    def render() -> None:
        report("mitsuba")
        loaded, _ = load_scene(path, [])
        report("pssflow")
        result = pssflow.Scene(loaded).render("none", 1, seed=1, threads=1, progress=False)
        if not np.isfinite(result.image).all():
            raise AssertionError("the image holds values that are not finite")

    return judge(render)


def exported(case: Case, report: Report) -> Answer:
    """Gives the core a mutated export of `SCENE`, and renders it if it is taken."""
    path = Path(case.folder) / "whole.xml"
    report("mitsuba")
    description, arrays = _whole(path)
    if case.seed >= 0:
        description, arrays = mutate_export(description, arrays, case.seed)

    def render() -> None:
        report("pssflow")
        core = _core.Scene(json.dumps(description), arrays, embree_dirs())
        options = {"guide": "none", "k": 2, "parametrisation": "bsdf", "emitter_strategy": "mis"}
        options |= {"keep_pilot": True, "seed": 0, "threads": 1, "spp": 1}
        image = core.render(json.dumps(options))["image"]
        if not np.isfinite(image).all():
            raise AssertionError("the image holds values that are not finite")

    return judge(render)


_WHOLE: dict[Path, tuple[dict[str, Any], list[NDArray[Any]]]] = {}
"""Exports by file: loading takes longer than damaging."""


def _whole(path: Path) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    if path not in _WHOLE:
        path.write_text(SCENE, encoding="utf-8")
        # Not a `Scene`'s export: the core has taken over its arrays.
        whole = export(mi.load_file(str(path)), 0)
        _WHOLE[path] = json.loads(whole.json()), whole.arrays
    return _WHOLE[path]


def judge(render: Callable[[], None]) -> Answer:
    """A `ValueError` (an `OSError` for a missing file) of one line is right; anything else is not."""
    try:
        render()
    except (ValueError, FileNotFoundError) as error:
        text = str(error)
        if not text or "\n" in text or len(text) > 2000:
            return Answer("bad", f"{type(error).__name__} is not one line: {text!r}")
        return Answer("refused", text)
    except BaseException as error:  # a panic of the core is no Exception
        where = "".join(traceback.format_exception(error)[-3:])
        return Answer("bad", f"{type(error).__name__}: {where}")
    return Answer("rendered", "")
