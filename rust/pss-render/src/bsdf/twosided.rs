//! One BSDF for each side of a surface; the back one sees mirrored directions.

use serde::Deserialize;

use super::{BsdfId, BsdfModel, BsdfSample, Builder, Materials, ShadingPoint};
use crate::error::SceneError;
use crate::math::{Rgb, Vec3};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    #[serde(default)]
    pub(super) id: String,
    front: BsdfId,
    back: BsdfId,
}

/// `twosided`
#[derive(Debug)]
pub struct TwoSided {
    sides: [BsdfId; 2],
}

const FLIP: Vec3 = Vec3::new(1.0, 1.0, -1.0);

impl TwoSided {
    pub(super) fn build(d: Description, b: Builder<'_>) -> Result<Self, SceneError> {
        Ok(Self {
            sides: [b.nested(d.front)?, b.nested(d.back)?],
        })
    }
}

impl BsdfModel for TwoSided {
    #[inline]
    fn sample(&self, at: ShadingPoint<'_>, wi: Vec3, u: [f32; 2]) -> Option<BsdfSample> {
        if wi.z > 0.0 {
            at.materials.bsdf(self.sides[0]).sample(at, wi, u)
        } else if wi.z < 0.0 {
            let mut s = at.materials.bsdf(self.sides[1]).sample(at, wi * FLIP, u)?;
            s.wo *= FLIP;
            Some(s)
        } else {
            None
        }
    }

    #[inline]
    fn eval_pdf(&self, at: ShadingPoint<'_>, wi: Vec3, wo: Vec3) -> (Rgb, f32) {
        if wi.z > 0.0 {
            at.materials.bsdf(self.sides[0]).eval_pdf(at, wi, wo)
        } else if wi.z < 0.0 {
            at.materials
                .bsdf(self.sides[1])
                .eval_pdf(at, wi * FLIP, wo * FLIP)
        } else {
            (Rgb::ZERO, 0.0)
        }
    }

    #[inline]
    fn delta_probability(&self, at: ShadingPoint<'_>, wi: Vec3) -> f32 {
        if wi.z > 0.0 {
            at.materials.bsdf(self.sides[0]).delta_probability(at, wi)
        } else {
            at.materials
                .bsdf(self.sides[1])
                .delta_probability(at, wi * FLIP)
        }
    }

    #[inline]
    fn sample_delta(&self, at: ShadingPoint<'_>, wi: Vec3, u: f32) -> Option<BsdfSample> {
        if wi.z > 0.0 {
            at.materials.bsdf(self.sides[0]).sample_delta(at, wi, u)
        } else {
            let back = at.materials.bsdf(self.sides[1]);
            let mut s = back.sample_delta(at, wi * FLIP, u)?;
            s.wo *= FLIP;
            Some(s)
        }
    }

    fn transmits(&self, m: &Materials) -> bool {
        self.sides.iter().any(|&s| m.bsdf(s).transmits(m))
    }

    fn two_sided(&self, _: &Materials) -> bool {
        true
    }

    fn smooth(&self, m: &Materials) -> bool {
        self.sides.iter().any(|&s| m.bsdf(s).smooth(m))
    }

    fn anisotropic(&self, m: &Materials) -> bool {
        self.sides.iter().any(|&s| m.bsdf(s).anisotropic(m))
    }

    fn delta(&self, m: &Materials) -> bool {
        self.sides.iter().any(|&s| m.bsdf(s).delta(m))
    }
}
