//! Light from an image of the sky, in latitude and longitude.

use std::f32::consts::{FRAC_1_PI, FRAC_PI_2, PI, TAU};

use serde::Deserialize;

use super::{Builder, EmitterModel, EmitterSample, one};
use crate::arrays::{ArrayRef, check, check_finite};
use crate::error::SceneError;
use crate::hierarchical::Hierarchical;
use crate::interaction::Interaction;
use crate::math::{Rgb, Vec3, luminance};
use crate::scene::Scene;
use crate::shape::affine::Affine;

/// Mitsuba's smallest sin θ in the map's Jacobian.
const SMALLEST_SINE: f32 = 0.5 * f32::EPSILON;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    /// (height, width, 3), the zenith's row first, without columns that repeat.
    data: ArrayRef,
    scale: f32,
    to_world: [f32; 16],
    /// Draws from what exceeds the mean alone (Karlík et al. 2019).
    #[serde(default)]
    mis_compensation: bool,
    /// The rows cover the upper half alone, see `Rows::UpperHalf`.
    #[serde(default)]
    upper_half: bool,
    #[serde(default = "one")]
    pub(super) sampling_weight: f32,
}

/// `envmap`: columns go round the local y axis from −z over +x, rows from +y down. Texels lie at the
/// columns' centres, and at the rows' ends: the first row is the pole. Also what a `sunsky` becomes.
#[derive(Debug)]
pub struct Envmap {
    data: Vec<f32>,
    width: usize,
    height: usize,
    scale: f32,
    rows: Rows,
    map: Affine,
    mis_compensation: bool,
    /// On a grid whose last column is the first again; `None`: black.
    warp: Option<Hierarchical>,
}

impl Envmap {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        let owner = format!("emitter {:?}", d.id);
        let (shape, data) = b.arrays.take_any_f32(d.data, &owner, "data")?;
        let (height, width) = match shape[..] {
            [h, w, 3] if h >= 2 && w >= 2 && h * w * 3 == data.len() => (h, w),
            _ => {
                return Err(SceneError::Array {
                    owner,
                    name: "data",
                    found: format!("shape {shape:?}"),
                    expected: "(height ≥ 2, width ≥ 2, 3)".to_owned(),
                });
            }
        };
        check_finite(&data, 3, &owner, "data")?;
        check(d.scale.is_finite(), &owner, "scale", d.scale, "finite")?;
        let rows = if d.upper_half {
            Rows::UpperHalf
        } else {
            Rows::Sphere
        };
        Ok(Self {
            warp: warp(&data, width, height, rows, d.mis_compensation),
            rows,
            mis_compensation: d.mis_compensation,
            map: Affine::new(&d.to_world, &owner)?,
            data,
            width,
            height,
            scale: d.scale,
        })
    }

    fn texel(&self, x: usize, y: usize) -> Rgb {
        Rgb::from_slice(&self.data[3 * (y * self.width + x)..][..3])
    }

    /// Radiance at `uv`, bilinear: periodic in u, clamped in v.
    fn radiance(&self, uv: [f32; 2]) -> Rgb {
        let x = (uv[0] - uv[0].floor()) * self.width as f32 - 0.5;
        let y = uv[1].clamp(0.0, 1.0) * (self.height - 1) as f32;
        let (fx, fy) = (x - x.floor(), y - y.floor());
        let column = |i: i32| i.rem_euclid(self.width as i32) as usize;
        let (x0, x1) = (column(x.floor() as i32), column(x.floor() as i32 + 1));
        let y0 = y as usize;
        let y1 = (y0 + 1).min(self.height - 1);
        let top = self.texel(x0, y0).lerp(self.texel(x1, y0), fx);
        let bottom = self.texel(x0, y1).lerp(self.texel(x1, y1), fx);
        top.lerp(bottom, fy) * self.scale
    }

    fn local(&self, d: Vec3) -> Vec3 {
        self.map.to_object.transform_vector3a(d)
    }

    fn half_texel(&self) -> f32 {
        0.5 / self.width as f32
    }
}

/// The density's grid: luminance × sin θ at the texels.
fn warp(
    data: &[f32],
    width: usize,
    height: usize,
    rows: Rows,
    mis_compensation: bool,
) -> Option<Hierarchical> {
    let luminances: Vec<f32> = data
        .chunks_exact(3)
        .map(|c| luminance(Rgb::from_slice(c)))
        .collect();
    let mut offset = 0.0;
    if mis_compensation {
        let sum: f64 = luminances.iter().map(|&l| f64::from(l)).sum();
        let mean = (sum / luminances.len() as f64) as f32;
        let least = luminances.iter().copied().fold(f32::INFINITY, f32::min);
        // All but constant: nothing would be left to draw.
        if mean - least > 0.01 * mean {
            offset = mean;
        }
    }
    let step = 1.0 / (height - 1) as f32;
    let mut grid = Vec::with_capacity((width + 1) * height);
    for (y, row) in luminances.chunks_exact(width).enumerate() {
        let [sine, _, slope] = rows.angles(y as f32 * step);
        let share = sine * slope / PI;
        grid.extend(
            row.iter()
                .chain(&row[..1])
                .map(|l| (l - offset).max(0.0) * share),
        );
    }
    // sin π is not zero in single precision, and may be negative.
    grid.iter_mut().for_each(|v| *v = v.max(0.0));
    Hierarchical::new(grid, width + 1, height)
}

/// How v runs over the angle from the zenith.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Rows {
    /// Evenly, from the zenith to the nadir.
    Sphere,
    /// From the zenith to the horizon, below which all is black. The elevation is π/2 · (1 − v)²: a sky
    /// model changes with the root of its sine there.
    UpperHalf,
}

impl Rows {
    /// Sine and cosine of the angle from the zenith, and its change with v.
    fn angles(self, v: f32) -> [f32; 3] {
        match self {
            Self::Sphere => {
                let (sine, cosine) = (v * PI).sin_cos();
                [sine, cosine, PI]
            }
            Self::UpperHalf => {
                let s = 1.0 - v;
                let (cosine, sine) = (FRAC_PI_2 * s * s).sin_cos();
                [sine, cosine, PI * s]
            }
        }
    }

    /// v of a unit direction; `None` where it is black.
    fn v(self, d: Vec3) -> Option<f32> {
        let y = d.y.clamp(-1.0, 1.0);
        match self {
            Self::Sphere => Some(y.acos() * FRAC_1_PI),
            Self::UpperHalf => (y >= 0.0).then(|| 1.0 - (y.asin() / FRAC_PI_2).sqrt()),
        }
    }
}

fn u_of(d: Vec3) -> f32 {
    d.x.atan2(-d.z) / TAU
}

impl EmitterModel for Envmap {
    fn sample_direction(
        &self,
        _scene: &Scene,
        _reference: Vec3,
        u: [f32; 2],
    ) -> Option<EmitterSample> {
        let (point, pdf) = self.warp.as_ref()?.sample(u);
        let uv = [point[0] + self.half_texel(), point[1]];
        let [sine, cosine, slope] = self.rows.angles(uv[1]);
        let (sin_phi, cos_phi) = (uv[0] * TAU).sin_cos();
        let d = Vec3::new(sin_phi * sine, cosine, -cos_phi * sine);
        let pdf = pdf / (sine.max(SMALLEST_SINE) * TAU * slope);
        (pdf > 0.0 && pdf.is_finite()).then(|| EmitterSample {
            d: self.map.vector(d),
            target: None,
            radiance: self.radiance(uv),
            pdf,
            delta: false,
        })
    }

    fn pdf_direction(
        &self,
        _scene: &Scene,
        _reference: Vec3,
        d: Vec3,
        _surface: Option<&Interaction>,
    ) -> f32 {
        let Some(warp) = &self.warp else { return 0.0 };
        let d = self.local(d);
        let Some(v) = self.rows.v(d) else { return 0.0 };
        let u = u_of(d) - self.half_texel();
        let sine = (d.x * d.x + d.z * d.z).sqrt().max(SMALLEST_SINE);
        let [_, _, slope] = self.rows.angles(v);
        let pdf = warp.pdf([u - u.floor(), v]) / (sine * TAU * slope);
        if pdf.is_finite() { pdf } else { 0.0 }
    }

    fn eval(&self, _scene: &Scene, d: Vec3, _surface: Option<&Interaction>) -> Rgb {
        let d = self.local(d);
        match self.rows.v(d) {
            Some(v) => self.radiance([u_of(d), v]),
            None => Rgb::ZERO,
        }
    }

    fn drawn_everywhere(&self) -> bool {
        !self.mis_compensation
    }

    fn is_environment(&self) -> bool {
        true
    }
}
