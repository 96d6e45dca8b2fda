//! Cameras: from a film position to a ray. A new one is a variant here.

use embree4::Ray;
use glam::Affine3A;
use serde::Deserialize;

use crate::arrays::{check, check_all_finite};
use crate::error::SceneError;
use crate::film::Film;
use crate::math::Vec3;

#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub(crate) enum Description {
    Perspective(PerspectiveDescription),
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PerspectiveDescription {
    to_world: [f32; 16],
    /// Degrees.
    x_fov: f32,
    near_clip: f32,
    far_clip: f32,
    principal_point_offset: [f32; 2],
}

/// `perspective`: a pinhole.
#[derive(Debug)]
pub struct Sensor {
    to_world: Affine3A,
    /// Film position (pixels, within the crop) → slopes x/z and y/z in camera space.
    scale: [f32; 2],
    offset: [f32; 2],
    near_clip: f32,
    far_clip: f32,
}

impl Sensor {
    pub(crate) fn build(d: Description, film: &Film) -> Result<Self, SceneError> {
        let Description::Perspective(d) = d;
        check_all_finite(&d.to_world, "sensor", "to_world")?;
        check_all_finite(
            &d.principal_point_offset,
            "sensor",
            "principal_point_offset",
        )?;
        check(
            d.x_fov > 0.0 && d.x_fov < 180.0,
            "sensor",
            "x_fov",
            d.x_fov,
            "between 0 and 180 degrees",
        )?;
        check(
            d.near_clip > 0.0 && d.near_clip < d.far_clip,
            "sensor",
            "near_clip",
            d.near_clip,
            "positive and below far_clip",
        )?;
        let m = d.to_world;
        let to_world = Affine3A::from_mat3_translation(
            glam::Mat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]),
            glam::Vec3::new(m[3], m[7], m[11]),
        );
        // Slopes run from +tan(fov/2) at the left edge of the *whole* film to −tan(fov/2) at the right.
        let tan = (0.5 * d.x_fov.to_radians()).tan();
        let [width, height] = film.size().map(|n| n as f32);
        let aspect = width / height;
        let slope = |pixels: f32, crop: f32, shift: f32, tan: f32| {
            (
                -2.0 * tan / pixels,
                tan * (1.0 - 2.0 * (crop / pixels + shift)),
            )
        };
        let [ox, oy] = film.crop_offset().map(|n| n as f32);
        let [px, py] = d.principal_point_offset;
        let (sx, tx) = slope(width, ox, px, tan);
        let (sy, ty) = slope(height, oy, py, tan / aspect);
        Ok(Self {
            to_world,
            scale: [sx, sy],
            offset: [tx, ty],
            near_clip: d.near_clip,
            far_clip: d.far_clip,
        })
    }

    /// The ray through a film position in pixels, counted from the crop's corner.
    #[inline]
    pub fn ray(&self, position: [f32; 2]) -> Ray {
        let local = Vec3::new(
            position[0] * self.scale[0] + self.offset[0],
            position[1] * self.scale[1] + self.offset[1],
            1.0,
        )
        .normalize();
        let d = self.to_world.transform_vector3a(local);
        let (near, far) = (self.near_clip / local.z, self.far_clip / local.z);
        let origin = self.to_world.translation + d * near;
        Ray::new(origin.to_array(), d.to_array()).until(far - near)
    }
}
