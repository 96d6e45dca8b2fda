//! Tables over the number that chooses an emitter: its density is constant on each emitter's interval.
//!
//! Emitter j has baseline probability p_j and, in a cell, the share M_j of ∫f². Shares are shrunk towards those
//! of the parent cell, at the root towards p; the emitter is then chosen in proportion to √(M_j p_j), the root of the
//! mean of f² on its interval. The number stays monotone: small numbers choose early emitters.
//! Neighbours of nearly the same density share an interval where there are many, so that a table stays small.

use super::square::{UNITS, below, is_sound, quantise};
use super::tree::{Leaves, Row};

/// Intervals of a table, at most.
const MOST_INTERVALS: usize = 64;

/// The emitters' intervals.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Line {
    /// Upper ends, increasing; the last is 1. Emitters that are never chosen have none.
    ends: Vec<f32>,
    pub(super) kappa: f64,
}

/// Tables one behind the other.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Lines {
    /// Number of intervals before each table, and in all.
    pub(super) starts: Vec<u32>,
    /// Upper ends of the intervals in the number.
    pub(super) ends: Vec<f32>,
    /// Lower ends of the numbers that choose them, in units of 2⁻¹⁶.
    pub(super) guided: Vec<u16>,
}

impl Line {
    /// From the emitters' cumulative probabilities, in order.
    pub(super) fn new(cdf: impl Iterator<Item = f32>, kappa: f64) -> Self {
        let (mut ends, mut last) = (Vec::new(), 0.0);
        for end in cdf {
            let end = end.min(1.0);
            if end > last {
                ends.push(end);
                last = end;
            }
        }
        match ends.last_mut() {
            Some(end) => *end = 1.0,
            None => ends.push(1.0),
        }
        Self { ends, kappa }
    }

    /// Emitters that may be chosen.
    pub(super) fn len(&self) -> usize {
        self.ends.len()
    }

    /// The interval that holds `u`.
    pub(super) fn leaf(&self, u: f32) -> u32 {
        let at = self.ends.partition_point(|&end| end <= u);
        at.min(self.ends.len() - 1) as u32
    }

    fn width(&self, i: usize) -> f64 {
        f64::from(self.ends[i])
            - if i > 0 {
                f64::from(self.ends[i - 1])
            } else {
                0.0
            }
    }

    /// Ends (exclusive) of runs of emitters that share an interval, and the runs' weights √(ΣM Σp). A run is
    /// closed where its weight exceeds the sum of its emitters' √(M p) by more than `loss`.
    fn runs(&self, shares: &[f32], loss: f64) -> Vec<(usize, f64)> {
        let mut runs = Vec::new();
        let (mut m, mut p, mut separate) = (0.0, 0.0, 0.0);
        for (i, &share) in shares.iter().enumerate() {
            let (share, width) = (f64::from(share), self.width(i));
            let joint: f64 = ((m + share) * (p + width)).sqrt();
            if i > 0 && joint - separate - (share * width).sqrt() > loss {
                runs.push((i, (m * p).sqrt()));
                (m, p, separate) = (0.0, 0.0, 0.0);
            }
            m += share;
            p += width;
            separate += (share * width).sqrt();
        }
        runs.push((shares.len(), (m * p).sqrt()));
        runs
    }
}

impl Leaves for Line {
    type Shares = Vec<f32>;
    type Tables = Lines;

    fn prior(&self) -> Vec<f32> {
        (0..self.len()).map(|i| self.width(i) as f32).collect()
    }

    fn update(&self, parent: &Vec<f32>, rows: &[Row]) -> Vec<f32> {
        let (mut sum, mut square) = (0.0f64, 0.0f64);
        let mut own = vec![0.0f64; self.len()];
        for row in rows {
            let w = f64::from(row.weight);
            own[row.bin as usize] += w;
            sum += w;
            square += w * w;
        }
        if sum <= 0.0 {
            return parent.clone();
        }
        let ess = sum * sum / square;
        let total = ess + self.kappa;
        let (seen, inherited) = (ess / (sum * total), self.kappa / total);
        own.iter()
            .zip(parent)
            .map(|(own, &p)| (seen * own + inherited * f64::from(p)) as f32)
            .collect()
    }

    fn tabulate(&self, shares: &Vec<f32>, tables: &mut Lines) {
        if tables.starts.is_empty() {
            tables.starts.push(0);
        }
        // Without loss, only emitters of exactly the same density share an interval.
        let mut loss = if self.len() <= MOST_INTERVALS {
            -1.0
        } else {
            1e-6
        };
        let mut runs = self.runs(shares, loss);
        while runs.len() > MOST_INTERVALS {
            loss *= 2.0;
            runs = self.runs(shares, loss);
        }
        tables
            .ends
            .extend(runs.iter().map(|&(end, _)| self.ends[end - 1]));
        let weights: Vec<f64> = runs.iter().map(|&(_, w)| w).collect();
        quantise(&weights, &mut tables.guided);
        tables.starts.push(tables.ends.len() as u32);
    }

    fn append(&self, tables: &mut Lines, more: Lines) {
        if tables.starts.is_empty() {
            *tables = more;
            return;
        }
        let before = tables.ends.len() as u32;
        tables
            .starts
            .extend(more.starts.iter().skip(1).map(|s| s + before));
        tables.ends.extend(more.ends);
        tables.guided.extend(more.guided);
    }

    fn bytes(&self) -> usize {
        let entry = size_of::<f32>() + size_of::<u16>();
        let most = self.len().min(MOST_INTERVALS) * entry + size_of::<u32>();
        if self.len() <= MOST_INTERVALS {
            return most;
        }
        // Fitting passes over all emitters for each cell: as if each were stored, so that many mean fewer cells.
        most.max(8 * self.len())
    }
}

impl Lines {
    /// Gives back what the lists have room for beyond their lengths.
    pub(super) fn shrink_to_fit(&mut self) {
        self.starts.shrink_to_fit();
        self.ends.shrink_to_fit();
        self.guided.shrink_to_fit();
    }

    /// Whether every table consists of intervals that are not empty.
    pub(super) fn is_sound(&self) -> bool {
        let ordered = self.starts.first().is_none_or(|&s| s == 0)
            && self.starts.is_sorted()
            && self.starts.last().map_or(0, |&s| s as usize) == self.ends.len()
            && self.ends.len() == self.guided.len();
        ordered
            && (0..self.starts.len().saturating_sub(1)).all(|cell| {
                self.table(cell).is_some_and(|(ends, guided)| {
                    ends.is_sorted_by(|a, b| a < b)
                        && ends.first().is_some_and(|&e| e > 0.0)
                        && ends.last() == Some(&1.0)
                        && is_sound(guided)
                })
            })
    }

    /// Intervals of a table: upper ends and what chooses them.
    #[inline]
    fn table(&self, cell: usize) -> Option<(&[f32], &[u16])> {
        let range = *self.starts.get(cell)? as usize..*self.starts.get(cell + 1)? as usize;
        Some((self.ends.get(range.clone())?, self.guided.get(range)?))
    }

    /// Turns a uniform number into one of the table; its density.
    #[inline]
    pub(super) fn sample(&self, cell: usize, u: &mut f32) -> f32 {
        let Some((ends, guided)) = self.table(cell) else {
            return 1.0;
        };
        let x = *u * UNITS;
        let whole = x as u16;
        let at = guided.partition_point(|&g| g <= whole).saturating_sub(1);
        let (start, units, from, to) = interval(ends, guided, at);
        *u = (from + (x - start) / units * (to - from)).clamp(from, below(to));
        interval_density(units, from, to)
    }

    /// Density of a number; 0 outside [0, 1).
    #[inline]
    pub(super) fn density(&self, cell: usize, u: f32) -> f32 {
        let Some((ends, guided)) = self.table(cell) else {
            return 1.0;
        };
        if !(0.0..1.0).contains(&u) {
            return 0.0;
        }
        let at = ends.partition_point(|&end| end <= u).min(ends.len() - 1);
        let (_, units, from, to) = interval(ends, guided, at);
        interval_density(units, from, to)
    }
}

/// Where interval `at` starts and how long it is, in units; and where it lies in the number.
#[inline]
fn interval(ends: &[f32], guided: &[u16], at: usize) -> (f32, f32, f32, f32) {
    let start = f32::from(guided[at]);
    let next = guided.get(at + 1).map_or(UNITS, |&g| f32::from(g));
    let from = if at > 0 { ends[at - 1] } else { 0.0 };
    (start, next - start, from, ends[at])
}

#[inline]
fn interval_density(units: f32, from: f32, to: f32) -> f32 {
    units / UNITS / (to - from)
}
