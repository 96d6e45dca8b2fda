//! The film: which pixels there are, and how samples add up to them.
//!
//! A pixel is Σ w·v / Σ w over the samples within the filter's radius, as in Mitsuba's `hdrfilm`; for the
//! box filter that is the mean of the pixel's own samples. Beside it the variance of that mean:
//! Σ w²(v − pixel)² / (Σ w)² ÷ c, where c = 1 − 2 Σw³/(Σw·Σw²) + Σw²/(Σw)² makes it unbiased for independent
//! samples of one distribution; for n equal weights c = 1 − 1/n, Bessel's correction.

use serde::Deserialize;

use crate::error::SceneError;
use crate::math::Rgb;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(crate) size: [u32; 2],
    pub(crate) crop_offset: [u32; 2],
    pub(crate) crop_size: [u32; 2],
    pub(crate) rfilter: FilterDescription,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FilterDescription {
    #[serde(rename = "type")]
    pub(crate) name: String,
    pub(crate) radius: f32,
    pub(crate) table: Vec<f32>,
}

/// A pixel's sums take 104 bytes: a larger image would not fit in memory.
const MOST_PIXELS: u64 = 1 << 28;

/// Size, crop and reconstruction filter.
#[derive(Clone, Debug)]
pub struct Film {
    size: [u32; 2],
    crop_offset: [u32; 2],
    crop_size: [u32; 2],
    filter: Option<Filter>,
    filter_name: String,
}

/// A separable filter, tabulated by where in its pixel a sample lies: a row holds the weights of all pixels that it
/// reaches, so that one look-up and one interpolation give them all.
#[derive(Clone, Debug)]
struct Filter {
    /// Pixels that a sample reaches on either side of its own.
    reach: usize,
    /// `STEPS + 1` rows of `2 · reach + 1` weights.
    rows: Vec<f32>,
}

impl Filter {
    /// Positions in a pixel that are tabulated: what interpolation between them misses is below 1e-5 of the weight at the
    /// centre, for a filter as narrow as Mitsuba's.
    const STEPS: usize = 256;

    /// From values at equal steps over [0, radius].
    fn new(radius: f32, table: &[f32]) -> Self {
        let eval = |x: f32| {
            let x = x.abs() / radius;
            if x >= 1.0 {
                return 0.0;
            }
            let t = x * (table.len() - 1) as f32;
            let i = (t as usize).min(table.len() - 2);
            table[i] + (table[i + 1] - table[i]) * (t - i as f32)
        };
        let reach = (radius - 0.5).ceil().max(0.0) as usize;
        let rows = (0..=Self::STEPS).flat_map(|step| {
            let x = step as f32 / Self::STEPS as f32;
            (0..=2 * reach).map(move |i| i as f32 - reach as f32 + 0.5 - x)
        });
        Self {
            reach,
            rows: rows.map(eval).collect(),
        }
    }

    /// The weights of all columns within `start .. start + n` that a sample at `x` reaches; returns the first.
    #[inline]
    fn weights(&self, x: f32, start: u32, n: u32, weights: &mut Vec<f32>) -> u32 {
        let pixel = x as u32;
        let t = (x - pixel as f32) * Self::STEPS as f32;
        let step = (t as usize).min(Self::STEPS - 1);
        let t = t - step as f32;
        let width = 2 * self.reach + 1;
        let (below, above) = self.rows[step * width..][..2 * width].split_at(width);
        // Counted from `reach` columns left of the film, to stay positive.
        let first = pixel as usize;
        let from = (start as usize + self.reach).saturating_sub(first);
        let to = (start as usize + n as usize + self.reach)
            .saturating_sub(first)
            .min(width);
        weights.clear();
        let inside = from.min(to)..to;
        weights.extend(
            below[inside.clone()]
                .iter()
                .zip(&above[inside.clone()])
                .map(|(&a, &b)| a + (b - a) * t),
        );
        // A filter is rarely wider than an even number of pixels: of the outermost two, one gets nothing.
        if weights.last() == Some(&0.0) {
            weights.pop();
        }
        (first + inside.start).saturating_sub(self.reach) as u32
    }
}

impl Film {
    pub(crate) fn build(d: Description) -> Result<Self, SceneError> {
        let value = |name: &'static str, value: f64, rule: &'static str| SceneError::Value {
            owner: "film".to_owned(),
            name,
            place: String::new(),
            value,
            rule,
        };
        for axis in 0..2 {
            let (size, crop, offset) = (d.size[axis], d.crop_size[axis], d.crop_offset[axis]);
            if size == 0 || size > 1 << 16 {
                return Err(value("size", f64::from(size), "between 1 and 65536 pixels"));
            }
            if crop == 0 || u64::from(offset) + u64::from(crop) > u64::from(size) {
                return Err(value(
                    "crop_size",
                    f64::from(crop),
                    "positive and inside the film",
                ));
            }
        }
        let pixels = d.crop_size.iter().map(|&n| u64::from(n)).product::<u64>();
        if pixels > MOST_PIXELS {
            return Err(value(
                "crop_size",
                pixels as f64,
                "at most 268435456 pixels in all; render it in crops",
            ));
        }
        let filter = if d.rfilter.name == "box" {
            None
        } else {
            let f = d.rfilter;
            if !(f.radius > 0.0 && f.radius <= 64.0) {
                return Err(value(
                    "rfilter.radius",
                    f.radius.into(),
                    "between 0 and 64 pixels",
                ));
            }
            if f.table.len() < 2 || f.table.iter().any(|x| !x.is_finite()) {
                return Err(value(
                    "rfilter.table",
                    f.table.len() as f64,
                    "two or more finite values",
                ));
            }
            Some(Filter::new(f.radius, &f.table))
        };
        let filter_name = if filter.is_some() { "table" } else { "box" }.to_owned();
        Ok(Self {
            size: d.size,
            crop_offset: d.crop_offset,
            crop_size: d.crop_size,
            filter,
            filter_name,
        })
    }

    /// Whole film, (width, height).
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// Corner of the crop within the film.
    pub fn crop_offset(&self) -> [u32; 2] {
        self.crop_offset
    }

    /// Size of the image that is rendered, (width, height).
    pub fn crop_size(&self) -> [u32; 2] {
        self.crop_size
    }

    /// Number of rendered pixels.
    pub fn pixels(&self) -> usize {
        self.crop_size[0] as usize * self.crop_size[1] as usize
    }

    /// `box`, or `table` for all other filters.
    pub fn filter_name(&self) -> &str {
        &self.filter_name
    }

    /// Pixels beyond a tile's edge that its samples reach.
    pub fn border(&self) -> u32 {
        self.filter.as_ref().map_or(0, |f| f.reach as u32)
    }
}

/// A rectangle of pixels, in crop coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Sums of one pixel. `f64`, since thousands of passes add up here.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    /// Σ w
    weight: f64,
    /// Σ w²
    weight_2: f64,
    /// Σ w³
    weight_3: f64,
    /// Σ w·v
    value: [f64; 3],
    /// Σ w²·v
    value_w2: [f64; 3],
    /// Σ w²·v²
    square_w2: [f64; 3],
}

/// Samples added up over a rectangle of pixels.
#[derive(Clone, Debug)]
pub struct Accumulator {
    tile: Tile,
    sums: Vec<Sums>,
    /// Per pixel, whatever the filter: its own paths found and its own paths that carry light.
    counts: Vec<[u32; 2]>,
    /// Scratch: a sample's weights by column and by row.
    weights: [Vec<f32>; 2],
}

/// What the sums come to; rows from the top.
#[derive(Clone, Debug)]
pub struct Developed {
    /// (height, width, 3): mean radiance.
    pub image: Vec<f32>,
    /// (height, width, 3): variance of that mean.
    pub variance: Vec<f32>,
    /// (height, width): paths through the pixel whose vertices x₁ … x_k all exist.
    pub found: Vec<u32>,
    /// (height, width): paths through the pixel that carry light.
    pub nonzero: Vec<u32>,
}

impl Accumulator {
    /// An empty one for `tile`, widened by the filter's border and cut at the crop.
    pub fn new(film: &Film, tile: Tile) -> Self {
        let border = film.border();
        let (x, y) = (tile.x.saturating_sub(border), tile.y.saturating_sub(border));
        let right = (tile.x + tile.width + border).min(film.crop_size[0]);
        let bottom = (tile.y + tile.height + border).min(film.crop_size[1]);
        let tile = Tile {
            x,
            y,
            width: right - x,
            height: bottom - y,
        };
        let pixels = tile.width as usize * tile.height as usize;
        Self {
            tile,
            sums: vec![Sums::default(); pixels],
            counts: vec![[0; 2]; pixels],
            weights: Default::default(),
        }
    }

    /// An empty one for the whole image.
    pub fn whole(film: &Film) -> Self {
        let [width, height] = film.crop_size;
        Self::new(
            film,
            Tile {
                x: 0,
                y: 0,
                width,
                height,
            },
        )
    }

    /// Adds a path at a film position (pixels from the crop's corner): its estimate, and whether it found
    /// all its vertices.
    #[inline]
    pub fn add(&mut self, film: &Film, position: [f32; 2], value: Rgb, found: bool) {
        let own = self.index(position[0] as u32, position[1] as u32);
        self.counts[own][0] += u32::from(found);
        self.counts[own][1] += u32::from(value != Rgb::ZERO);
        let Some(filter) = &film.filter else {
            return self.splat(own, 1.0, value);
        };
        // Separable: one weight a column and one a row.
        let t = self.tile;
        let [mut columns, mut rows] = std::mem::take(&mut self.weights);
        let x = filter.weights(position[0], t.x, t.width, &mut columns);
        let y = filter.weights(position[1], t.y, t.height, &mut rows);
        for (j, &wy) in rows.iter().enumerate() {
            let row = self.index(x, y + j as u32);
            for (i, &wx) in columns.iter().enumerate() {
                self.splat(row + i, wx * wy, value);
            }
        }
        self.weights = [columns, rows];
    }

    /// Where a pixel lies in the sums; one outside (rounding at the very edge) counts as the nearest inside.
    #[inline]
    fn index(&self, x: u32, y: u32) -> usize {
        let t = self.tile;
        let x = x.clamp(t.x, t.x + t.width - 1) - t.x;
        let y = y.clamp(t.y, t.y + t.height - 1) - t.y;
        y as usize * t.width as usize + x as usize
    }

    #[inline]
    fn splat(&mut self, index: usize, w: f32, value: Rgb) {
        let s = &mut self.sums[index];
        let w = f64::from(w);
        s.weight += w;
        s.weight_2 += w * w;
        s.weight_3 += w * w * w;
        // Most paths carry nothing.
        if value != Rgb::ZERO {
            for (c, v) in value.to_array().into_iter().map(f64::from).enumerate() {
                s.value[c] += w * v;
                s.value_w2[c] += w * w * v;
                s.square_w2[c] += w * w * v * v;
            }
        }
    }

    /// Adds another accumulator's sums; where they overlap, in the caller's order.
    pub fn merge(&mut self, other: &Self) {
        self.merge_weighted(other, |_, _| 1.0);
    }

    /// Adds another accumulator's sums, the samples of each pixel (column, row) with one more weight.
    pub fn merge_weighted(&mut self, other: &Self, weight: impl Fn(u32, u32) -> f64) {
        let b = other.tile;
        for row in 0..b.height {
            for column in 0..b.width {
                let (x, y) = (b.x + column, b.y + row);
                let (i, j) = (self.index(x, y), (row * b.width + column) as usize);
                let w = weight(x, y);
                for c in 0..2 {
                    self.counts[i][c] += other.counts[j][c];
                }
                let (to, from) = (&mut self.sums[i], &other.sums[j]);
                to.weight += w * from.weight;
                to.weight_2 += w * w * from.weight_2;
                to.weight_3 += w * w * w * from.weight_3;
                for c in 0..3 {
                    to.value[c] += w * from.value[c];
                    to.value_w2[c] += w * w * from.value_w2[c];
                    to.square_w2[c] += w * w * from.square_w2[c];
                }
            }
        }
    }

    /// Variance of one of these samples relative to `mean`² + `epsilon`, averaged over the pixels (column, row)
    /// `inside` and the channels. `mean` is the image as it is known best, so that one sample a pixel will do.
    pub fn relative_spread(
        &self,
        mean: &Developed,
        epsilon: f64,
        inside: impl Fn(u32, u32) -> bool,
    ) -> f64 {
        let (mut sum, mut n) = (0.0, 0u64);
        for (i, s) in self.sums.iter().enumerate() {
            let (x, y) = (i as u32 % self.tile.width, i as u32 / self.tile.width);
            if s.weight_2 <= 0.0 || !inside(self.tile.x + x, self.tile.y + y) {
                continue;
            }
            for c in 0..3 {
                let m = f64::from(mean.image[3 * i + c]);
                let square = s.square_w2[c] - 2.0 * m * s.value_w2[c] + m * m * s.weight_2;
                sum += square / s.weight_2 / (m * m + epsilon);
                n += 1;
            }
        }
        sum / n.max(1) as f64
    }

    /// Mean, variance of the mean, and counts.
    pub fn develop(&self) -> Developed {
        let mut image = Vec::with_capacity(3 * self.sums.len());
        let mut variance = Vec::with_capacity(3 * self.sums.len());
        for s in &self.sums {
            for c in 0..3 {
                let (mut mean, mut var) = (0.0, 0.0);
                if s.weight != 0.0 {
                    mean = s.value[c] / s.weight;
                    let squares =
                        s.square_w2[c] - 2.0 * mean * s.value_w2[c] + mean * mean * s.weight_2;
                    let w_2 = s.weight * s.weight;
                    let correction =
                        1.0 - 2.0 * s.weight_3 / (s.weight * s.weight_2) + s.weight_2 / w_2;
                    // Zero but for rounding where one sample has all the weight.
                    var = if correction > 1e-9 {
                        squares.max(0.0) / w_2 / correction
                    } else {
                        f64::INFINITY
                    };
                }
                image.push(mean as f32);
                variance.push(var as f32);
            }
        }
        Developed {
            image,
            variance,
            found: self.counts.iter().map(|c| c[0]).collect(),
            nonzero: self.counts.iter().map(|c| c[1]).collect(),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn film(name: &str, radius: f32) -> Film {
        let table = (0..33).map(|i| (-2.0 * (i as f32 / 32.0 * radius).powi(2)).exp());
        Film::build(Description {
            size: [5, 5],
            crop_offset: [0, 0],
            crop_size: [5, 5],
            rfilter: FilterDescription {
                name: name.to_owned(),
                radius,
                table: table.collect(),
            },
        })
        .unwrap()
    }

    #[test]
    fn the_variance_is_that_of_the_mean_for_any_filter() {
        let stream = pss_rng::Stream::new(7, pss_rng::Purpose::Test);
        for (film, spp) in [
            (film("box", 0.5), 2),
            (film("gaussian", 2.0), 1),
            (film("gaussian", 2.0), 4),
        ] {
            let repeats = 20_000;
            let (mut sum, mut sum_2, mut predicted) = (0.0, 0.0, 0.0);
            for repeat in 0..repeats {
                let mut numbers = stream.sequence(repeat, spp);
                let mut image = Accumulator::whole(&film);
                for pixel in 0..25 {
                    for _ in 0..spp {
                        let position = [
                            (pixel % 5) as f32 + numbers.next_f32(),
                            (pixel / 5) as f32 + numbers.next_f32(),
                        ];
                        image.add(&film, position, Rgb::splat(numbers.next_f32()), true);
                    }
                }
                let developed = image.develop();
                let centre = f64::from(developed.image[3 * 12]);
                sum += centre;
                sum_2 += centre * centre;
                predicted += f64::from(developed.variance[3 * 12]);
            }
            let n = f64::from(repeats);
            let variance = (sum_2 - sum * sum / n) / (n - 1.0);
            // Five standard errors of either variance are below 6 %.
            let ratio = predicted / n / variance;
            assert!((ratio - 1.0).abs() < 0.06, "{film:?} {spp} spp: {ratio}");
        }
    }

    #[test]
    fn one_sample_says_nothing_of_its_variance() {
        for film in [film("box", 0.5), film("gaussian", 2.0)] {
            let mut image = Accumulator::whole(&film);
            image.add(&film, [2.3, 2.9], Rgb::splat(0.7), true);
            let developed = image.develop();
            assert_eq!(developed.variance[3 * 12], f32::INFINITY);
            assert!((developed.image[3 * 12] - 0.7).abs() < 1e-6);
            assert_eq!((developed.found[12], developed.nonzero[12]), (1, 1));
        }
    }
}
