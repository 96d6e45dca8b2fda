//! Exact curved shapes as Embree user geometry: sphere, disk, cylinder, as Mitsuba defines them.
//!
//! Rays are taken to the shape's own space and solved there in double precision, because in single
//! precision a distant small sphere loses its rim. Which root counts: the smallest `t ∈ [tnear, tfar]` whose
//! point lies on the (finite) shape.

use std::ffi::c_void;

use crate::EmbreeError;
use crate::ffi::{self, RtcBoundsFunctionArguments, RtcQueryFunctionNArguments};

/// Coordinates beyond this are refused, for Embree would drop them silently.
pub(crate) const LARGEST: f32 = 1e18;

/// A curved shape. Matrices are 3×4, row-major, object → world; they may scale, shear and reflect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Quadric {
    /// |p − center| = radius, in world space.
    Sphere {
        /// Centre, world space.
        center: [f32; 3],
        /// Radius, > 0.
        radius: f32,
    },
    /// x² + y² ≤ 1 in the plane z = 0 of the shape's own space; its normal is +z.
    Disk {
        /// Shape → world.
        to_world: [f32; 12],
    },
    /// x² + y² = 1, 0 ≤ z ≤ 1 in the shape's own space, without caps; its normal points away from the axis.
    Cylinder {
        /// Shape → world.
        to_world: [f32; 12],
    },
}

/// An affine map in double precision: `rows[i] · (x, y, z, 1)`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Affine([[f64; 4]; 3]);

impl Affine {
    pub(crate) fn from_rows(m: &[f32; 12]) -> Self {
        let row = |i: usize| [m[4 * i], m[4 * i + 1], m[4 * i + 2], m[4 * i + 3]].map(f64::from);
        Self([row(0), row(1), row(2)])
    }

    /// A checked object-to-world map and its inverse.
    pub(crate) fn invertible(
        shape: &'static str,
        matrix: &[f32; 12],
    ) -> Result<(Self, Self), EmbreeError> {
        let refused = EmbreeError::Transform {
            shape,
            matrix: *matrix,
        };
        if !matrix.iter().all(|x| x.abs() <= LARGEST) {
            return Err(refused);
        }
        let map = Self::from_rows(matrix);
        let inverse = map.inverse().ok_or(refused)?;
        Ok((map, inverse))
    }

    /// `None` where the columns span no volume worth the name.
    fn inverse(&self) -> Option<Self> {
        let [a, b, c] = self.columns();
        let (bc, ca, ab) = (cross(b, c), cross(c, a), cross(a, b));
        let det = dot(a, bc);
        let size = (dot(a, a) * dot(b, b) * dot(c, c)).sqrt();
        if det.abs() <= 1e-10 * size {
            return None;
        }
        let origin = [self.0[0][3], self.0[1][3], self.0[2][3]];
        let row = |n: [f64; 3]| {
            let n = n.map(|x| x / det);
            [n[0], n[1], n[2], -dot(n, origin)]
        };
        let inverse = Self([row(bc), row(ca), row(ab)]);
        inverse
            .0
            .as_flattened()
            .iter()
            .all(|x| x.is_finite())
            .then_some(inverse)
    }

    fn columns(&self) -> [[f64; 3]; 3] {
        [0, 1, 2].map(|j| [self.0[0][j], self.0[1][j], self.0[2][j]])
    }

    #[inline]
    pub(crate) fn point(&self, p: [f64; 3]) -> [f64; 3] {
        self.0
            .map(|r| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3])
    }

    #[inline]
    pub(crate) fn vector(&self, v: [f64; 3]) -> [f64; 3] {
        self.0.map(|r| r[0] * v[0] + r[1] * v[1] + r[2] * v[2])
    }

    /// Takes a normal from this map's *target* space back to its source: multiplies by the transpose. So
    /// world → object maps take object normals to world space.
    #[inline]
    pub(crate) fn transposed_vector(&self, n: [f64; 3]) -> [f64; 3] {
        self.columns().map(|c| dot(c, n))
    }
}

#[inline]
pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline]
pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

/// A checked [`Quadric`], ready for rays. Embree's callbacks see it through a raw pointer.
pub(crate) struct Prepared {
    kind: Kind,
    lower: [f32; 3],
    upper: [f32; 3],
}

enum Kind {
    Sphere { center: [f64; 3], radius: f64 },
    Disk { to_object: Affine },
    Cylinder { to_object: Affine },
}

impl Prepared {
    pub(crate) fn new(quadric: &Quadric) -> Result<Self, EmbreeError> {
        match *quadric {
            Quadric::Sphere { center, radius } => {
                let finite = center.iter().all(|x| x.abs() <= LARGEST) && radius <= LARGEST;
                if !(finite && radius > 0.0) {
                    return Err(EmbreeError::Sphere { center, radius });
                }
                let (center, radius) = (center.map(f64::from), f64::from(radius));
                Ok(Self::boxed(
                    Kind::Sphere { center, radius },
                    &[center],
                    [radius; 3],
                ))
            }
            Quadric::Disk { to_world } => {
                let (map, to_object) = Affine::invertible("disk", &to_world)?;
                Ok(Self::boxed(
                    Kind::Disk { to_object },
                    &[map.point([0.0; 3])],
                    circle(&map),
                ))
            }
            Quadric::Cylinder { to_world } => {
                let (map, to_object) = Affine::invertible("cylinder", &to_world)?;
                let ends = [map.point([0.0; 3]), map.point([0.0, 0.0, 1.0])];
                Ok(Self::boxed(
                    Kind::Cylinder { to_object },
                    &ends,
                    circle(&map),
                ))
            }
        }
    }

    /// The box of `centers` ± `extent`, a little larger so that rounding in Embree's single-precision box
    /// tests cannot lose a point on the rim or a disk without thickness.
    fn boxed(kind: Kind, centers: &[[f64; 3]], extent: [f64; 3]) -> Self {
        let (mut lower, mut upper) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for center in centers {
            for i in 0..3 {
                let slack = 4e-7 * (center[i].abs() + extent[0].max(extent[1]).max(extent[2]));
                lower[i] = lower[i].min((center[i] - extent[i] - slack) as f32);
                upper[i] = upper[i].max((center[i] + extent[i] + slack) as f32);
            }
        }
        Self { kind, lower, upper }
    }

    /// Nearest `t ∈ [tnear, tfar]` and the outward normal there (world space, any length).
    #[inline]
    fn intersect(
        &self,
        origin: [f64; 3],
        dir: [f64; 3],
        tnear: f64,
        tfar: f64,
    ) -> Option<(f64, [f64; 3])> {
        let inside = |t: f64| t >= tnear && t <= tfar;
        let at =
            |o: [f64; 3], d: [f64; 3], t: f64| [o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]];
        match &self.kind {
            Kind::Sphere { center, radius } => {
                let o = [
                    origin[0] - center[0],
                    origin[1] - center[1],
                    origin[2] - center[2],
                ];
                // Solve from the ray's point nearest to the centre: far away, the squared distances of the
                // plain equation would cancel.
                let dd = dot(dir, dir);
                let middle = -dot(o, dir) / dd;
                let nearest = at(o, dir, middle);
                let half_chord = ((radius * radius - dot(nearest, nearest)) / dd).sqrt();
                // A negative radicand gives NaN, which no comparison accepts.
                let t = [middle - half_chord, middle + half_chord]
                    .into_iter()
                    .find(|t| inside(*t))?;
                Some((t, at(o, dir, t)))
            }
            Kind::Disk { to_object } => {
                let (o, d) = (to_object.point(origin), to_object.vector(dir));
                let t = -o[2] / d[2];
                let p = at(o, d, t);
                (inside(t) && p[0] * p[0] + p[1] * p[1] <= 1.0)
                    .then(|| (t, to_object.transposed_vector([0.0, 0.0, 1.0])))
            }
            Kind::Cylinder { to_object } => {
                let (o, d) = (to_object.point(origin), to_object.vector(dir));
                let (t0, t1) = roots(
                    d[0] * d[0] + d[1] * d[1],
                    o[0] * d[0] + o[1] * d[1],
                    o[0] * o[0] + o[1] * o[1] - 1.0,
                )?;
                let t = [t0, t1]
                    .into_iter()
                    .find(|t| inside(*t) && (0.0..=1.0).contains(&(o[2] + t * d[2])))?;
                let p = at(o, d, t);
                Some((t, to_object.transposed_vector([p[0], p[1], 0.0])))
            }
        }
    }
}

/// Half-extents of the image of the unit circle in z = 0.
fn circle(map: &Affine) -> [f64; 3] {
    map.0.map(|row| row[0].hypot(row[1]))
}

/// Ordered roots of a·t² + 2b·t + c, without the cancellation of the school formula.
#[inline]
fn roots(a: f64, b: f64, c: f64) -> Option<(f64, f64)> {
    let discriminant = b * b - a * c;
    // A ray along the axis (a = 0) never crosses the wall.
    if !(discriminant >= 0.0 && a > 0.0) {
        return None;
    }
    let q = -(b + discriminant.sqrt().copysign(b));
    let (t0, t1) = (q / a, c / q);
    // b = discriminant = 0 makes c/q 0/0: then both roots are q/a.
    let t1 = if t1.is_nan() { t0 } else { t1 };
    Some((t0.min(t1), t0.max(t1)))
}

/// Embree asks for the box of a user primitive.
pub(crate) unsafe extern "C" fn bounds_callback(args: *const RtcBoundsFunctionArguments) {
    // SAFETY: Embree passes a valid argument struct; the user pointer is the `Prepared` that the scene owns
    // for as long as the geometry lives; `bounds_o` is writable.
    unsafe {
        let args = &*args;
        let shape = &*args.geometry_user_ptr.cast::<Prepared>();
        (&raw mut (*args.bounds_o).lower).write(shape.lower);
        (&raw mut (*args.bounds_o).upper).write(shape.upper);
    }
}

/// One lane of an `RTCRayN`/`RTCRayHitN`: field `k` of ray `i` is the 32-bit word `k·n + i`, for every n
/// that Embree uses (1, 4, 8, 16), because no padding falls between the fields.
struct Lane {
    words: *mut f32,
    n: usize,
    i: usize,
}

impl Lane {
    /// # Safety
    /// Word `field·n + i` lies within the packet.
    #[inline]
    unsafe fn get(&self, field: usize) -> f32 {
        // SAFETY: the caller's promise; words are 4-byte aligned.
        unsafe { self.words.add(field * self.n + self.i).read() }
    }

    /// # Safety
    /// Word `field·n + i` lies within the packet, which is writable.
    #[inline]
    unsafe fn set(&self, field: usize, value: f32) {
        // SAFETY: the caller's promise; words are 4-byte aligned.
        unsafe { self.words.add(field * self.n + self.i).write(value) }
    }

    /// # Safety
    /// As [`Lane::set`]. Numbers of geometries pass as integers: as floats some would be signalling NaNs.
    #[inline]
    unsafe fn set_id(&self, field: usize, value: u32) {
        // SAFETY: the caller's promise; words are 4-byte aligned.
        unsafe {
            self.words
                .cast::<u32>()
                .add(field * self.n + self.i)
                .write(value)
        }
    }
}

// Field numbers within RTCRayN and, after its twelve, RTCHitN.
const ORG: usize = 0;
const TNEAR: usize = 3;
const DIR: usize = 4;
const TFAR: usize = 8;
const NG: usize = ffi::RAY_FIELDS;
const U: usize = ffi::RAY_FIELDS + 3;
const V: usize = ffi::RAY_FIELDS + 4;
const PRIM_ID: usize = ffi::RAY_FIELDS + 5;
const GEOM_ID: usize = ffi::RAY_FIELDS + 6;
const INST_ID: usize = ffi::RAY_FIELDS + 7;

/// Calls `found` for each living lane whose ray meets the shape.
///
/// # Safety
/// `args` is what Embree passes to the callbacks of a geometry whose user pointer is a live `Prepared`.
#[inline]
unsafe fn for_each_hit(args: &RtcQueryFunctionNArguments, found: impl Fn(&Lane, f64, [f64; 3])) {
    // SAFETY: the user pointer is the scene's `Prepared`.
    let shape = unsafe { &*args.geometry_user_ptr.cast::<Prepared>() };
    let n = args.n as usize;
    for i in 0..n {
        // SAFETY: `valid` has n entries.
        if unsafe { args.valid.add(i).read() } == 0 {
            continue;
        }
        let lane = Lane {
            words: args.rayhit.cast(),
            n,
            i,
        };
        // SAFETY: the fields read are those of an RTCRayN.
        let (origin, dir, tnear, tfar) = unsafe {
            (
                [lane.get(ORG), lane.get(ORG + 1), lane.get(ORG + 2)].map(f64::from),
                [lane.get(DIR), lane.get(DIR + 1), lane.get(DIR + 2)].map(f64::from),
                f64::from(lane.get(TNEAR)),
                f64::from(lane.get(TFAR)),
            )
        };
        if let Some((t, normal)) = shape.intersect(origin, dir, tnear, tfar) {
            found(&lane, t, normal);
        }
    }
}

/// Embree asks for the nearest hit of each ray with a user primitive.
pub(crate) unsafe extern "C" fn intersect_callback(args: *const RtcQueryFunctionNArguments) {
    // SAFETY: Embree passes a valid argument struct of a geometry made by `SceneBuilder::quadric`, with an
    // RTCRayHitN, and a context (its own where we passed none) whose first word is the instance's number.
    // Rounding t to single precision cannot leave [tnear, tfar]: both ends are single-precision numbers.
    unsafe {
        let args = &*args;
        let inst_id = (&raw const (*args.context).inst_id).read();
        for_each_hit(args, |lane, t, normal| {
            lane.set(TFAR, t as f32);
            for (axis, n) in normal.into_iter().enumerate() {
                lane.set(NG + axis, n as f32);
            }
            lane.set(U, 0.0);
            lane.set(V, 0.0);
            lane.set_id(PRIM_ID, args.prim_id);
            lane.set_id(GEOM_ID, args.geom_id);
            // instPrimID is left alone: versions before 4.3 lack it, and nothing here reads it.
            lane.set_id(INST_ID, inst_id);
        });
    }
}

/// Embree asks whether anything of a user primitive lies on each ray.
pub(crate) unsafe extern "C" fn occluded_callback(args: *const RtcQueryFunctionNArguments) {
    // SAFETY: as in `intersect_callback`, but with an RTCRayN: only ray fields are touched.
    unsafe { for_each_hit(&*args, |lane, _, _| lane.set(TFAR, f32::NEG_INFINITY)) }
}

/// The user pointer that the callbacks expect.
pub(crate) fn user_pointer(shape: &std::sync::Arc<Prepared>) -> *mut c_void {
    std::sync::Arc::as_ptr(shape).cast_mut().cast()
}
