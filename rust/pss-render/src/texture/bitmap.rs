//! An image over uv (Mitsuba's `bitmap`): linear values, bilinear or nearest, three ways to wrap.

use glam::Vec2;
use serde::Deserialize;

use super::{TextureModel, TexturePoint};
use crate::arrays::{Array, ArrayRef, Arrays, check_all_finite, check_finite};
use crate::error::SceneError;
use crate::math::{Rgb, luminance};

#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
enum Wrap {
    Repeat,
    Mirror,
    Clamp,
}

#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
enum Filter {
    Nearest,
    Bilinear,
}

#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
enum Encoding {
    #[default]
    Linear,
    Srgb,
}

impl Encoding {
    /// The value of each byte (IEC 61966-2-1).
    fn table(self) -> Box<[f32; 256]> {
        Box::new(std::array::from_fn(|byte| {
            let x = byte as f64 / 255.0;
            let linear = match self {
                Self::Linear => x,
                Self::Srgb if x <= 0.04045 => x / 12.92,
                Self::Srgb => ((x + 0.055) / 1.055).powf(2.4),
            };
            linear as f32
        }))
    }
}

/// Linear values, or bytes and what each stands for: a quarter of the memory.
#[derive(Debug)]
enum Texels {
    Floats(Vec<f32>),
    Bytes(Vec<u8>, Box<[f32; 256]>),
}

impl Texels {
    #[inline]
    fn get(&self, i: usize) -> f32 {
        match self {
            Self::Floats(v) => v[i],
            Self::Bytes(v, table) => table[usize::from(v[i])],
        }
    }

    fn len(&self) -> usize {
        match self {
            Self::Floats(v) => v.len(),
            Self::Bytes(v, _) => v.len(),
        }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    id: String,
    data: ArrayRef,
    to_uv: [f32; 9],
    wrap: Wrap,
    filter: Filter,
    /// What bytes stand for; floats are linear.
    #[serde(default)]
    encoding: Encoding,
    /// Mitsuba's mean of the texture; nothing here needs it yet.
    #[serde(default, rename = "mean")]
    _mean: f32,
}

/// Largest edge in texels; indices are `i32`.
const LARGEST: usize = 1 << 30;

/// Pixels in rows from v = 0 downwards, as Mitsuba stores them; one or three channels.
#[derive(Debug)]
pub struct Bitmap {
    data: Texels,
    width: usize,
    height: usize,
    channels: usize,
    /// First two rows of the 3×3 map uv → texture.
    to_uv: [[f32; 3]; 2],
    wrap: Wrap,
    filter: Filter,
}

impl Bitmap {
    pub(crate) fn build(d: Description, arrays: &mut Arrays) -> Result<Self, SceneError> {
        let owner = format!("texture {:?}", d.id);
        let (shape, data) = match arrays.take(d.data, &owner, "data")? {
            Array::U8 { shape, data } => (shape, Texels::Bytes(data, d.encoding.table())),
            Array::F32 { shape, data } => {
                let channels = shape.last().copied().unwrap_or(1);
                check_finite(&data, channels.max(1), &owner, "data")?;
                (shape, Texels::Floats(data))
            }
            other => return Err(other.of_another_type(&owner, "data", "float32 or uint8")),
        };
        let (height, width, channels) = match shape[..] {
            [h, w, c]
                if (1..=LARGEST).contains(&h)
                    && (1..=LARGEST).contains(&w)
                    && (c == 1 || c == 3)
                    && h.checked_mul(w).and_then(|n| n.checked_mul(c)) == Some(data.len()) =>
            {
                (h, w, c)
            }
            _ => {
                return Err(SceneError::Array {
                    owner,
                    name: "data",
                    found: format!("shape {shape:?}"),
                    expected: "(height, width, 1 or 3)".to_owned(),
                });
            }
        };
        check_all_finite(&d.to_uv, &owner, "to_uv")?;
        let m = d.to_uv;
        Ok(Self {
            data,
            width,
            height,
            channels,
            to_uv: [[m[0], m[1], m[2]], [m[3], m[4], m[5]]],
            wrap: d.wrap,
            filter: d.filter,
        })
    }

    fn wrap(&self, i: i32, n: usize) -> usize {
        let n = n as i32;
        let wrapped = match self.wrap {
            Wrap::Clamp => i.clamp(0, n - 1),
            Wrap::Repeat => i.rem_euclid(n),
            Wrap::Mirror => {
                let j = i.rem_euclid(n);
                if i.div_euclid(n) & 1 == 0 { j } else { n - 1 - j }
            }
        };
        wrapped as usize
    }

    fn texel(&self, x: i32, y: i32) -> Rgb {
        let i = self.wrap(y, self.height) * self.width + self.wrap(x, self.width);
        if self.channels == 3 {
            Rgb::new(self.data.get(3 * i), self.data.get(3 * i + 1), self.data.get(3 * i + 2))
        } else {
            Rgb::splat(self.data.get(i))
        }
    }
}

/// Texel coordinates stay far inside i32 for any finite uv.
fn to_index(x: f32) -> i32 {
    x.floor().clamp(-1e9, 1e9) as i32
}

impl TextureModel for Bitmap {
    fn memory(&self) -> usize {
        match &self.data {
            Texels::Floats(v) => 4 * v.len(),
            Texels::Bytes(v, table) => v.len() + 4 * table.len(),
        }
    }

    fn eval(&self, at: TexturePoint<'_>) -> Rgb {
        let uv = at.uv;
        let [a, b] = self.to_uv;
        let x = (a[0] * uv.x + a[1] * uv.y + a[2]) * self.width as f32;
        let y = (b[0] * uv.x + b[1] * uv.y + b[2]) * self.height as f32;
        match self.filter {
            Filter::Nearest => self.texel(to_index(x), to_index(y)),
            Filter::Bilinear => {
                // Texel centres lie at half-integers.
                let (x, y) = (x - 0.5, y - 0.5);
                let (i, j) = (to_index(x), to_index(y));
                let (fx, fy) = (x - x.floor(), y - y.floor());
                let top = self.texel(i, j).lerp(self.texel(i + 1, j), fx);
                let bottom = self.texel(i, j + 1).lerp(self.texel(i + 1, j + 1), fx);
                top.lerp(bottom, fy)
            }
        }
    }

    fn gradient(&self, uv: Vec2) -> Vec2 {
        if self.filter == Filter::Nearest {
            return Vec2::ZERO;
        }
        let [a, b] = self.to_uv;
        let size = Vec2::new(self.width as f32, self.height as f32);
        let p = size * Vec2::new(
            a[0] * uv.x + a[1] * uv.y + a[2],
            b[0] * uv.x + b[1] * uv.y + b[2],
        ) - 0.5;
        let (i, j) = (to_index(p.x), to_index(p.y));
        let f = p - p.floor();
        let at = |x: i32, y: i32| {
            let value = self.texel(x, y);
            if self.channels == 1 { value.x } else { luminance(value) }
        };
        let (f00, f10) = (at(i, j), at(i + 1, j));
        let (f01, f11) = (at(i, j + 1), at(i + 1, j + 1));
        let dx = (1.0 - f.y) * (f10 - f00) + f.y * (f11 - f01);
        let dy = (1.0 - f.x) * (f01 - f00) + f.x * (f11 - f10);
        // As Mitsuba: the resolution comes last, so a `to_uv` that turns a bitmap that is no square is off.
        size * Vec2::new(a[0] * dx + b[0] * dy, a[1] * dx + b[1] * dy)
    }

    fn eval_scalar(&self, at: TexturePoint<'_>) -> f32 {
        let value = self.eval(at);
        if self.channels == 1 { value.x } else { luminance(value) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn indices_wrap_on_both_sides() {
        let wrapped = |wrap| -> Vec<usize> {
            let bitmap = Bitmap {
                data: Texels::Floats(vec![0.0; 3]),
                width: 3,
                height: 1,
                channels: 1,
                to_uv: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
                wrap,
                filter: Filter::Nearest,
            };
            (-4..8).map(|i| bitmap.wrap(i, 3)).collect()
        };
        assert_eq!(wrapped(Wrap::Repeat), [2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1]);
        assert_eq!(wrapped(Wrap::Mirror), [2, 2, 1, 0, 0, 1, 2, 2, 1, 0, 0, 1]);
        assert_eq!(wrapped(Wrap::Clamp), [0, 0, 0, 0, 0, 1, 2, 2, 2, 2, 2, 2]);
    }
}
