//! Lepage's iteration, on recorded paths.
//!
//! The best density of the form Π p_i(u_i) has p_i(u_i)² ∝ ∫ f² / Π_{j≠i} p_j over all other numbers (Lepage 1978,
//! eq. 9), so that every number's bins depend on those of all others: an iteration estimates the second moments
//! d = ∫_bin f²/q of all bins with the q so far, smooths them, and divides each number's bins in proportion to
//! ((1 − r)/ln(1/r))^α, r the bin's share of Σd. Where all d are equal the bins stay.
//! VEGAS draws new points for each iteration; here the same paths are weighed anew, f²/(g q).

use rayon::prelude::*;

use super::grid::{FLOOR, Grid, NARROWEST};
use super::options::VegasOptions;
use crate::Records;

/// Rows that are summed together, the same on any number of threads.
const CHUNK: usize = 4096;

/// Paths looked at for the bins, and for each tile on top of these: more would move no border.
const MOST_ROWS: usize = 1 << 17;

/// A path: its numbers, tile, and estimate of ∫f² in (0, 1].
#[derive(Clone, Copy, Debug)]
pub(super) struct Row {
    pub(super) path: usize,
    pub(super) tile: usize,
    pub(super) weight: f64,
}

/// Fits bins to all rows, then the probabilities of these bins in each tile; `None` if `progress` cancelled.
pub(super) fn fit(
    options: &VegasOptions,
    records: &Records<'_>,
    rows: &mut [Row],
    progress: &mut dyn FnMut(f32) -> bool,
) -> Option<Grid> {
    let side = options.side();
    let whole = if side > 1 { 0.6 } else { 1.0 };
    let mut grid = Grid::uniform(records.dims, options.bins, 1);
    let stride = rows.len().div_ceil(MOST_ROWS).max(1);
    let some: Vec<Row> = rows.iter().step_by(stride).copied().collect();
    for step in 0..options.iterations {
        progress(whole * step as f32 / options.iterations as f32).then_some(())?;
        let moments = chunked_moments(&grid, records, &some);
        for column in 0..grid.dims {
            let d = &moments[column * options.bins..][..options.bins];
            let moved = divide(grid.edges(column), d, options.damping);
            grid.edges[column * (options.bins + 1)..][..moved.len()].copy_from_slice(&moved);
        }
    }
    if side == 1 {
        return Some(grid);
    }

    // What the whole image says of each bin, ∫_bin f²/Π_{j≠i} p_j: towards this a tile is shrunk.
    let parent = shares(&grid, chunked_moments(&grid, records, &some));
    // Stable: a tile's sums are then taken in the same order on any number of threads.
    rows.par_sort_by_key(|row| row.tile);
    let mut sums = Vec::with_capacity(side * side * grid.sums.len());
    let tiles: Vec<usize> = (0..side * side).collect();
    let mut done = 0;
    for some in tiles.chunks(tiles.len().div_ceil(8)) {
        progress(whole + (0.99 - whole) * done as f32 / tiles.len() as f32).then_some(())?;
        done += some.len();
        let fitted: Vec<Grid> = some
            .par_iter()
            .map(|&tile| {
                let from = rows.partition_point(|row| row.tile < tile);
                let to = rows.partition_point(|row| row.tile <= tile);
                fit_tile(options, records, &grid, &parent, &rows[from..to])
            })
            .collect();
        fitted.iter().for_each(|tile| sums.extend(&tile.sums));
    }
    Some(Grid { side, sums, ..grid })
}

/// The probabilities of the bins in one tile.
fn fit_tile(
    options: &VegasOptions,
    records: &Records<'_>,
    whole: &Grid,
    parent: &[f64],
    rows: &[Row],
) -> Grid {
    let (bins, mut grid) = (whole.bins, whole.clone());
    let stride = rows.len().div_ceil(MOST_ROWS).max(1);
    let some: Vec<Row> = rows.iter().step_by(stride).copied().collect();
    for _ in 0..options.iterations {
        let mut moments = Moments::new(&grid);
        moments.add(&grid, records, &some);
        if moments.sum <= 0.0 {
            return grid;
        }
        let own = shares(&grid, moments.d);
        // Effective number of paths (Kish 1965): one bright one tells little.
        let paths = moments.sum * moments.sum / moments.square;
        let seen = paths / (paths + options.kappa);
        for column in 0..grid.dims {
            let edges = grid.edges(column);
            let at = column * bins;
            let roots: Vec<f64> = (0..bins)
                .map(|bin| {
                    let moment = seen * own[at + bin] + (1.0 - seen) * parent[at + bin];
                    (moment * f64::from(edges[bin + 1] - edges[bin])).sqrt()
                })
                .collect();
            let total: f64 = roots.iter().sum();
            let mut below = 0.0;
            let line = &mut grid.sums[column * (bins + 1)..][..=bins];
            for (border, root) in line[1..bins].iter_mut().zip(&roots) {
                below += (1.0 - FLOOR) * root / total + FLOOR / bins as f64;
                *border = below as f32;
            }
        }
    }
    grid
}

/// d, weighed by the density in each bin: ∫_bin f²/Π_{j≠i} p_j; each number's as shares of their sum.
fn shares(grid: &Grid, mut d: Vec<f64>) -> Vec<f64> {
    for (column, d) in d.chunks_exact_mut(grid.bins).enumerate() {
        for (bin, d) in d.iter_mut().enumerate() {
            *d *= f64::from(grid.height(0, column, bin));
        }
        let sum: f64 = d.iter().sum();
        d.iter_mut().for_each(|d| *d /= sum);
    }
    d
}

/// ∫_bin f²/q of all bins of a grid of one tile.
struct Moments {
    /// `(dims, bins)`.
    d: Vec<f64>,
    /// Σ of the rows' f²/(g q).
    sum: f64,
    /// Σ of their squares.
    square: f64,
}

impl Moments {
    fn new(grid: &Grid) -> Self {
        Self {
            d: vec![0.0; grid.dims * grid.bins],
            sum: 0.0,
            square: 0.0,
        }
    }

    fn add(&mut self, grid: &Grid, records: &Records<'_>, rows: &[Row]) {
        let mut at = vec![0; grid.dims];
        for row in rows {
            let u = &records.u[row.path * grid.dims..][..grid.dims];
            let mut q = 1.0;
            for (column, (&u, at)) in u.iter().zip(&mut at).enumerate() {
                let bin = grid.bin(column, u);
                q *= f64::from(grid.height(0, column, bin));
                *at = column * grid.bins + bin;
            }
            let d = row.weight / q;
            self.sum += d;
            self.square += d * d;
            at.iter().for_each(|&at| self.d[at] += d);
        }
    }
}

fn chunked_moments(grid: &Grid, records: &Records<'_>, rows: &[Row]) -> Vec<f64> {
    let parts: Vec<Vec<f64>> = rows
        .par_chunks(CHUNK)
        .map(|rows| {
            let mut part = Moments::new(grid);
            part.add(grid, records, rows);
            part.d
        })
        .collect();
    let mut sum = vec![0.0; grid.dims * grid.bins];
    for part in parts {
        sum.iter_mut().zip(&part).for_each(|(sum, d)| *sum += d);
    }
    sum
}

/// New borders, between which the bins' damped moments are equal (Lepage 1978, eqs. 12 to 15; 2021, §II).
fn divide(edges: &[f32], d: &[f64], alpha: f64) -> Vec<f32> {
    let bins = d.len();
    // Of weight 6/8 in the middle (2021): with equal weights bins that alternate in width would look alike.
    let smooth = |bin: usize| {
        let (before, after) = (d[bin.saturating_sub(1)], d[(bin + 1).min(bins - 1)]);
        (before + 6.0 * d[bin] + after) / 8.0
    };
    let smoothed: Vec<f64> = (0..bins).map(smooth).collect();
    let sum: f64 = smoothed.iter().sum();
    if sum.is_nan() || sum <= 0.0 {
        return edges.to_vec();
    }
    let mut parts: Vec<f64> = smoothed
        .iter()
        .map(|d| match d / sum {
            r if r <= 0.0 => 0.0,
            r if r >= 1.0 => 1.0,
            r => ((1.0 - r) / -r.ln()).powf(alpha),
        })
        .collect();
    let each = parts.iter().sum::<f64>() / bins as f64;
    parts
        .iter_mut()
        .for_each(|part| *part = (1.0 - FLOOR) * *part + FLOOR * each);

    let mut moved = edges.to_vec();
    let (mut bin, mut left) = (0, parts[0]);
    for border in &mut moved[1..bins] {
        let mut needed = each;
        while needed > left && bin + 1 < bins {
            needed -= left;
            bin += 1;
            left = parts[bin];
        }
        left -= needed;
        let (from, to) = (f64::from(edges[bin]), f64::from(edges[bin + 1]));
        *border = (to - (to - from) * (left / parts[bin]).clamp(0.0, 1.0)) as f32;
    }
    for i in 1..bins {
        let most = 1.0 - (bins - i) as f32 * NARROWEST;
        moved[i] = moved[i].max(moved[i - 1] + NARROWEST).min(most);
    }
    moved
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// With f = 2u the best density is f itself: after many iterations border i of n stands at √(i/n), but for the
    /// smoothing of so few bins, .022 at the first.
    #[test]
    fn the_bins_approach_the_best_density() {
        let n = 40_000;
        let u: Vec<f32> = (0..n).map(|i| (i as f32 + 0.5) / n as f32).collect();
        let f: Vec<f32> = u.iter().map(|u| 2.0 * u).collect();
        let one = vec![1.0; n];
        let records = Records {
            dims: 1,
            u: &u,
            f: &f,
            f_max: &f,
            g: &one,
            ..Records::default()
        };
        let row = |path: usize| Row {
            path,
            tile: 0,
            weight: f64::from(f[path] * f[path]),
        };
        let mut rows: Vec<Row> = (0..n).map(row).collect();
        let options = VegasOptions {
            iterations: 60,
            bins: 8,
            condition: crate::Condition::None,
            ..VegasOptions::default()
        };
        let grid = fit(&options, &records, &mut rows, &mut |_| true).unwrap();
        for (i, edge) in grid.edges(0).iter().enumerate() {
            let want = (i as f32 / 8.0).sqrt();
            assert!((edge - want).abs() < 0.03, "border {i}: {edge}, not {want}");
        }
    }

    #[test]
    fn equal_moments_leave_the_bins_alone_and_empty_ones_vanish() {
        let edges = [0.0, 0.1, 0.4, 1.0];
        for (moved, edge) in divide(&edges, &[2.0; 3], 1.5).iter().zip(edges) {
            assert!((moved - edge).abs() < 1e-6);
        }
        assert_eq!(divide(&edges, &[0.0; 3], 1.5), edges);
        // All in the first bin of many: they crowd there, and stay apart.
        let mut edges: Vec<f32> = (0..=64).map(|i| i as f32 / 64.0).collect();
        for _ in 0..200 {
            let inside = edges.partition_point(|&e| e < 1e-6);
            let d: Vec<f64> = (0..64).map(|i| f64::from(u8::from(i < inside))).collect();
            edges = divide(&edges, &d, 4.0);
            assert!(edges.is_sorted_by(|a, b| a < b) && edges[64] == 1.0);
        }
    }
}
