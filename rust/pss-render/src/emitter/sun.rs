//! A round light at infinity, as the sun of Mitsuba's `sunsky`.

use std::f32::consts::TAU;

use serde::Deserialize;

use super::{Builder, EmitterModel, EmitterSample, one};
use crate::arrays::{check, check_all_finite};
use crate::error::SceneError;
use crate::interaction::Interaction;
use crate::math::{Frame, Rgb, Vec3};
use crate::scene::Scene;
use crate::warp::square_to_uniform_disk_concentric;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Description {
    pub(super) id: String,
    /// Towards its centre.
    direction: [f32; 3],
    /// Towards the zenith: what lies below the horizon is dark.
    up: [f32; 3],
    /// Radians from the centre to the rim.
    half_angle: f32,
    /// From the centre to the rim, evenly spaced in angle; at least one.
    radiance: Vec<[f32; 3]>,
    #[serde(default = "one")]
    pub(super) sampling_weight: f32,
}

/// `sun`
#[derive(Debug)]
pub struct Sun {
    frame: Frame,
    up: Vec3,
    /// 1 − cos of the half angle.
    height: f32,
    /// Of the unit directions' difference, between centre and rim.
    chord: f32,
    radiance: Vec<Rgb>,
    pdf: f32,
}

impl Sun {
    pub(super) fn build(d: Description, _b: Builder<'_>) -> Result<Self, SceneError> {
        let owner = format!("emitter {:?}", d.id);
        let unit = |v: [f32; 3], name: &'static str| {
            check_all_finite(&v, &owner, name)?;
            let length = Vec3::from_array(v).length();
            check(length > 0.0, &owner, name, length, "longer than 0")?;
            Ok::<_, SceneError>(Vec3::from_array(v) / length)
        };
        check_all_finite(d.radiance.as_flattened(), &owner, "radiance")?;
        let entries = d.radiance.len();
        check(
            entries > 0,
            &owner,
            "radiance",
            entries as f32,
            "one colour or more",
        )?;
        check(
            d.half_angle > 0.0 && d.half_angle < 1.5,
            &owner,
            "half_angle",
            d.half_angle,
            "above 0 and below 1.5 radians",
        )?;
        // The cosine itself would round a small sun's size away.
        let sine = (0.5 * d.half_angle).sin();
        let height = 2.0 * sine * sine;
        Ok(Self {
            frame: Frame::from_normal(unit(d.direction, "direction")?),
            up: unit(d.up, "up")?,
            height,
            chord: 2.0 * sine,
            radiance: d.radiance.into_iter().map(Rgb::from_array).collect(),
            pdf: 1.0 / (TAU * height),
        })
    }

    /// At a share `r` of the way from the centre to the rim.
    fn radiance(&self, d: Vec3, r: f32) -> Rgb {
        if d.dot(self.up) < 0.0 {
            return Rgb::ZERO;
        }
        let last = self.radiance.len() - 1;
        let x = r.clamp(0.0, 1.0) * last as f32;
        let i = x as usize;
        self.radiance[i].lerp(self.radiance[(i + 1).min(last)], x - i as f32)
    }

    /// Share of the way from the centre to the rim; above 1 outside.
    fn share(&self, d: Vec3) -> f32 {
        (d - self.frame.n).length() / self.chord
    }
}

impl EmitterModel for Sun {
    fn sample_direction(
        &self,
        _scene: &Scene,
        _reference: Vec3,
        u: [f32; 2],
    ) -> Option<EmitterSample> {
        let p = square_to_uniform_disk_concentric(u);
        let r_2 = p.length_squared();
        // 1 − cos θ is uniform; (sin θ / r) · p lies in the plane across.
        let drop = r_2 * self.height;
        let across = p * (self.height * (2.0 - drop)).sqrt();
        let d = self
            .frame
            .to_world(Vec3::new(across.x, across.y, 1.0 - drop));
        Some(EmitterSample {
            d,
            target: None,
            radiance: self.radiance(d, r_2.sqrt()),
            pdf: self.pdf,
            delta: false,
        })
    }

    fn pdf_direction(
        &self,
        _scene: &Scene,
        _reference: Vec3,
        d: Vec3,
        _surface: Option<&Interaction>,
    ) -> f32 {
        if self.share(d) <= 1.0 { self.pdf } else { 0.0 }
    }

    fn eval(&self, _scene: &Scene, d: Vec3, _surface: Option<&Interaction>) -> Rgb {
        let r = self.share(d);
        if r <= 1.0 {
            self.radiance(d, r)
        } else {
            Rgb::ZERO
        }
    }

    fn is_environment(&self) -> bool {
        true
    }
}
