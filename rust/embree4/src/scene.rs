//! Scenes: built by one thread, then frozen and traced by all.

use std::borrow::Borrow;
use std::sync::Arc;

use crate::ffi::{self, RtcGeometry, RtcScene};
use crate::query::{lane, rayhit, rayhit16, rtc_ray, rtc_ray16};
use crate::shapes::{self, Affine, LARGEST, Prepared};
use crate::shared::Shared;
use crate::{Bounds, Device, EmbreeError, GeomId, Hit, Quadric, Ray};

/// Rays in one packet of [`Scene::intersect_packet16`].
pub const PACKET_WIDTH: usize = 16;

/// Collects geometry; [`SceneBuilder::commit`] builds the BVH and freezes it.
///
/// # Examples
/// ```no_run
/// use embree4::{Device, Quadric, Ray, SceneBuilder};
/// let mut builder = SceneBuilder::new(&Device::new()?)?;
/// let ball = builder.quadric(Quadric::Sphere { center: [0.0, 0.0, 5.0], radius: 1.0 })?;
/// let scene = builder.commit()?;
/// let hit = scene.intersect(&Ray::new([0.0; 3], [0.0, 0.0, 1.0])).expect("the ball is straight ahead");
/// assert_eq!((hit.t, hit.geom), (4.0, ball.0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct SceneBuilder {
    // Field order is drop order: the handle goes before what its callbacks point to.
    handle: SceneHandle,
    robust: bool,
    /// What user pointers of the geometries point to.
    shapes: Vec<Arc<Prepared>>,
    /// What the buffers of shared meshes point to.
    meshes: Vec<(Shared<f32>, Shared<u32>)>,
    /// Instanced scenes, kept alive.
    children: Vec<Scene>,
    /// By `GeomId`: world → instance, for the normals of hits; `None` for plain geometry.
    to_instance: Vec<Option<Affine>>,
}

struct SceneHandle {
    raw: RtcScene,
    device: Device,
}

// SAFETY: Embree's building functions may be called from any thread, one at a time; all of them run behind
// `&mut SceneBuilder`. Once committed a scene is read-only, and its queries, the only calls behind `&self`,
// may run on any number of threads at once. The last owner releases it, on whichever thread that is.
unsafe impl Send for SceneHandle {}
// SAFETY: as above.
unsafe impl Sync for SceneHandle {}

impl Drop for SceneHandle {
    fn drop(&mut self) {
        // SAFETY: made by rtcNewScene, released once. No query can be running: they borrow the owner.
        unsafe { (self.device.api().release_scene)(self.raw) }
    }
}

/// A geometry between rtcNewGeometry and its scene, which takes a reference of its own.
struct NewGeometry<'a> {
    raw: RtcGeometry,
    device: &'a Device,
}

impl Drop for NewGeometry<'_> {
    fn drop(&mut self) {
        // SAFETY: made by rtcNewGeometry; this releases the reference that the call returned.
        unsafe { (self.device.api().release_geometry)(self.raw) }
    }
}

/// A frozen scene. Cloning is cheap and shares it; any number of threads may trace it at once.
#[derive(Clone)]
pub struct Scene(Arc<SceneBuilder>);

impl SceneBuilder {
    /// An empty scene. Settings are Mitsuba's: best build quality, fast (not watertight) triangle test.
    ///
    /// # Errors
    /// [`EmbreeError::Library`] if Embree is out of memory.
    pub fn new(device: &Device) -> Result<Self, EmbreeError> {
        device.clear();
        // SAFETY: the device is live.
        let raw = unsafe { (device.api().new_scene)(device.raw()) };
        if raw.is_null() {
            return Err(refusal(device, "rtcNewScene"));
        }
        Ok(Self {
            handle: SceneHandle {
                raw,
                device: device.clone(),
            },
            robust: false,
            shapes: Vec::new(),
            meshes: Vec::new(),
            children: Vec::new(),
            to_instance: Vec::new(),
        })
    }

    /// Chooses Embree's watertight traversal: no ray slips between two triangles that share an edge, at some
    /// cost in speed. Mitsuba's default, and this crate's, is `false`.
    pub fn robust(&mut self, robust: bool) -> &mut Self {
        self.robust = robust;
        self
    }

    /// Adds a triangle mesh. Embree keeps a copy of both arrays.
    ///
    /// | name        | shape, layout         | range         | meaning                     |
    /// |-------------|-----------------------|---------------|-----------------------------|
    /// | `positions` | `(P, 3)` row-major    | within ±1e18  | vertices, world space       |
    /// | `faces`     | `(T, 3)` row-major    | `[0, P)`      | vertex numbers per triangle |
    ///
    /// Triangles without area are allowed and never hit. No triangles at all is allowed too.
    ///
    /// # Errors
    /// [`EmbreeError::Length`], [`EmbreeError::TooMany`], [`EmbreeError::Vertex`] for the first bad vertex,
    /// [`EmbreeError::Index`] for the first bad face; [`EmbreeError::Library`] when out of memory.
    pub fn triangles(
        &mut self,
        positions: impl AsRef<[f32]>,
        faces: impl AsRef<[u32]>,
    ) -> Result<GeomId, EmbreeError> {
        let (positions, faces) = (positions.as_ref(), faces.as_ref());
        check_mesh(positions, faces)?;
        let device = self.handle.device.clone();
        let geometry = new_geometry(&device, ffi::GEOMETRY_TRIANGLE)?;
        if !faces.is_empty() {
            for (kind, format, data, count) in [
                (
                    ffi::BUFFER_VERTEX,
                    ffi::FORMAT_FLOAT3,
                    positions.as_ptr().cast::<u8>(),
                    positions.len() / 3,
                ),
                (
                    ffi::BUFFER_INDEX,
                    ffi::FORMAT_UINT3,
                    faces.as_ptr().cast::<u8>(),
                    faces.len() / 3,
                ),
            ] {
                // SAFETY: the buffer is Embree's own, 12·count bytes and the padding that its 16-byte loads
                // need; `data` holds 3·count numbers of four bytes.
                unsafe {
                    let buffer = (device.api().set_new_geometry_buffer)(
                        geometry.raw,
                        kind,
                        0,
                        format,
                        12,
                        count,
                    );
                    if buffer.is_null() {
                        return Err(refusal(&device, "rtcSetNewGeometryBuffer"));
                    }
                    data.copy_to_nonoverlapping(buffer.cast(), 12 * count);
                }
            }
        }
        self.attach(&geometry, None)
    }

    /// Adds a triangle mesh whose arrays Embree reads in place, for as long as the scene lives; layout and errors as
    /// in [`SceneBuilder::triangles`].
    ///
    /// # Errors
    /// As [`SceneBuilder::triangles`].
    pub fn shared_triangles(
        &mut self,
        positions: &Shared<f32>,
        faces: &Shared<u32>,
    ) -> Result<GeomId, EmbreeError> {
        check_mesh(positions, faces)?;
        let device = self.handle.device.clone();
        let geometry = new_geometry(&device, ffi::GEOMETRY_TRIANGLE)?;
        if !faces.is_empty() {
            // Before Embree learns of them: they must outlive the scene's handle, which is dropped first.
            self.meshes.push((positions.clone(), faces.clone()));
            let set = device.api().set_shared_geometry_buffer;
            // SAFETY: both arrays hold 12·count bytes and 16 more, which Embree's 16-byte loads of the last element
            // need; nobody can change or free them while `meshes` holds them, and that outlives the handle.
            unsafe {
                set(
                    geometry.raw,
                    ffi::BUFFER_VERTEX,
                    0,
                    ffi::FORMAT_FLOAT3,
                    positions.as_ptr().cast(),
                    0,
                    12,
                    positions.len() / 3,
                );
                set(
                    geometry.raw,
                    ffi::BUFFER_INDEX,
                    0,
                    ffi::FORMAT_UINT3,
                    faces.as_ptr().cast(),
                    0,
                    12,
                    faces.len() / 3,
                );
            }
        }
        self.attach(&geometry, None)
    }

    /// Adds an exact sphere, disk or cylinder.
    ///
    /// # Errors
    /// [`EmbreeError::Sphere`] or [`EmbreeError::Transform`] for parameters that make no surface.
    pub fn quadric(&mut self, quadric: impl Borrow<Quadric>) -> Result<GeomId, EmbreeError> {
        let shape = Arc::new(Prepared::new(quadric.borrow())?);
        let device = self.handle.device.clone();
        let geometry = new_geometry(&device, ffi::GEOMETRY_USER)?;
        let api = device.api();
        // SAFETY: the user pointer lives in an `Arc` that this builder, and then the scene, keeps until the
        // scene's handle is released (it is stored before the geometry is attached); the callbacks expect it.
        unsafe {
            (api.set_geometry_user_primitive_count)(geometry.raw, 1);
            (api.set_geometry_user_data)(geometry.raw, shapes::user_pointer(&shape));
            (api.set_geometry_bounds_function)(
                geometry.raw,
                Some(shapes::bounds_callback),
                std::ptr::null_mut(),
            );
            (api.set_geometry_intersect_function)(geometry.raw, Some(shapes::intersect_callback));
            (api.set_geometry_occluded_function)(geometry.raw, Some(shapes::occluded_callback));
        }
        self.shapes.push(shape);
        self.attach(&geometry, None)
    }

    /// Adds a transformed view of a committed scene; `to_world` is 3×4, row-major. One level: the scene must
    /// hold no instances.
    ///
    /// # Errors
    /// [`EmbreeError::NestedInstance`], [`EmbreeError::OtherDevice`], [`EmbreeError::Transform`].
    pub fn instance(&mut self, scene: &Scene, to_world: &[f32; 12]) -> Result<GeomId, EmbreeError> {
        let (_, to_instance) = Affine::invertible("instance", to_world)?;
        if !scene.0.children.is_empty() {
            return Err(EmbreeError::NestedInstance);
        }
        let device = self.handle.device.clone();
        if !device.is_same(&scene.0.handle.device) {
            return Err(EmbreeError::OtherDevice);
        }
        let geometry = new_geometry(&device, ffi::GEOMETRY_INSTANCE)?;
        // SAFETY: both handles are live and of one device; the matrix is copied by the call.
        unsafe {
            (device.api().set_geometry_instanced_scene)(geometry.raw, scene.0.handle.raw);
            (device.api().set_geometry_transform)(
                geometry.raw,
                0,
                ffi::FORMAT_FLOAT3X4_ROW_MAJOR,
                to_world.as_ptr().cast(),
            );
        }
        self.children.push(scene.clone());
        self.attach(&geometry, Some(to_instance))
    }

    fn attach(
        &mut self,
        geometry: &NewGeometry<'_>,
        to_instance: Option<Affine>,
    ) -> Result<GeomId, EmbreeError> {
        let (device, scene) = (&self.handle.device, self.handle.raw);
        // SAFETY: both handles are live; the scene is uncommitted.
        let id = unsafe {
            (device.api().commit_geometry)(geometry.raw);
            (device.api().attach_geometry)(scene, geometry.raw)
        };
        device.check("rtcAttachGeometry")?;
        // Embree numbers geometries in order; the table of instances leans on it.
        if id as usize != self.to_instance.len() {
            return Err(EmbreeError::Library {
                call: "rtcAttachGeometry",
                message: format!("geometry {} was numbered {id}", self.to_instance.len()),
            });
        }
        self.to_instance.push(to_instance);
        Ok(GeomId(id))
    }

    /// Builds the BVH (on the device's threads) and freezes the scene.
    ///
    /// # Errors
    /// [`EmbreeError::Library`], in practice when memory runs out.
    pub fn commit(self) -> Result<Scene, EmbreeError> {
        let (device, scene) = (&self.handle.device, self.handle.raw);
        device.clear();
        let flags = if self.robust { ffi::SCENE_ROBUST } else { 0 };
        // SAFETY: the scene is live, and its geometries are committed.
        unsafe {
            (device.api().set_scene_flags)(scene, flags);
            (device.api().set_scene_build_quality)(scene, ffi::QUALITY_HIGH);
            (device.api().commit_scene)(scene);
        }
        device.check("rtcCommitScene")?;
        Ok(Scene(Arc::new(self)))
    }
}

impl std::fmt::Debug for SceneBuilder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "SceneBuilder({} geometries)", self.to_instance.len())
    }
}

impl std::fmt::Debug for Scene {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Scene({} geometries)", self.len())
    }
}

impl Scene {
    /// The nearest hit of one ray. Allocates nothing.
    #[inline]
    pub fn intersect(&self, ray: &Ray) -> Option<Hit> {
        let mut query = rayhit(ray);
        // SAFETY: the scene is committed; `query` has the size and alignment that the library expects
        // (asserted in `ffi.rs`, checked at run time in `load.rs`); null arguments mean the defaults.
        unsafe { (self.api().intersect1)(self.0.handle.raw, &raw mut query, std::ptr::null_mut()) };
        self.hit(&query.hit, query.ray.tfar)
    }

    /// Whether anything lies on the segment. Faster than [`Scene::intersect`]. Allocates nothing.
    #[inline]
    pub fn occluded(&self, ray: &Ray) -> bool {
        let mut query = rtc_ray(ray);
        // SAFETY: as in `intersect`.
        unsafe { (self.api().occluded1)(self.0.handle.raw, &raw mut query, std::ptr::null_mut()) };
        query.tfar == f32::NEG_INFINITY && ray.tfar != f32::NEG_INFINITY
    }

    /// [`Scene::intersect`] for many rays, in packets of 16. Four times as fast for `coherent` rays (camera
    /// rays in order of their pixels); for the rest single rays are as good. Allocates nothing.
    ///
    /// # Panics
    /// If `rays` and `hits` differ in length.
    pub fn intersect_packet16(&self, rays: &[Ray], hits: &mut [Option<Hit>], coherent: bool) {
        assert_eq!(
            rays.len(),
            hits.len(),
            "`rays` and `hits` must have one length"
        );
        let mut args = ffi::RtcQueryArguments::new(coherent);
        for (rays, hits) in rays.chunks(PACKET_WIDTH).zip(hits.chunks_mut(PACKET_WIDTH)) {
            let (valid, mut query) = rayhit16(rays);
            // SAFETY: as in `intersect`; `valid` is aligned and has 16 entries, and `args` has at least the
            // size of an RTCIntersectArguments, with null for what is optional.
            unsafe {
                (self.api().intersect16)(
                    valid.0.as_ptr(),
                    self.0.handle.raw,
                    &raw mut query,
                    &raw mut args,
                );
            }
            for (i, hit) in hits.iter_mut().enumerate() {
                *hit = self.hit(&lane(&query.hit, i), query.ray.tfar[i]);
            }
        }
    }

    /// [`Scene::occluded`] for many rays, in packets of 16. Worth it for shadow rays towards one point.
    ///
    /// # Panics
    /// If `rays` and `blocked` differ in length.
    pub fn occluded_packet16(&self, rays: &[Ray], blocked: &mut [bool], coherent: bool) {
        assert_eq!(
            rays.len(),
            blocked.len(),
            "`rays` and `blocked` must have one length"
        );
        let mut args = ffi::RtcQueryArguments::new(coherent);
        for (rays, blocked) in rays
            .chunks(PACKET_WIDTH)
            .zip(blocked.chunks_mut(PACKET_WIDTH))
        {
            let (valid, mut query) = rtc_ray16(rays);
            // SAFETY: as in `intersect_packet16`.
            unsafe {
                (self.api().occluded16)(
                    valid.0.as_ptr(),
                    self.0.handle.raw,
                    &raw mut query,
                    &raw mut args,
                );
            }
            for ((blocked, tfar), ray) in blocked.iter_mut().zip(query.tfar).zip(rays) {
                *blocked = tfar == f32::NEG_INFINITY && ray.tfar != f32::NEG_INFINITY;
            }
        }
    }

    /// A box around everything, `None` if there is nothing. It may be a few units in the last place larger
    /// than the geometry.
    pub fn bounds(&self) -> Option<Bounds> {
        let mut bounds = ffi::RtcBounds {
            lower: [f32::INFINITY; 3],
            align0: 0.0,
            upper: [f32::NEG_INFINITY; 3],
            align1: 0.0,
        };
        // SAFETY: the scene is committed; `bounds` is aligned and writable.
        unsafe { (self.api().get_scene_bounds)(self.0.handle.raw, &raw mut bounds) };
        let (min, max) = (bounds.lower, bounds.upper);
        (0..3)
            .all(|i| min[i] <= max[i])
            .then_some(Bounds { min, max })
    }

    /// Number of geometries: meshes, quadrics and instances.
    pub fn len(&self) -> usize {
        self.0.to_instance.len()
    }

    /// Whether the scene holds no geometry, so that every ray misses.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The device that the scene was built on.
    pub fn device(&self) -> &Device {
        &self.0.handle.device
    }

    #[inline]
    fn api(&self) -> &'static ffi::Api {
        self.0.handle.device.api()
    }

    #[cfg(test)]
    pub(crate) fn raw(&self) -> RtcScene {
        self.0.handle.raw
    }

    #[inline]
    fn hit(&self, hit: &ffi::RtcHit, t: f32) -> Option<Hit> {
        if hit.geom_id == ffi::INVALID {
            return None;
        }
        let inst = (hit.inst_id != ffi::INVALID).then_some(hit.inst_id);
        Some(Hit {
            t,
            u: hit.u,
            v: hit.v,
            ng: match inst {
                None => hit.ng,
                Some(inst) => self.world_normal(inst, hit.ng),
            },
            geom: hit.geom_id,
            prim: hit.prim_id,
            inst,
        })
    }

    /// Embree leaves normals in the instance's space.
    fn world_normal(&self, inst: u32, ng: [f32; 3]) -> [f32; 3] {
        match self.0.to_instance.get(inst as usize) {
            Some(Some(to_instance)) => to_instance
                .transposed_vector(ng.map(f64::from))
                .map(|x| x as f32),
            _ => ng,
        }
    }
}

fn new_geometry(device: &Device, kind: u32) -> Result<NewGeometry<'_>, EmbreeError> {
    device.clear();
    // SAFETY: the device is live.
    let raw = unsafe { (device.api().new_geometry)(device.raw(), kind) };
    if raw.is_null() {
        return Err(refusal(device, "rtcNewGeometry"));
    }
    Ok(NewGeometry { raw, device })
}

/// The error behind a null handle.
fn refusal(device: &Device, call: &'static str) -> EmbreeError {
    match device.check(call) {
        Err(error) => error,
        Ok(()) => EmbreeError::Library {
            call,
            message: "it returned null".to_owned(),
        },
    }
}

/// All that must hold before Embree sees a mesh: it would read out of bounds, or drop triangles silently.
pub(crate) fn check_mesh(positions: &[f32], faces: &[u32]) -> Result<(), EmbreeError> {
    let vertices = positions.len() / 3;
    for (array, len, rule) in [
        ("positions", positions.len(), "x, y, z of each vertex"),
        (
            "faces",
            faces.len(),
            "three vertex numbers of each triangle",
        ),
    ] {
        if len % 3 != 0 {
            return Err(EmbreeError::Length { array, len, rule });
        }
        let count = len / 3;
        if count >= ffi::INVALID as usize {
            return Err(EmbreeError::TooMany { array, count });
        }
    }
    for (vertex, p) in positions.chunks_exact(3).enumerate() {
        if !p.iter().all(|x| x.abs() <= LARGEST) {
            let value = [p[0], p[1], p[2]];
            return Err(EmbreeError::Vertex { vertex, value });
        }
    }
    for (corner, &index) in faces.iter().enumerate() {
        if index as usize >= vertices {
            return Err(EmbreeError::Index {
                face: corner / 3,
                index,
                vertices,
            });
        }
    }
    Ok(())
}
