//! Hierarchical sample warping (Clarberg et al. 2005): draws points of [0, 1]² in proportion to a bilinear
//! interpolant of a grid, from coarse to fine through sums of 2 × 2 cells, then within one patch by
//! inversion. The steps and their order are those of Mitsuba's `Hierarchical2D`, so that equal numbers
//! give equal points.

/// One level of sums; cells outside of the grid are zero.
#[derive(Clone, Debug)]
struct Level {
    width: usize,
    height: usize,
    sums: Vec<f32>,
}

impl Level {
    #[inline]
    fn at(&self, x: usize, y: usize) -> f32 {
        if x < self.width && y < self.height {
            self.sums[y * self.width + x]
        } else {
            0.0
        }
    }
}

/// A density on the unit square.
#[derive(Clone, Debug)]
pub(crate) struct Hierarchical {
    /// Grid points, scaled so that the interpolant's mean is 1.
    grid: Vec<f32>,
    width: usize,
    height: usize,
    /// Sums of patches, finest first; two cells at the most across the last one.
    levels: Vec<Level>,
}

impl Hierarchical {
    /// From values ≥ 0 at `width` × `height` grid points, rows first, at least 2 × 2 of them. `None` where
    /// their interpolant is zero everywhere or not finite, so that there is nothing to draw.
    pub(crate) fn new(mut grid: Vec<f32>, width: usize, height: usize) -> Option<Self> {
        if width < 2 || height < 2 || grid.len() != width * height {
            return None;
        }
        let (columns, rows) = (width - 1, height - 1);
        let mut sums = Vec::with_capacity(columns * rows);
        let mut total = 0.0f64;
        for y in 0..rows {
            for x in 0..columns {
                let i = y * width + x;
                let mean = 0.25 * (grid[i] + grid[i + 1] + grid[i + width] + grid[i + width + 1]);
                total += f64::from(mean);
                sums.push(mean);
            }
        }
        let scale = ((columns * rows) as f64 / total) as f32;
        if !(scale.is_finite() && scale > 0.0 && total > 0.0) {
            return None;
        }
        grid.iter_mut().for_each(|v| *v *= scale);
        sums.iter_mut().for_each(|v| *v *= scale);

        let mut levels = vec![Level {
            width: columns,
            height: rows,
            sums,
        }];
        loop {
            let last = &levels[levels.len() - 1];
            if last.width <= 2 && last.height <= 2 {
                break;
            }
            let (w, h) = (last.width.div_ceil(2), last.height.div_ceil(2));
            let mut sums = Vec::with_capacity(w * h);
            for y in 0..h {
                for x in 0..w {
                    let at = |i: usize, j: usize| last.at(2 * x + i, 2 * y + j);
                    sums.push(at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1));
                }
            }
            levels.push(Level {
                width: w,
                height: h,
                sums,
            });
        }
        // A single patch needs no choice.
        if columns == 1 && rows == 1 {
            levels.clear();
        }
        Some(Self {
            grid,
            width,
            height,
            levels,
        })
    }

    /// A point and its density.
    pub(crate) fn sample(&self, u: [f32; 2]) -> ([f32; 2], f32) {
        let [mut sx, mut sy] = u.map(|x| x.clamp(0.0, 1.0));
        let (mut x, mut y) = (0, 0);
        for level in self.levels.iter().rev() {
            (x, y) = (2 * x, 2 * y);
            (sx, sy) = (sx.clamp(0.0, 1.0), sy.clamp(0.0, 1.0));
            let (v00, v10) = (level.at(x, y), level.at(x + 1, y));
            let (v01, v11) = (level.at(x, y + 1), level.at(x + 1, y + 1));

            let (r0, r1) = (v00 + v10, v01 + v11);
            sy *= r0 + r1;
            // The number 0 must not fall on a cell without weight.
            let lower = sy > r0 || r0 == 0.0;
            let (dy, c0, c1) = if lower {
                (r1, v01, v11)
            } else {
                (r0, v00, v10)
            };
            if lower {
                sy -= r0;
                y += 1;
            }

            sx *= dy;
            let right = sx > c0 || c0 == 0.0;
            let dx = if right { c1 } else { c0 };
            if right {
                sx -= c0;
                x += 1;
            }

            let inverse = 1.0 / (dy * dx);
            sy *= dx * inverse;
            sx *= dy * inverse;
        }

        // Rounding at a number's upper end must not leave the grid.
        let (x, y) = (x.min(self.width - 2), y.min(self.height - 2));
        let [v00, v10, v01, v11] = self.patch(x, y);
        let py = interval_to_linear(v00 + v10, v01 + v11, sy);
        let (c0, c1) = (lerp(v00, v01, py), lerp(v10, v11, py));
        let px = interval_to_linear(c0, c1, sx);
        let point = [
            (x as f32 + px) / (self.width - 1) as f32,
            (y as f32 + py) / (self.height - 1) as f32,
        ];
        (point, lerp(c0, c1, px))
    }

    /// Density of [`Hierarchical::sample`].
    pub(crate) fn pdf(&self, point: [f32; 2]) -> f32 {
        let cell = |p: f32, n: usize| {
            let p = p.clamp(0.0, 1.0) * (n - 1) as f32;
            let i = (p as usize).min(n - 2);
            (i, p - i as f32)
        };
        let (x, px) = cell(point[0], self.width);
        let (y, py) = cell(point[1], self.height);
        let [v00, v10, v01, v11] = self.patch(x, y);
        lerp(lerp(v00, v10, px), lerp(v01, v11, px), py)
    }

    #[inline]
    fn patch(&self, x: usize, y: usize) -> [f32; 4] {
        let i = y * self.width + x;
        let below = i + self.width;
        [
            self.grid[i],
            self.grid[i + 1],
            self.grid[below],
            self.grid[below + 1],
        ]
    }
}

#[inline]
fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// Inverts the cumulative distribution of a density that runs linearly from `v0` to `v1`.
#[inline]
fn interval_to_linear(v0: f32, v1: f32, u: f32) -> f32 {
    if (v0 - v1).abs() > 1e-4 * (v0 + v1) {
        (v0 - lerp(v0 * v0, v1 * v1, u).max(0.0).sqrt()) / (v0 - v1)
    } else {
        u
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn example(width: usize, height: usize) -> Hierarchical {
        let grid = (0..width * height).map(|i| ((i * 7919) % 101) as f32 / 10.0);
        Hierarchical::new(grid.collect(), width, height).unwrap()
    }

    #[test]
    fn samples_have_the_density_that_is_said() {
        for (w, h) in [(2, 2), (3, 2), (5, 7), (18, 9)] {
            let d = example(w, h);
            let mut numbers = pss_rng::Stream::new(5, pss_rng::Purpose::Test).sequence(0, 0);
            let mut mean = 0.0;
            for _ in 0..20_000 {
                let u = [numbers.next_f32(), numbers.next_f32()];
                let (p, pdf) = d.sample(u);
                assert!(p.iter().all(|x| (0.0..=1.0).contains(x)), "{u:?} {p:?}");
                assert!(
                    (pdf - d.pdf(p)).abs() <= 1e-3 * pdf.max(0.1),
                    "{p:?}: {pdf} {}",
                    d.pdf(p)
                );
                // E[x / pdf] over the samples is the integral of x over the square.
                mean += f64::from((p[0] + 2.0 * p[1]) / pdf) / 20_000.0;
            }
            assert!((mean - 1.5).abs() < 0.1, "{w} × {h}: {mean}");
        }
    }

    #[test]
    fn darkness_is_not_drawn() {
        assert!(Hierarchical::new(vec![0.0; 12], 4, 3).is_none());
        let mut grid = vec![0.0; 81];
        grid[9 * 4 + 4] = 1.0;
        let d = Hierarchical::new(grid, 9, 9).unwrap();
        for i in 0..1000 {
            let (p, pdf) = d.sample([(i % 31) as f32 / 31.0, i as f32 / 1000.0]);
            assert!(p.iter().all(|x| (0.374..=0.626).contains(x)) && pdf >= 0.0);
        }
    }
}
