"""Exported textures are worth what Mitsuba's are, at any place: the modes that Mitsuba does not tell are found."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from pssflow.export import UnsupportedError
from pssflow.export.textures import CURVES
from tests.exports import Description, bitmap, bsdf_of, texture, value

Rng = np.random.Generator


def reference_lookup(
    entry: Description, data: NDArray[Any], uv: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What an exported bitmap is worth at uv (n, 2): the meaning of the schema, written out."""
    to_uv = np.reshape(entry["to_uv"], (3, 3))
    height, width, _ = data.shape
    p = (uv @ to_uv[:2, :2].T + to_uv[:2, 2]) * [width, height]

    def texel(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
        def wrap(i: NDArray[Any], n: int) -> NDArray[Any]:
            if entry["wrap"] == "clamp":
                return np.clip(i, 0, n - 1)
            if entry["wrap"] == "repeat":
                return i % n
            i = i % (2 * n)
            return np.where(i < n, i, 2 * n - 1 - i)

        return data[wrap(y, height), wrap(x, width)].astype(np.float64)

    if entry["filter"] == "nearest":
        return texel(*np.floor(p).astype(int).T)
    p = p - 0.5
    x, y = np.floor(p).astype(int).T
    s, t = (p - np.floor(p)).T[..., None]
    lower = (1 - s) * texel(x, y) + s * texel(x + 1, y)
    upper = (1 - s) * texel(x, y + 1) + s * texel(x + 1, y + 1)
    return (1 - t) * lower + t * upper


def mitsuba_lookup(obj: Any, uv: NDArray[np.float64], channels: int) -> NDArray[np.float64]:
    if mi.variant() == "scalar_rgb":
        values = []
        for point in uv:
            si = mi.SurfaceInteraction3f()
            si.uv = mi.Point2f(*point)
            values.append(np.array(obj.eval(si)))
        return np.array(values, np.float64)[:, :channels]
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = mi.Point2f(uv.T.astype(np.float32))
    return np.array(obj.eval(si), np.float64).T[:, :channels]


def check_bitmap(description: Description, rng: Rng) -> Description:
    """Exports a bitmap, and compares it with Mitsuba's at random places in and around it; the entry."""
    exported, bsdf = bsdf_of({"type": "diffuse", "reflectance": description})
    entry = texture(exported, bsdf["reflectance"])
    data = exported.arrays[entry["data"]]
    assert data.dtype in (np.float32, np.uint8)
    assert data.ndim == 3
    if data.dtype == np.uint8:
        data = CURVES[entry["encoding"]][data].astype(np.float32)
    obj = mi.load_dict(description)
    assert entry["mean"] == pytest.approx(float(np.array(obj.mean()).item()), rel=1e-6)

    # Nearest look-ups jump between texels: stay a little away from their borders, where rounding decides.
    height, width, channels = data.shape
    p = rng.integers(-2 * width, 3 * width, (64, 2)) + rng.uniform(0.05, 0.95, (64, 2))
    inverse = np.linalg.inv(np.reshape(entry["to_uv"], (3, 3)))
    uv = (p / [width, height]) @ inverse[:2, :2].T + inverse[:2, 2]
    ours, theirs = reference_lookup(entry, data, uv), mitsuba_lookup(obj, uv, channels)
    np.testing.assert_allclose(ours, theirs, atol=2e-5 * np.abs(data).max(), rtol=0)
    return entry


@pytest.mark.parametrize("filter_type", ["nearest", "bilinear"])
@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("shape", [(5, 7, 3), (2, 3, 1)])
def test_bitmap_modes_are_found(
    variant: str, filter_type: str, wrap_mode: str, shape: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(1)
    entry = check_bitmap(
        bitmap(
            rng.random(shape, dtype=np.float32),
            filter_type=filter_type,
            wrap_mode=wrap_mode,
            to_uv=mi.ScalarTransform3f().translate([0.3, -0.2]).rotate(35).scale([2, 3]),
        ),
        rng,
    )
    assert (entry["filter"], entry["wrap"]) == (filter_type, wrap_mode)


@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("filter_type", ["nearest", "bilinear"])
def test_bitmap_modes_are_found_where_they_show_little(
    variant: str, wrap_mode: str, filter_type: str
) -> None:
    """Variation along one axis only, in one far block of rows, or symmetric: what looks alike must look alike."""
    rng = np.random.default_rng(2)
    options = {"wrap_mode": wrap_mode, "filter_type": filter_type}
    rows = np.zeros((300, 4, 1), np.float32) + 0.5
    rows[290] = 0.9
    columns = np.zeros((3, 300, 3), np.float32)
    columns[:, 280, 1] = 1.0
    symmetric = np.ones((4, 4, 3), np.float32)
    symmetric[1:3, 1:3] = 0.2
    for pixels in (rows, columns, symmetric, np.full((4, 4, 3), 0.7, np.float32)):
        check_bitmap(bitmap(pixels, **options), rng)


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("encoded", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_bytes_are_decoded_as_mitsuba_decodes_them(
    variant: str, raw: bool, encoded: bool, channels: int
) -> None:
    rng = np.random.default_rng(3)
    pixels = mi.Bitmap(rng.integers(0, 256, (6, 5, channels), dtype=np.uint8))
    pixels.set_srgb_gamma(encoded)
    check_bitmap({"type": "bitmap", "bitmap": pixels, "raw": raw}, rng)


def test_half_precision_becomes_float32(variant: str) -> None:
    rng = np.random.default_rng(4)
    check_bitmap(bitmap(rng.random((4, 4, 3), dtype=np.float32), format="float16"), rng)


def test_high_dynamic_range_bitmap(variant: str) -> None:
    rng = np.random.default_rng(5)
    pixels = rng.random((16, 32, 3), dtype=np.float32)
    pixels[3, 7] = 1e5
    entry = check_bitmap(bitmap(pixels, wrap_mode="mirror"), rng)
    assert entry["wrap"] == "mirror"


def test_texture_transform_that_is_singular_is_refused(variant: str) -> None:
    pixels = np.random.default_rng(6).random((4, 4, 3), dtype=np.float32)
    description = bitmap(pixels, to_uv=mi.ScalarTransform3f().scale([1, 0]))
    with pytest.raises(UnsupportedError, match=r"texture \"bitmap\" .*`to_uv` that is singular"):
        bsdf_of({"type": "diffuse", "reflectance": description})


def test_rawconstant(variant: str) -> None:
    raw = {"type": "rawconstant", "value": mi.ScalarVector3f(0.1, 0.2, 0.3)}
    exported, bsdf = bsdf_of({"type": "diffuse", "reflectance": raw})
    assert value(exported, bsdf["reflectance"]) == pytest.approx([0.1, 0.2, 0.3])
