//! Tables over a pair of numbers: B × B leaves per cell, fitted as a quadtree.
//!
//! In every node of a cell's quadtree the children's shares of S₁ = Σ w (w: estimates of ∫f²) are shrunk towards
//! those of the parent cell, as in a Pólya tree (Lavine 1992, doi:10.1214/aos/1176348767):
//! p(child) = (ess · S₁child / S₁node + κ · p_parent(child)) / (ess + κ), ess = S₁² / Σ w² of the node. The leaves are then sampled
//! in proportion to the root of their mean of f², which is what minimises the second moment of f/q.
//!
//! A table is B + B² lower ends of intervals in units of 2⁻¹⁶: of the first number's bins, then of the second
//! number's bins within each of those. The intervals *are* the probabilities, so that samples and density
//! cannot disagree, and none is empty, so that the density is positive everywhere.

use super::tree::{Leaves, Row};

/// Largest B.
const MOST_BINS: usize = 32;
const MOST_LEAVES: usize = MOST_BINS * MOST_BINS;
/// Nodes of the quadtree, all levels.
const MOST_NODES: usize = MOST_LEAVES * 4 / 3 + 1;

/// Units of probability.
pub(super) const UNITS: f32 = 65_536.0;

/// B × B leaves; B is a power of two.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Square {
    pub(super) bins: usize,
    pub(super) kappa: f64,
}

impl Square {
    /// The numbers of bins that there are.
    pub(super) const BINS: [usize; 4] = [4, 8, 16, 32];

    /// Entries of a table.
    pub(super) fn entries(bins: usize) -> usize {
        bins + bins * bins
    }

    /// The leaf of a pair, in the quadtree's order.
    pub(super) fn leaf(self, u: [f32; 2]) -> u32 {
        let [i, j] = u.map(|u| bin(u, self.bins));
        morton(i, j) as u32
    }
}

/// Which of `bins` equal parts of [0, 1) holds `u`.
#[inline]
fn bin(u: f32, bins: usize) -> usize {
    ((u * bins as f32) as usize).min(bins - 1)
}

/// Interleaves the bits of i and j < 32.
#[inline]
fn morton(i: usize, j: usize) -> usize {
    (0..5).fold(0, |m, b| {
        m | ((i >> b & 1) << (2 * b + 1)) | ((j >> b & 1) << (2 * b))
    })
}

/// Sums over the nodes of a quadtree: `levels[0]` is the root, the leaves end the array.
struct Pyramid([f64; MOST_NODES]);

impl Pyramid {
    /// First node of a level: 4⁰ + … + 4^(level − 1).
    fn first(level: usize) -> usize {
        ((1 << (2 * level)) - 1) / 3
    }

    /// Sums up from the leaves, which are set.
    fn sum(&mut self, depth: usize) {
        for level in (0..depth).rev() {
            let (above, below) = self.0.split_at_mut(Self::first(level + 1));
            let nodes = &mut above[Self::first(level)..];
            for (node, children) in nodes.iter_mut().zip(below.chunks_exact(4)) {
                *node = children.iter().sum();
            }
        }
    }
}

impl Leaves for Square {
    type Shares = Vec<f32>;
    type Tables = Vec<u16>;

    fn prior(&self) -> Vec<f32> {
        let leaves = self.bins * self.bins;
        vec![1.0 / leaves as f32; leaves]
    }

    fn update(&self, parent: &Vec<f32>, rows: &[Row]) -> Vec<f32> {
        let leaves = self.bins * self.bins;
        let depth = self.bins.trailing_zeros() as usize;
        let zero = || Pyramid([0.0; MOST_NODES]);
        let (mut s1, mut s2, mut above) = (zero(), zero(), zero());
        let first = Pyramid::first(depth);
        for row in rows {
            let (leaf, w) = (first + row.bin as usize, f64::from(row.weight));
            s1.0[leaf] += w;
            s2.0[leaf] += w * w;
        }
        for (a, &p) in above.0[first..].iter_mut().zip(parent) {
            *a = f64::from(p);
        }
        for pyramid in [&mut s1, &mut s2, &mut above] {
            pyramid.sum(depth);
        }

        // From the root down, the shares take the place of the parent's.
        let mut shares = zero();
        shares.0[0] = 1.0;
        for level in 0..depth {
            for i in 0..1 << (2 * level) {
                let node = Pyramid::first(level) + i;
                let share = shares.0[node];
                let children = Pyramid::first(level + 1) + 4 * i;
                let (sum, prior) = (s1.0[node], above.0[node]);
                let from_prior = share / prior.max(f64::MIN_POSITIVE);
                if sum <= 0.0 {
                    for c in children..children + 4 {
                        shares.0[c] = from_prior * above.0[c];
                    }
                    continue;
                }
                let ess = sum * sum / s2.0[node];
                let total = ess + self.kappa;
                let (own, inherited) =
                    (share * ess / (total * sum), from_prior * self.kappa / total);
                for c in children..children + 4 {
                    shares.0[c] = own * s1.0[c] + inherited * above.0[c];
                }
            }
        }
        shares.0[first..first + leaves]
            .iter()
            .map(|&s| s as f32)
            .collect()
    }

    fn tabulate(&self, shares: &Vec<f32>, tables: &mut Vec<u16>) {
        let bins = self.bins;
        let mut leaf = [[0.0f64; MOST_BINS]; MOST_BINS];
        let mut first = [0.0; MOST_BINS];
        for i in 0..bins {
            for j in 0..bins {
                leaf[i][j] = f64::from(shares[morton(i, j)]).sqrt();
            }
            first[i] = leaf[i][..bins].iter().sum();
        }
        quantise(&first[..bins], tables);
        for row in &leaf[..bins] {
            quantise(&row[..bins], tables);
        }
    }

    fn append(&self, tables: &mut Vec<u16>, more: Vec<u16>) {
        tables.extend_from_slice(&more);
    }

    fn bytes(&self) -> usize {
        Self::entries(self.bins) * size_of::<u16>()
    }
}

/// Lower ends of intervals in proportion to `weights`, in units of 2⁻¹⁶, each of at least one unit.
pub(super) fn quantise(weights: &[f64], ends: &mut Vec<u16>) {
    let total: f64 = weights.iter().sum();
    let free = f64::from(UNITS) - weights.len() as f64;
    let mut sum = 0.0;
    for (i, w) in weights.iter().enumerate() {
        // Without any weight all are equal.
        let before = if total > 0.0 {
            sum / total
        } else {
            i as f64 / weights.len() as f64
        };
        ends.push(i as u16 + (before.min(1.0) * free) as u16);
        sum += w;
    }
}

/// Whether `ends` are what [`quantise`] writes.
pub(super) fn is_sound(ends: &[u16]) -> bool {
    ends.first() == Some(&0) && ends.is_sorted_by(|a, b| a < b)
}

/// Largest number below x > 0.
#[inline]
pub(super) fn below(x: f32) -> f32 {
    f32::from_bits(x.to_bits() - 1)
}

/// The bin of B equal ones that `u` falls on by `ends`, its number within [0, B), and the bin's units.
#[inline]
fn pick<const B: usize>(ends: &[u16; B], u: f32) -> (usize, f32, f32) {
    let x = u * UNITS;
    let whole = x as u16;
    let at = ends
        .iter()
        .map(|&end| u16::from(end <= whole))
        .sum::<u16>()
        .saturating_sub(1) as usize;
    let (start, units) = interval(ends, at);
    let at_f = at as f32;
    let y = at_f + (x - start) / units;
    (at, y.clamp(at_f, below(at_f + 1.0)), units)
}

/// Start and length of an interval, in units.
#[inline]
fn interval<const B: usize>(ends: &[u16; B], at: usize) -> (f32, f32) {
    let end = ends.get(at + 1).map_or(UNITS, |&e| f32::from(e));
    let start = f32::from(ends[at]);
    (start, end - start)
}

/// Density of a leaf from the units of its two intervals.
#[inline]
fn leaf_density<const B: usize>(first: f32, second: f32) -> f32 {
    first * second * ((B * B) as f32 / (UNITS * UNITS))
}

#[inline]
fn parts<const B: usize>(table: &[u16]) -> Option<(&[u16; B], &[[u16; B]])> {
    let (first, rest) = table.split_first_chunk::<B>()?;
    Some((first, rest.as_chunks::<B>().0))
}

/// Most rows that are sampled at once.
pub(super) const STAGE: usize = 64;

/// Turns uniform pairs into those of their tables, with their densities; where there is no table a row stays as it is.
/// All first numbers come before the second ones: what these wait for, memory, rows then wait for together.
pub(super) fn sample<const B: usize>(tables: &[Option<&[u16]>], u: &mut [[f32; 2]], q: &mut [f32]) {
    let mut first = [(0, 0.0); STAGE];
    for ((table, u), first) in tables.iter().zip(&mut *u).zip(&mut first) {
        if let Some((ends, _)) = table.and_then(parts::<B>) {
            let (i, y, units) = pick(ends, u[0]);
            u[0] = y / B as f32;
            *first = (i, units);
        }
    }
    for (((table, u), q), &(i, units0)) in tables.iter().zip(u).zip(q).zip(&first) {
        if let Some((_, second)) = table.and_then(parts::<B>) {
            let (_, y, units1) = pick(&second[i], u[1]);
            u[1] = y / B as f32;
            *q = leaf_density::<B>(units0, units1);
        }
    }
}

/// Densities of pairs, 0 outside the square; where there is no table that of the row stays.
pub(super) fn density<const B: usize>(tables: &[Option<&[u16]>], u: &[[f32; 2]], q: &mut [f32]) {
    for ((table, u), q) in tables.iter().zip(u).zip(q) {
        let Some((first, second)) = table.and_then(parts::<B>) else {
            continue;
        };
        let [i, j] = u.map(|u| bin(u, B));
        let (_, units0) = interval(first, i);
        let (_, units1) = interval(&second[i], j);
        let inside = u.iter().all(|u| (0.0..1.0).contains(u));
        *q = if inside {
            leaf_density::<B>(units0, units1)
        } else {
            0.0
        };
    }
}
