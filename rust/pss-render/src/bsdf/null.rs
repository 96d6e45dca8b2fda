//! An invisible surface. Passing it counts as a bounce, as in Mitsuba's `path`.

use serde::Deserialize;

use super::{BsdfModel, BsdfSample, Builder, Materials, ShadingPoint, delta_lobe};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
}

/// `null`
#[derive(Debug)]
pub struct Null;

impl Null {
    #[allow(clippy::unnecessary_wraps, clippy::needless_pass_by_value)] // the registry's signature
    pub(super) fn build(_: Description, _: Builder<'_>) -> Result<Self, SceneError> {
        Ok(Self)
    }
}

impl BsdfModel for Null {
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        self.sample_delta(at, wi, u[0])
    }

    fn eval_pdf(&self, _: ShadingPoint<'_>, _: Vec3, _: Vec3) -> (Rgb, f32) {
        (Rgb::ZERO, 0.0)
    }

    fn delta_probability(&self, _: ShadingPoint<'_>, _: Vec3) -> f32 {
        1.0
    }

    fn sample_delta(&self, _: ShadingPoint<'_>, wi: Vec3, _: f32) -> Option<BsdfSample> {
        delta_lobe(-wi, Rgb::ONE, 1.0)
    }

    fn smooth(&self, _: &Materials) -> bool {
        false
    }

    fn two_sided(&self, _: &Materials) -> bool {
        true
    }

    fn delta(&self, _: &Materials) -> bool {
        true
    }
}
