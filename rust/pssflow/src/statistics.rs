//! What a render counted.

use pss_render::math::{Rgb, luminance};
use serde::Serialize;

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

/// Counts and weights of a set of paths.
#[derive(Clone, Copy, Debug, Default)]
pub struct Statistics {
    /// Counts.
    pub counts: Counts,
    /// Largest 1/m of a path that carries light.
    pub max_weight: f32,
    /// Largest luminance of f/m.
    pub max_estimate: f32,
    /// Σ lum(f/m)
    pub sum: f64,
    /// Σ lum(f/m)²
    pub sum_2: f64,
}

impl Statistics {
    /// Adds one path that carries light.
    pub(crate) fn add_estimate(&mut self, estimate: Rgb, weight: f32) {
        let y = luminance(estimate);
        self.counts.nonzero += 1;
        self.max_weight = self.max_weight.max(weight);
        self.max_estimate = self.max_estimate.max(y);
        self.sum += f64::from(y);
        self.sum_2 += f64::from(y) * f64::from(y);
    }

    /// Adds another set.
    pub(crate) fn add(&mut self, other: &Self) {
        self.counts.add(&other.counts);
        self.max_weight = self.max_weight.max(other.max_weight);
        self.max_estimate = self.max_estimate.max(other.max_estimate);
        self.sum += other.sum;
        self.sum_2 += other.sum_2;
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
