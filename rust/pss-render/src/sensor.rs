//! Cameras: from a film position, and where it has one a point of its lens, to a ray. A new one is a
//! variant here. The same rays as Mitsuba's cameras of the same names.

use embree4::Ray;
use glam::Affine3A;
use serde::Deserialize;

use crate::arrays::{check, check_all_finite};
use crate::error::SceneError;
use crate::film::Film;
use crate::math::Vec3;
use crate::warp::square_to_uniform_disk_concentric;

#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub(crate) enum Description {
    Orthographic(OrthographicDescription),
    Perspective(PerspectiveDescription),
    Thinlens(ThinlensDescription),
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct OrthographicDescription {
    to_world: [f32; 16],
    near_clip: f32,
    far_clip: f32,
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

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ThinlensDescription {
    to_world: [f32; 16],
    /// Degrees.
    x_fov: f32,
    near_clip: f32,
    far_clip: f32,
    aperture_radius: f32,
    focus_distance: f32,
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    Orthographic,
    Perspective,
    Thinlens {
        aperture_radius: f32,
        focus_distance: f32,
    },
}

/// `orthographic`: parallel rays; `perspective`: a pinhole; `thinlens`: sharp at one distance alone.
#[derive(Debug)]
pub struct Sensor {
    kind: Kind,
    to_world: Affine3A,
    /// Film position (pixels, within the crop) → slopes x/z and y/z in camera space; `orthographic`: x, y.
    scale: [f32; 2],
    offset: [f32; 2],
    near_clip: f32,
    far_clip: f32,
}

/// What all cameras share.
struct Parts {
    kind: Kind,
    to_world: [f32; 16],
    /// Half the film's width at z = 1.
    half_width: f32,
    near_clip: f32,
    far_clip: f32,
    principal_point_offset: [f32; 2],
}

impl Sensor {
    pub(crate) fn build(d: Description, film: &Film) -> Result<Self, SceneError> {
        let half_width = |x_fov: f32| -> Result<f32, SceneError> {
            let ok = x_fov > 0.0 && x_fov < 180.0;
            check(ok, "sensor", "x_fov", x_fov, "between 0 and 180 degrees")?;
            Ok((0.5 * x_fov.to_radians()).tan())
        };
        let positive = |name, value: f32| {
            let ok = value > 0.0 && value.is_finite();
            check(ok, "sensor", name, value, "positive and finite")
        };
        let parts = match d {
            Description::Orthographic(d) => Parts {
                kind: Kind::Orthographic,
                to_world: d.to_world,
                half_width: 1.0,
                near_clip: d.near_clip,
                far_clip: d.far_clip,
                principal_point_offset: [0.0; 2],
            },
            Description::Perspective(d) => Parts {
                kind: Kind::Perspective,
                to_world: d.to_world,
                half_width: half_width(d.x_fov)?,
                near_clip: d.near_clip,
                far_clip: d.far_clip,
                principal_point_offset: d.principal_point_offset,
            },
            Description::Thinlens(d) => {
                positive("aperture_radius", d.aperture_radius)?;
                positive("focus_distance", d.focus_distance)?;
                Parts {
                    kind: Kind::Thinlens {
                        aperture_radius: d.aperture_radius,
                        focus_distance: d.focus_distance,
                    },
                    to_world: d.to_world,
                    half_width: half_width(d.x_fov)?,
                    near_clip: d.near_clip,
                    far_clip: d.far_clip,
                    principal_point_offset: [0.0; 2],
                }
            }
        };
        Self::new(&parts, film)
    }

    fn new(parts: &Parts, film: &Film) -> Result<Self, SceneError> {
        let shift = parts.principal_point_offset;
        check_all_finite(&parts.to_world, "sensor", "to_world")?;
        check_all_finite(&shift, "sensor", "principal_point_offset")?;
        check(
            parts.near_clip > 0.0 && parts.near_clip < parts.far_clip,
            "sensor",
            "near_clip",
            parts.near_clip,
            "positive and below far_clip",
        )?;
        let m = parts.to_world;
        let to_world = Affine3A::from_mat3_translation(
            glam::Mat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]),
            glam::Vec3::new(m[3], m[7], m[11]),
        );
        // From + at the left edge of the *whole* film to − at the right.
        let tan = parts.half_width;
        let [width, height] = film.size().map(|n| n as f32);
        let aspect = width / height;
        let slope = |pixels: f32, crop: f32, shift: f32, tan: f32| {
            (
                -2.0 * tan / pixels,
                tan * (1.0 - 2.0 * (crop / pixels + shift)),
            )
        };
        let [ox, oy] = film.crop_offset().map(|n| n as f32);
        let (sx, tx) = slope(width, ox, shift[0], tan);
        let (sy, ty) = slope(height, oy, shift[1], tan / aspect);
        Ok(Self {
            kind: parts.kind,
            to_world,
            scale: [sx, sy],
            offset: [tx, ty],
            near_clip: parts.near_clip,
            far_clip: parts.far_clip,
        })
    }

    /// Whether rays hang on a point of the lens too, so that a path needs two more numbers.
    pub fn has_lens(&self) -> bool {
        matches!(self.kind, Kind::Thinlens { .. })
    }

    /// The ray through a film position in pixels, counted from the crop's corner. `lens`: two numbers in
    /// [0, 1) for the point of the lens, (½, ½) for its centre; without a lens they do not matter.
    #[inline]
    pub fn ray(&self, position: [f32; 2], lens: [f32; 2]) -> Ray {
        let x = position[0] * self.scale[0] + self.offset[0];
        let y = position[1] * self.scale[1] + self.offset[1];
        let (local, start) = match self.kind {
            Kind::Perspective => (Vec3::new(x, y, 1.0).normalize(), self.to_world.translation),
            Kind::Thinlens {
                aperture_radius,
                focus_distance,
            } => {
                let p = square_to_uniform_disk_concentric(lens) * aperture_radius;
                let p = Vec3::new(p.x, p.y, 0.0);
                let local = (Vec3::new(x, y, 1.0) * focus_distance - p).normalize();
                (local, self.to_world.transform_point3a(p))
            }
            Kind::Orthographic => {
                let origin = self
                    .to_world
                    .transform_point3a(Vec3::new(x, y, self.near_clip));
                let d = self.to_world.matrix3.z_axis.normalize();
                let length = self.far_clip - self.near_clip;
                return Ray::new(origin.to_array(), d.to_array()).until(length);
            }
        };
        let d = self.to_world.transform_vector3a(local);
        let (near, far) = (self.near_clip / local.z, self.far_clip / local.z);
        Ray::new((start + d * near).to_array(), d.to_array()).until(far - near)
    }
}
