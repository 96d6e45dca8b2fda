//! The scene: everything checked once, then read by many threads.

use embree4::{Device, Hit, Ray};
use serde::Deserialize;

use crate::arrays::{Array, Arrays, check, check_index};
use crate::bsdf::{Bsdf, Materials};
use crate::columns::EmitterStrategy;
use crate::description::{SCHEMA, SceneDescription, Version, scene_hash};
use crate::distribution::Discrete;
use crate::emitter::{self, Emitter};
use crate::error::SceneError;
use crate::film::Film;
use crate::interaction::Interaction;
use crate::math::{Rgb, Vec3};
use crate::sensor::Sensor;
use crate::shape::attribute::Attributes;
use crate::shape::{Common, Shape, Tangents};
use crate::texture::Texture;

/// Counts and sizes, for `pssflow info` and the statistics of a render.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct Summary {
    /// Triangles that can be hit.
    pub triangles: usize,
    /// Triangles without area, left out.
    pub degenerate_triangles: usize,
    /// Shapes by plugin.
    pub shapes: std::collections::BTreeMap<String, usize>,
    /// BSDFs by plugin.
    pub bsdfs: std::collections::BTreeMap<String, usize>,
    /// Emitters by plugin.
    pub emitters: std::collections::BTreeMap<String, usize>,
    /// Bytes of geometry held.
    pub geometry_bytes: usize,
    /// Number of textures.
    pub textures: usize,
    /// Bytes of their values.
    pub texture_bytes: usize,
    /// Bytes that Embree allocated while the scene was built.
    pub bvh_bytes: usize,
}

/// A scene that can be traced. Send + Sync; nothing in it changes after it is built.
pub struct Scene {
    accel: embree4::Scene,
    shapes: Vec<Shape>,
    commons: Vec<Common>,
    /// Where each group's shapes begin.
    group_starts: Vec<usize>,
    materials: Materials,
    /// Per BSDF, so that the main loop does not ask twice.
    traits: Vec<BsdfTraits>,
    emitters: Vec<Emitter>,
    environments: Vec<usize>,
    emitter_choice: Discrete,
    sensor: Sensor,
    film: Film,
    hide_emitters: bool,
    bvh_bytes: usize,
    hash: String,
}

impl std::fmt::Debug for Scene {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Scene")
            .field("hash", &self.hash)
            .field("summary", &self.summary())
            .finish()
    }
}

/// What the main loop needs to know of a BSDF before it is evaluated.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BsdfTraits {
    pub(crate) transmits: bool,
    pub(crate) smooth: bool,
    pub(crate) anisotropic: bool,
}

/// Errors unless shapes and area emitters name each other: a ray that hits the shape must find the very
/// light that next-event estimation samples, or their weights do not add up to one.
fn check_attachments(
    shapes: &[Common],
    emitters: &[Emitter],
    ids: &[String],
) -> Result<(), SceneError> {
    let on = |e: usize| emitters[e].model().shape();
    let lost_shape =
        (0..shapes.len()).find(|&s| shapes[s].emitter.is_some_and(|e| on(e) != Some(s)));
    let lost_emitter =
        (0..emitters.len()).find(|&e| on(e).is_some_and(|s| shapes[s].emitter != Some(e)));
    let (shape, emitter) = match (lost_shape, lost_emitter) {
        (Some(s), _) => (Some(s), shapes[s].emitter),
        (None, Some(e)) => (on(e), Some(e)),
        (None, None) => return Ok(()),
    };
    Err(SceneError::Attachment {
        shape: shape.map(|s| shapes[s].id.clone()).unwrap_or_default(),
        emitter: emitter.map(|e| ids[e].clone()).unwrap_or_default(),
    })
}

/// Hands a shape to Embree; a refusal names the shape.
fn attach(
    shape: &Shape,
    common: &Common,
    builder: &mut embree4::SceneBuilder,
    groups: &[embree4::Scene],
) -> Result<(), SceneError> {
    let attached = shape.model().attach(builder, groups);
    attached.map(drop).map_err(|e| match e {
        SceneError::Embree(source) => SceneError::Geometry {
            owner: format!("shape {:?}", common.id),
            source,
        },
        other => other,
    })
}

impl Scene {
    /// Builds a scene from its description (JSON, schema 1) and arrays, and its BVH on `device`.
    ///
    /// # Errors
    /// [`SceneError`]; it names the shape, BSDF, emitter or texture, and the rule that it breaks.
    pub fn new(description: &str, arrays: Vec<Array>, device: &Device) -> Result<Self, SceneError> {
        let mut description: serde_json::Value = serde_json::from_str(description)?;
        // Before the rest, which another schema may have changed.
        let found = Version::deserialize(&description)?.schema;
        if found != SCHEMA {
            return Err(SceneError::Schema {
                found,
                expected: SCHEMA,
            });
        }
        // The same scene loaded in another Mitsuba variant is the same scene.
        if let Some(fields) = description.as_object_mut() {
            fields.remove("variant");
        }
        let hash = scene_hash(&description, &arrays);
        let d = SceneDescription::deserialize(description)?;
        let mut arrays = Arrays::new(arrays);

        let mut materials = Materials::default();
        for texture in d.textures {
            materials
                .textures
                .push(Texture::build(texture, &mut arrays)?);
        }
        for bsdf in d.bsdfs {
            let bsdf = Bsdf::build(bsdf, &materials)?;
            materials.bsdfs.push(bsdf);
        }
        let traits = materials.bsdfs.iter().map(|b| BsdfTraits {
            transmits: b.transmits(&materials),
            smooth: b.smooth(&materials),
            anisotropic: b.anisotropic(&materials),
        });
        let traits = traits.collect();

        if d.shapes.is_empty() {
            return Err(SceneError::Empty);
        }
        let (mut shapes, mut commons) = (Vec::new(), Vec::new());
        let allocated = device.memory();
        let mut builder = embree4::SceneBuilder::new(device)?;
        let mut add = |description, emitters| {
            let (common, shape) = Shape::build(description, &mut arrays)?;
            let owner = format!("shape {:?}", common.id);
            check_index(common.bsdf, materials.bsdfs.len(), &owner, "bsdf")?;
            if let Some(e) = common.emitter {
                check_index(e, emitters, &owner, "emitter")?;
            }
            Ok::<_, SceneError>((common, shape))
        };
        for description in d.shapes {
            let (common, shape) = add(description, d.emitters.len())?;
            shapes.push(shape);
            commons.push(common);
        }
        // Groups' shapes come behind the others, whose indices are Embree's.
        let top_level = shapes.len();
        let (mut groups, mut group_starts) = (Vec::new(), Vec::new());
        for group in d.groups {
            group_starts.push(shapes.len());
            let mut group_builder = embree4::SceneBuilder::new(device)?;
            for description in group.shapes {
                // Mitsuba has no emitters and no instances in groups.
                let (common, shape) = add(description, 0)?;
                attach(&shape, &common, &mut group_builder, &[])?;
                shapes.push(shape);
                commons.push(common);
            }
            groups.push(group_builder.commit()?);
        }
        for (shape, common) in shapes.iter().zip(&commons).take(top_level) {
            attach(shape, common, &mut builder, &groups)?;
        }

        for e in &d.emitters {
            let weight = e.sampling_weight();
            let owner = format!("emitter {:?}", e.id());
            let ok = weight.is_finite() && weight >= 0.0;
            check(
                ok,
                &owner,
                "sampling_weight",
                weight,
                "finite and not negative",
            )?;
        }
        let weights: Vec<f32> = d
            .emitters
            .iter()
            .map(emitter::Description::sampling_weight)
            .collect();
        let emitter_ids: Vec<String> = d.emitters.iter().map(|e| e.id().to_owned()).collect();
        let mut emitters = Vec::new();
        for e in d.emitters {
            emitters.push(Emitter::build(
                e,
                emitter::Builder {
                    textures: materials.textures.len(),
                    shapes: top_level,
                    arrays: &mut arrays,
                },
            )?);
        }
        check_attachments(&commons, &emitters, &emitter_ids)?;
        let environments = (0..emitters.len())
            .filter(|&i| emitters[i].model().is_environment())
            .collect();

        let attributes = shapes.iter().map(|s| s.model().attributes());
        materials.attributes = Attributes::new(attributes.collect());
        let film = Film::build(d.film)?;
        let accel = builder.commit()?;
        Ok(Self {
            accel,
            bvh_bytes: device.memory().saturating_sub(allocated),
            shapes,
            commons,
            group_starts,
            traits,
            materials,
            environments,
            emitter_choice: Discrete::new(weights.into_iter()),
            emitters,
            sensor: Sensor::build(d.sensor, &film)?,
            film,
            hide_emitters: d.hide_emitters,
            hash,
        })
    }

    /// Whether the camera sees no emitter.
    pub(crate) fn hides_emitters(&self) -> bool {
        self.hide_emitters
    }

    /// Hash of description and arrays (hex).
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// The film.
    pub fn film(&self) -> &Film {
        &self.film
    }

    /// The camera.
    pub fn sensor(&self) -> &Sensor {
        &self.sensor
    }

    /// BSDFs and textures.
    pub fn materials(&self) -> &Materials {
        &self.materials
    }

    /// A shape's geometry.
    pub fn shape(&self, i: usize) -> &Shape {
        &self.shapes[i]
    }

    /// A shape's id, BSDF and emitter.
    pub fn common(&self, i: usize) -> &Common {
        &self.commons[i]
    }

    /// All emitters, in the description's (stable) order.
    pub fn emitters(&self) -> &[Emitter] {
        &self.emitters
    }

    /// Emitters that escaping rays see.
    pub(crate) fn environments(&self) -> &[usize] {
        &self.environments
    }

    /// Per emitter: the upper end of its interval of the emitter's number, and whether it surrounds the scene.
    pub fn emitter_intervals(&self) -> impl Iterator<Item = (f32, bool)> + '_ {
        let bounds = self.emitter_choice.bounds().iter();
        bounds
            .zip(&self.emitters)
            .map(|(&end, emitter)| (end, emitter.model().is_environment()))
    }

    /// The choice of an emitter by its sampling weight.
    pub fn emitter_choice(&self) -> &Discrete {
        &self.emitter_choice
    }

    pub(crate) fn traits(&self, bsdf: usize) -> BsdfTraits {
        self.traits[bsdf]
    }

    /// The acceleration structure, for measurements of rays alone.
    pub fn accel(&self) -> &embree4::Scene {
        &self.accel
    }

    /// The camera's hit, or what lies behind it where it is on an emitter that the camera must not see.
    #[inline]
    pub(crate) fn behind_emitters(&self, ray: &mut Ray, hit: Hit) -> Option<Hit> {
        if !self.hide_emitters {
            return Some(hit);
        }
        let mut hit = hit;
        loop {
            let si = self.interaction(ray, &hit);
            if self.commons[si.shape as usize].emitter.is_none() {
                return Some(hit);
            }
            // As Mitsuba: a ray from that surface on, without the camera's far plane.
            *ray = si.spawn_ray(Vec3::from_array(ray.dir));
            hit = self.accel.intersect(ray)?;
        }
    }

    /// The surface at a hit.
    #[inline]
    pub fn interaction(&self, ray: &Ray, hit: &Hit) -> Interaction {
        match hit.inst {
            None => {
                let mut si = self.shapes[hit.geom as usize].interaction(ray, hit, Tangents::Wanted);
                si.shape = hit.geom;
                si
            }
            Some(instance) => self.instanced(instance, ray, hit),
        }
    }

    /// The same, without tangents where the BSDF there asks for none.
    #[inline]
    pub(crate) fn shading(&self, ray: &Ray, hit: &Hit) -> Interaction {
        if hit.inst.is_some() || self.traits[self.commons[hit.geom as usize].bsdf].anisotropic {
            return self.interaction(ray, hit);
        }
        let mut si = self.shapes[hit.geom as usize].interaction(ray, hit, Tangents::Unused);
        si.shape = hit.geom;
        si
    }

    /// The emitter on the surface at a hit; groups' shapes are none.
    #[inline]
    pub(crate) fn emitter_at(&self, hit: &Hit) -> Option<usize> {
        match hit.inst {
            None => self.commons[hit.geom as usize].emitter,
            Some(_) => None,
        }
    }

    /// The surface at a hit in an instance's group.
    fn instanced(&self, instance: u32, ray: &Ray, hit: &Hit) -> Interaction {
        let Shape::Instance(instance) = &self.shapes[instance as usize] else {
            return Interaction::default();
        };
        let shape = self.group_starts[instance.group()] + hit.geom as usize;
        let mut si = self.shapes[shape].interaction(&instance.to_group(ray), hit, Tangents::Wanted);
        instance.place(&mut si);
        si.shape = shape as u32;
        si
    }

    /// The nearest surface along a ray.
    #[inline]
    pub fn intersect(&self, ray: &Ray) -> Option<Interaction> {
        self.accel
            .intersect(ray)
            .map(|hit| self.interaction(ray, &hit))
    }

    /// Light drawn from emitter `i` towards a point; `None` where there is none.
    pub fn sample_emitter(
        &self,
        i: usize,
        reference: Vec3,
        u: [f32; 2],
    ) -> Option<emitter::EmitterSample> {
        self.emitters[i]
            .model()
            .sample_direction(self, reference, u)
    }

    /// What a ray from a point sees of emitter `i`: its radiance, and the density of
    /// [`Scene::sample_emitter`] in solid angle. Both are zero where the ray meets something else.
    pub fn eval_emitter(&self, i: usize, origin: [f32; 3], direction: [f32; 3]) -> (Rgb, f32) {
        let emitter = self.emitters[i].model();
        let surface = self.intersect(&Ray::new(origin, direction));
        let meets = match &surface {
            Some(si) => self.commons[si.shape as usize].emitter == Some(i),
            None => emitter.is_environment(),
        };
        if !meets {
            return (Rgb::ZERO, 0.0);
        }
        let (p, d) = (Vec3::from_array(origin), Vec3::from_array(direction));
        (
            emitter.eval(self, d, surface.as_ref()),
            emitter.pdf_direction(self, p, d, surface.as_ref()),
        )
    }

    /// The emitter strategy that must be taken here whatever it costs, and why; `None` where both are right.
    pub fn required_strategy(&self) -> Option<(EmitterStrategy, &'static str)> {
        let hit = |e: &Emitter| e.can_be_hit();
        if !self.emitters.iter().any(hit) {
            return Some((EmitterStrategy::Nee, "no ray can hit an emitter"));
        }
        let blind = "emitter samples alone would miss light";
        let delta = self
            .materials
            .bsdfs
            .iter()
            .any(|b| b.delta(&self.materials));
        let missed = |(i, e): (usize, &Emitter)| {
            e.can_be_hit()
                && (self.emitter_choice.probability(i) <= 0.0 || !e.model().drawn_everywhere())
        };
        if delta {
            Some((
                EmitterStrategy::Mis,
                "a mirror, clear glass or mask is in the scene, and emitter samples alone miss light there",
            ))
        } else if self.emitters.iter().enumerate().any(missed) {
            Some((EmitterStrategy::Mis, blind))
        } else {
            None
        }
    }

    /// Counts and sizes.
    pub fn summary(&self) -> Summary {
        let mut s = Summary::default();
        for shape in &self.shapes {
            s.triangles += shape.model().triangles();
            s.degenerate_triangles += shape.model().degenerate();
            s.geometry_bytes += shape.model().memory();
            *s.shapes.entry(shape.name().to_owned()).or_default() += 1;
        }
        for b in &self.materials.bsdfs {
            *s.bsdfs.entry(b.name().to_owned()).or_default() += 1;
        }
        for e in &self.emitters {
            *s.emitters.entry(e.name().to_owned()).or_default() += 1;
        }
        s.textures = self.materials.textures.len();
        s.texture_bytes = self.materials.textures.iter().map(Texture::memory).sum();
        s.bvh_bytes = self.bvh_bytes;
        s
    }
}
