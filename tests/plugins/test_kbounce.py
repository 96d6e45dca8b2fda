"""`<integrator type="pssflow_kbounce">`: what it refuses, and that it renders in both variants."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow.files import first_line
from tests import scenes


def test_it_renders_k_bounces_only(variant):
    """In `quad` light is reflected once: all of it is there at k = 1, none at k = 2."""
    scene = mi.load_dict(scenes.quad())
    integrators: list[Any] = [mi.load_dict({"type": "pssflow_kbounce", "k": k}) for k in (1, 2)]
    direct, two = (np.array(mi.render(scene, integrator=i, spp=1)) for i in integrators)
    assert direct.max() > 0
    assert not two.any()
    assert np.isfinite(direct).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [({"k": 0}, "`k` = 0"), ({"hide_emitters": True}, "`hide_emitters` is not supported")],
)
def test_bad_parameters(scalar_variant, options, message):
    with pytest.raises(Exception, match=message) as caught:
        mi.load_dict({"type": "pssflow_kbounce"} | options)
    assert "\n" not in first_line(caught.value)


def test_it_prints_itself(scalar_variant):
    assert "k = 3" in str(mi.load_dict({"type": "pssflow_kbounce", "k": 3}))
