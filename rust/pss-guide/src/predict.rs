//! What a guide would gain, predicted from paths that it was not fitted to and that cost nothing more.
//!
//! With m = a + (1 − a)·q, the variance of a pixel's estimate is ∫f²/m − I². The integral is estimated from paths
//! drawn with density g, f²/(m·g), tile by tile of the image, and relative to the tile's mean as in relMSE:
//!
//! V(a) = Σ over tiles of [mean f²/(m·g) − Ī²] ÷ (Ī² + ε),  ε = (0.1 · mean of Ī)²,  gain(a) = V(1)/(V(a) + its standard
//! error): the best of many candidates is else the one that chance favours.
//!
//! The spread between the pixels of a tile counts as noise that no guide removes, which makes gains conservative. Of the
//! two terms of f each is divided by the density of its own numbers, m_nee and m_bsdf, while the density of all numbers
//! is m: f_nee²/m_nee + f_bsdf²/m_bsdf + 2 f_nee f_bsdf · m/(m_nee m_bsdf).

use crate::{Decision, Guide, Records};

/// Most tiles along an axis.
const SIDE: usize = 16;

/// Paths that a tile shall hold on average.
const PATHS_PER_TILE: f64 = 64.0;

/// No gain is believed beyond this: where V(a) is as small, it drowns in its own error.
const MOST_GAIN: f64 = 1000.0;

/// A guide's densities of some paths' numbers.
#[derive(Clone, Debug)]
pub(crate) struct Densities {
    /// Of the numbers that f_nee uses.
    pub(crate) nee: Vec<f32>,
    /// Of those that the BSDF-sampled term uses.
    pub(crate) bsdf: Vec<f32>,
    /// Of all.
    pub(crate) both: Vec<f32>,
}

impl Densities {
    /// Of a guide at each of the paths.
    pub(crate) fn of(guide: &dyn Guide, records: &Records<'_>) -> Self {
        let one = Self::one(records.f.len());
        guide
            .models()
            .iter()
            .fold(one, |q, &decision| q.with(guide, decision, records))
    }

    /// Of uniform numbers.
    pub(crate) fn one(rows: usize) -> Self {
        let one = vec![1.0; rows];
        Self {
            nee: one.clone(),
            bsdf: one.clone(),
            both: one,
        }
    }

    /// With the guide's density of one more decision.
    fn with(mut self, guide: &dyn Guide, decision: Decision, records: &Records<'_>) -> Self {
        let mut own = vec![1.0; records.f.len()];
        records.multiply_density(guide, decision, &mut own);
        multiply(&mut self.both, &own);
        if decision != Decision::Ray {
            multiply(&mut self.nee, &own);
        }
        if !matches!(decision, Decision::Emitter | Decision::Light) {
            multiply(&mut self.bsdf, &own);
        }
        self
    }

    /// Of the product with another guide that models other numbers.
    pub(crate) fn times(mut self, other: &Self) -> Self {
        multiply(&mut self.nee, &other.nee);
        multiply(&mut self.bsdf, &other.bsdf);
        multiply(&mut self.both, &other.both);
        self
    }
}

fn multiply(a: &mut [f32], b: &[f32]) {
    a.iter_mut().zip(b).for_each(|(a, b)| *a *= b);
}

/// Held-out paths, ready for predictions.
#[derive(Debug)]
pub(crate) struct HeldOut<'a> {
    records: Records<'a>,
    side: usize,
    /// Paths of a tile.
    each: f64,
    /// By tile: Ī.
    means: Vec<f64>,
    /// By tile: 1 ÷ (paths · (Ī² + ε)), 0 for tiles without light.
    scale: Vec<f64>,
    /// Σ over tiles of an unbiased estimate of I² ÷ (Ī² + ε).
    square: f64,
    /// V(1).
    uniform: f64,
}

impl<'a> HeldOut<'a> {
    /// `None` where no path carries light, or where uniform numbers have no variance to win.
    pub(crate) fn new(records: Records<'a>) -> Option<Self> {
        let paths = records.paths();
        let side = ((paths / PATHS_PER_TILE).sqrt() as usize).clamp(1, SIDE);
        let mut held = Self {
            records,
            side,
            each: paths / (side * side) as f64,
            means: Vec::new(),
            scale: vec![0.0; side * side],
            square: 0.0,
            uniform: 0.0,
        };
        let each = held.each;
        let (mut means, mut squares) = (vec![0.0; side * side], vec![0.0; side * side]);
        for row in held.rows() {
            let share = held.records.terms(row).value() / each;
            means[held.tile(row)] += share;
            squares[held.tile(row)] += share * share;
        }
        let mean = means.iter().sum::<f64>() / means.len() as f64;
        let epsilon = (0.1 * mean).powi(2);
        if !(mean > 0.0 && mean.is_finite()) {
            return None;
        }
        // The square of a mean of n paths is too large by a share 1/n of their variance, and a large gain is what is left
        // of V after it: products of different paths alone are unbiased.
        let pairs = each / (each - 1.0).max(1.0);
        for ((scale, mean), own) in held.scale.iter_mut().zip(&means).zip(&squares) {
            let size = mean * mean + epsilon;
            *scale = 1.0 / (each * size);
            held.square += pairs * (mean * mean - own) / size;
        }
        held.means = means;
        let one = Densities::one(held.records.f.len());
        held.uniform = held.variance(&one, 1.0).0;
        // Below that, what looks like variance is rounding.
        (held.uniform > 1e-6 * held.square.abs()).then_some(held)
    }

    /// The paths.
    pub(crate) fn records(&self) -> &Records<'a> {
        &self.records
    }

    /// What a row's ∫f²/m counts in V, but for a factor that all rows share.
    pub(crate) fn weight(&self, row: usize) -> f64 {
        self.scale[self.tile(row)]
    }

    /// gain(a) of the mixture with a guide of these densities.
    pub(crate) fn gain(&self, q: &Densities, a: f32) -> f64 {
        let least = self.uniform / MOST_GAIN;
        let (variance, error) = self.variance(q, a);
        self.uniform / (variance + error).max(least)
    }

    /// V(a), and its standard error: the spread of what each path, also one without light, changes in the sum and in the
    /// square of its tile's mean.
    fn variance(&self, q: &Densities, a: f32) -> (f64, f64) {
        let a = f64::from(a);
        let mixture = |q: f32| {
            if a >= 1.0 {
                1.0
            } else {
                a + (1.0 - a) * f64::from(q)
            }
        };
        let (mut sum, mut squares) = (0.0, 0.0);
        let mut changes = vec![0.0; self.scale.len()];
        for row in self.rows() {
            let terms = self.records.terms(row);
            let [nee, bsdf, both] = [&q.nee, &q.bsdf, &q.both].map(|q| mixture(q[row]));
            // Where densities are infinite nothing is left of either term: `max` makes 0 of ∞/∞.
            let product = terms.product() * (both / (nee * bsdf)).max(0.0);
            let value = terms.nee_square() / nee + terms.bsdf_square() / bsdf + product;
            let tile = self.tile(row);
            sum += value * self.scale[tile];
            let change = (value - 2.0 * self.means[tile] * terms.value()) * self.scale[tile];
            squares += change * change;
            changes[tile] += change;
        }
        let known = changes.iter().map(|c| c * c).sum::<f64>() / self.each;
        (sum - self.square, (squares - known).max(0.0).sqrt())
    }

    fn rows(&self) -> impl Iterator<Item = usize> + use<'a> {
        let records = self.records;
        (0..records.f.len()).filter(move |&row| records.is_sound(row))
    }

    fn tile(&self, row: usize) -> usize {
        let Some(&[x, y]) = self.records.pixel.get(row) else {
            return 0;
        };
        let at = |x: f32| ((x * self.side as f32) as usize).min(self.side - 1);
        at(y) * self.side + at(x)
    }
}
