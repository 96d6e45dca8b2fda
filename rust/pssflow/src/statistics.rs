//! What a render counted.

use pss_render::math::{Rgb, luminance};
use serde::Serialize;

use crate::tail::Tail;

/// Paths of one kind: the pilot's, or those rendered after it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Counts {
    /// Paths started.
    pub camera_rays: u64,
    /// Paths whose vertices x₁ … x_k all exist.
    pub paths_found: u64,
    /// Paths that carry light.
    pub nonzero: u64,
    /// Guided paths whose numbers fell outside the cube: camera rays, but not paths found.
    pub outside: u64,
    /// Paths whose contribution was not finite: counted as zero.
    pub non_finite: u64,
}

impl Counts {
    /// nonzero ÷ paths_found; 0 where none was found.
    pub fn nonzero_share(&self) -> f64 {
        self.nonzero as f64 / (self.paths_found as f64).max(1.0)
    }

    /// nonzero ÷ camera_rays; 0 where there were none.
    pub(crate) fn lit_share(&self) -> f64 {
        self.nonzero as f64 / (self.camera_rays as f64).max(1.0)
    }

    /// Adds another count.
    pub fn add(&mut self, other: &Self) {
        self.camera_rays += other.camera_rays;
        self.paths_found += other.paths_found;
        self.nonzero += other.nonzero;
        self.outside += other.outside;
        self.non_finite += other.non_finite;
    }
}

/// A sum over paths and the sum of its squares; zeros count in `paths` alone.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Moments {
    /// Paths, those without light included.
    pub paths: u64,
    /// Σx
    pub sum: f64,
    /// Σx²
    pub sum_2: f64,
}

impl Moments {
    #[inline]
    pub(crate) fn add_value(&mut self, x: f64) {
        self.sum += x;
        self.sum_2 += x * x;
    }

    pub(crate) fn add(&mut self, other: &Self) {
        self.paths += other.paths;
        self.sum += other.sum;
        self.sum_2 += other.sum_2;
    }

    /// Mean over paths; 0 where there are none.
    pub fn mean(&self) -> f64 {
        self.sum / (self.paths as f64).max(1.0)
    }

    /// Mean of squares over paths; 0 where there are none.
    pub fn mean_square(&self) -> f64 {
        self.sum_2 / (self.paths as f64).max(1.0)
    }

    /// Variance of the mean, as far as the paths tell.
    pub fn variance_of_mean(&self) -> f64 {
        let (n, mean) = ((self.paths as f64).max(1.0), self.mean());
        (self.sum_2 / n - mean * mean).max(0.0) / n
    }
}

/// Counts and weights of a set of paths.
#[derive(Clone, Debug, Default)]
pub struct Statistics {
    /// Counts.
    pub counts: Counts,
    /// Paths whose coin fell on the guide.
    pub guided: u64,
    /// Σ 1/m over all paths whose numbers lie in the cube, with or without light: 1 a path on average where the guide's
    /// densities are right and m > 0 everywhere.
    pub weights: f64,
    /// f²/m of a guided pass by its uniform paths, and by its guided ones (divided by q, too).
    pub squares: [Moments; 2],
    /// The largest lum(f/m).
    pub tail: Tail,
    /// Of a pass: whether memory for the paths to learn from ran out, so that fewer were kept.
    pub short_of_memory: bool,
    /// Largest 1/m of a path that carries light.
    pub max_weight: f32,
    /// Largest luminance of f/m.
    pub max_estimate: f32,
    /// Σ lum(f/m)
    pub sum: f64,
    /// Σ lum(f/m)²
    pub sum_2: f64,
    /// Of `Mixture::rarity` r: Σr, Σr², Σ r·lum(f/m).
    pub rarity: [f64; 3],
}

impl Statistics {
    /// Adds one path that carries light.
    pub(crate) fn add_estimate(&mut self, estimate: Rgb, weight: f32, rarity: f64) {
        let y = luminance(estimate);
        self.counts.nonzero += 1;
        self.tail.add(y);
        self.max_weight = self.max_weight.max(weight);
        self.max_estimate = self.max_estimate.max(y);
        self.sum += f64::from(y);
        self.sum_2 += f64::from(y) * f64::from(y);
        let terms = [rarity, rarity * rarity, rarity * f64::from(y)];
        self.rarity.iter_mut().zip(terms).for_each(|(s, t)| *s += t);
    }

    /// Adds another set.
    pub(crate) fn add(&mut self, other: &Self) {
        self.counts.add(&other.counts);
        self.guided += other.guided;
        self.weights += other.weights;
        for (own, other) in self.squares.iter_mut().zip(&other.squares) {
            own.add(other);
        }
        self.tail.merge(&other.tail);
        self.max_weight = self.max_weight.max(other.max_weight);
        self.max_estimate = self.max_estimate.max(other.max_estimate);
        self.sum += other.sum;
        self.sum_2 += other.sum_2;
        self.rarity
            .iter_mut()
            .zip(other.rarity)
            .for_each(|(s, t)| *s += t);
    }

    /// Mean 1/m of the light and its standard error, as that of a ratio; `None` where there is no light.
    pub fn light_weight(&self) -> Option<(f64, f64)> {
        let [r, r_2, cross] = self.rarity;
        let weight = r / self.sum;
        let spread = r_2 - weight * (2.0 * cross - weight * self.sum_2);
        (self.sum > 0.0).then(|| (weight, spread.max(0.0).sqrt() / self.sum))
    }

    /// Mean 1/m over all paths.
    pub fn mean_weight(&self) -> f64 {
        self.weights / (self.counts.camera_rays as f64).max(1.0)
    }

    /// Lum(f/m) as a sum over all paths.
    pub fn estimates(&self) -> Moments {
        Moments {
            paths: self.counts.camera_rays,
            sum: self.sum,
            sum_2: self.sum_2,
        }
    }

    /// Kish's effective sample size of the contributions, (Σc)² ÷ Σc².
    pub fn ess(&self) -> f64 {
        if self.sum_2 > 0.0 {
            self.sum * self.sum / self.sum_2
        } else {
            0.0
        }
    }

    /// Largest contribution over the mean one of all camera rays.
    pub fn max_contribution(&self) -> f64 {
        if self.sum > 0.0 {
            f64::from(self.max_estimate) * self.counts.camera_rays as f64 / self.sum
        } else {
            0.0
        }
    }
}
