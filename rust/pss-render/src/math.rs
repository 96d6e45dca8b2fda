//! Vectors, colours and tangent frames.

/// Texture coordinates, or a place on a film.
pub type Vec2 = glam::Vec2;

/// A point or direction in world or local space.
pub type Vec3 = glam::Vec3A;

/// A colour or radiance: linear sRGB primaries.
pub type Rgb = glam::Vec3A;

/// Mitsuba's `RayEpsilon` for single precision: 1500 × 2⁻²⁴.
pub const RAY_EPSILON: f32 = 1500.0 * f32::EPSILON * 0.5;

/// Mitsuba's `ShadowEpsilon`: ten times [`RAY_EPSILON`].
pub const SHADOW_EPSILON: f32 = 10.0 * RAY_EPSILON;

/// Luminance of linear sRGB (Rec. 709 weights, as Mitsuba's).
#[inline]
pub fn luminance(c: Rgb) -> f32 {
    c.dot(Vec3::new(0.212_671, 0.715_160, 0.072_169))
}

/// An orthonormal basis; `n` is the local z axis.
#[derive(Clone, Copy, Debug, Default)]
pub struct Frame {
    /// Tangent, local x.
    pub s: Vec3,
    /// Bitangent, local y.
    pub t: Vec3,
    /// Normal, local z.
    pub n: Vec3,
}

impl Frame {
    /// The frame that depends on the unit normal `n` alone.
    ///
    /// The tangent is a fixed world axis, projected: the axis that follows the normal's dominant one
    /// (x → y → z → x). So all points of one wall, and nearly all of a smooth surface, measure a
    /// direction's numbers against the same axis, and a guide that pools neighbours sees one density.
    /// The sign of the dominant component does not matter, hence no flip on axis-aligned walls.
    #[inline]
    pub fn from_normal(n: Vec3) -> Self {
        let a = n.abs();
        let axis = if a.x >= a.y && a.x >= a.z {
            Vec3::Y
        } else if a.y >= a.z {
            Vec3::Z
        } else {
            Vec3::X
        };
        Self::from_tangent(n, axis)
    }

    /// The frame whose tangent is `tangent`, made orthogonal to the unit normal `n`; an arbitrary
    /// one where the two are parallel or the tangent is zero.
    #[inline]
    pub fn from_tangent(n: Vec3, tangent: Vec3) -> Self {
        let s = tangent - n * n.dot(tangent);
        let length_2 = s.length_squared();
        if length_2 > 1e-12 * tangent.length_squared() {
            let s = s / length_2.sqrt();
            Self {
                s,
                t: n.cross(s),
                n,
            }
        } else {
            let s = n.any_orthonormal_vector();
            Self {
                s,
                t: n.cross(s),
                n,
            }
        }
    }

    /// World direction → local.
    #[inline]
    pub fn to_local(&self, v: Vec3) -> Vec3 {
        Vec3::new(v.dot(self.s), v.dot(self.t), v.dot(self.n))
    }

    /// Local direction → world.
    #[inline]
    pub fn to_world(&self, v: Vec3) -> Vec3 {
        self.s * v.x + self.t * v.y + self.n * v.z
    }
}

/// Two unit vectors that make an orthonormal basis with the unit vector `n` (Duff et al. 2017, *Building an Orthonormal
/// Basis, Revisited*): Mitsuba's `coordinate_system`, its tangents where texture coordinates give none.
#[inline]
pub fn coordinate_system(n: Vec3) -> (Vec3, Vec3) {
    let sign = 1f32.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    (
        Vec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x),
        Vec3::new(b, sign + n.y * n.y * a, -n.y),
    )
}

/// Mirrors `wi` about the microfacet normal `m`.
#[inline]
pub fn reflect(wi: Vec3, m: Vec3) -> Vec3 {
    m * (2.0 * wi.dot(m)) - wi
}

/// `sqrt` that takes a slightly negative argument for zero.
#[inline]
pub fn safe_sqrt(x: f32) -> f32 {
    x.max(0.0).sqrt()
}

/// Nodes and weights of the n-point Gauss–Legendre rule on [−1, 1] (Newton's method on Pₙ).
pub fn gauss_legendre(n: usize) -> Vec<(f64, f64)> {
    (0..n)
        .map(|i| {
            let mut x = (std::f64::consts::PI * (i as f64 + 0.75) / (n as f64 + 0.5)).cos();
            let mut derivative = 1.0;
            for _ in 0..100 {
                let (mut p0, mut p1) = (1.0, x);
                for k in 2..=n {
                    let k = k as f64;
                    (p0, p1) = (p1, ((2.0 * k - 1.0) * x * p1 - (k - 1.0) * p0) / k);
                }
                derivative = n as f64 * (x * p1 - p0) / (x * x - 1.0);
                let step = p1 / derivative;
                x -= step;
                if step.abs() < 1e-15 {
                    break;
                }
            }
            (x, 2.0 / ((1.0 - x * x) * derivative * derivative))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_orthonormal_and_right_handed() {
        let mut numbers = pss_rng::Stream::new(3, pss_rng::Purpose::Test).sequence(0, 0);
        for _ in 0..1000 {
            let n = Vec3::new(
                numbers.next_normal() as f32,
                numbers.next_normal() as f32,
                numbers.next_normal() as f32,
            )
            .normalize();
            let f = Frame::from_normal(n);
            assert!(f.s.dot(f.t).abs() < 1e-6 && f.s.dot(n).abs() < 1e-6);
            assert!((f.s.cross(f.t) - n).length() < 1e-5);
            assert!((f.to_world(f.to_local(Vec3::ONE)) - Vec3::ONE).length() < 1e-5);
        }
    }

    #[test]
    fn opposite_walls_share_their_tangent() {
        for axis in [Vec3::X, Vec3::Y, Vec3::Z] {
            assert_eq!(Frame::from_normal(axis).s, Frame::from_normal(-axis).s);
        }
    }

    #[test]
    fn gauss_legendre_integrates_polynomials() {
        let rule = gauss_legendre(32);
        let even: f64 = rule.iter().map(|(x, w)| w * x.powi(10)).sum();
        assert!((even - 2.0 / 11.0).abs() < 1e-13);
        let total: f64 = rule.iter().map(|(_, w)| w).sum();
        assert!((total - 2.0).abs() < 1e-13);
    }
}
