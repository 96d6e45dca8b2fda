"""`<integrator type="pss_guided">`: what it takes, refuses and reports. Its mean is tested in `tests/statistical`."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow.files import first_line
from pssflow.plugins import guided
from tests import scenes

XML = """<scene version="3.0.0"><integrator type="pss_guided">
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <integer name="dimensions" value="6"/>
</integrator></scene>"""


def _guided(**options: Any) -> Any:
    nested = {"type": "path", "max_depth": 3}
    return mi.load_dict({"type": "pss_guided", "nested": nested} | options)


def _image(integrator: Any, **options: Any) -> Any:
    scene = mi.load_dict(scenes.furnace_sphere())
    return np.array(mi.render(scene, integrator=integrator, **options), np.float32)


def test_it_says_what_it_did(llvm_variant):
    integrator = _guided(guide="vegas", dimensions=5, uniform_fraction=0.5)
    assert "nested = " in str(integrator)
    image = _image(integrator, spp=16, seed=1)
    assert image.shape == (32, 32, 3)
    stats = integrator.stats
    assert (stats["chosen"], stats["a"], stats["dimensions"]) == ("vegas", 0.5, 5)
    assert (stats["spp"], stats["pilot_spp"]) == (16, 2)
    assert stats["columns"][0] == "x1.emitter.0"
    assert len(stats["columns"]) == 5
    assert stats["gain"] > 0
    assert stats["predicted_gain"] > 0


def test_passes_are_summed(llvm_variant, monkeypatch):
    """What is kept to learn from is bounded, and the gain is that of all samples, however they are cut in passes."""
    monkeypatch.setattr(guided, "MOST_AT_ONCE", 32 * 32)
    monkeypatch.setattr(guided, "MOST_LEARNED", 3 * 32 * 32)
    learned: list[int] = []
    fit = guided._Candidate.fit

    def listening(self: Any, u: Any, *others: Any) -> Any:
        learned.append(len(u))
        return fit(self, u, *others)

    monkeypatch.setattr(guided._Candidate, "fit", listening)
    integrator = _guided(guide="vegas", dimensions=5, pilot_spp=6)
    image = _image(integrator, spp=16)
    assert max(learned) == 3 * 32 * 32
    assert 0.2 < integrator.stats["gain"] < 20
    plain = _image(_guided(guide="none"), spp=64)
    assert abs(image.mean() / plain.mean() - 1) < 0.1


def test_sums_are_those_of_numpy():
    """Of samples in two passes: the variance in each tile, over its squared mean and a little of the image's."""
    rng = np.random.default_rng(0)
    f, m = rng.random(4000, np.float32), rng.uniform(0.5, 2.0, 4000).astype(np.float32)
    pixel = rng.random((4000, 2), np.float32)
    sums = guided._Sums()
    for part in (slice(0, 1500), slice(1500, None)):
        sums.add(guided._Samples(np.empty((0, 0), np.float32), pixel[part], f[part], m[part]))
    e, tile = f.astype(np.float64) / m, guided._tiles(pixel)
    expected = sum(
        e[tile == t].var() / (e[tile == t].mean() ** 2 + 0.01 * e.mean() ** 2) for t in range(64)
    )
    np.testing.assert_allclose(sums.mean, e.mean())
    np.testing.assert_allclose(sums.variance(sums.mean), expected)


def test_one_seed_gives_one_image(llvm_variant):
    a, b, c = (_image(_guided(guide="vegas"), spp=8, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()
    np.testing.assert_array_equal(c, _image(_guided(guide="vegas", seed=1), spp=8, seed=3))


def test_where_nothing_pays_nothing_is_guided(llvm_variant):
    """Two samples of a pilot teach `auto` nothing that pays here, and one sample leaves no pilot at all."""
    integrator = _guided()
    _image(integrator, spp=4)
    assert integrator.stats["chosen"] == "none"
    _image(integrator, spp=1)
    assert (integrator.stats["pilot_spp"], integrator.stats["a"]) == (0, 1.0)


def test_from_xml(llvm_variant):
    integrator = mi.load_string(XML).integrator()
    assert integrator.dimensions == 6
    assert integrator.nested.class_name() == "PathIntegrator"
    assert "max_depth = 3" in str(integrator.nested)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"guide": "table"}, "`guide` = 'table' does not model all numbers at once"),
        ({"dimensions": 1}, "`dimensions` = 1"),
        ({"uniform_fraction": 0.0}, "`uniform_fraction` = 0.0"),
        ({"pilot_spp": 1}, "`pilot_spp` = 1"),
        ({"nested": {"type": "ptracer"}}, "has no method `sample`"),
        ({"nested": {"type": "aov", "aovs": "d:depth"}}, "has further channels"),
        ({"nested": {"type": "moment", "inner": {"type": "path"}}}, "has further channels"),
        ({"nested": {"type": "prb_projective"}}, "draws silhouettes"),
        ({"other": {"type": "path"}}, "it holds 2 integrators"),
    ],
)
def test_what_would_be_wrong_is_refused(options, message, llvm_variant):
    with pytest.raises(Exception, match=message) as caught:
        _guided(**options)
    assert "\n" not in first_line(caught.value)


def test_scalar_variants_are_refused(scalar_variant):
    with pytest.raises(Exception, match="integrator pss_guided: in scalar_rgb"):
        _guided()


def test_it_is_not_differentiated(llvm_variant):
    integrator = _guided()
    with pytest.raises(NotImplementedError, match="it has no derivatives"):
        integrator.render_backward()
