//! The main loop: a path camera → x₁ → … → x_k → light as a function of its primary numbers u.
//!
//! For uniform u the pixel's k-bounce radiance is the mean of
//!
//! f(u) = β_k · [ w_nee · f_s · |cos θ| · L_e · V ÷ p_nee  +  w_bsdf · f_s · |cos θ| · L_e ÷ p_bsdf ]
//!
//! with the throughput β_k = Π_{b<k} f_s(x_b)·|cos θ_b| ÷ p_b, p_b the baseline density of the
//! parametrisation, V the visibility, and w the balance heuristic of the baseline densities (Veach 1997),
//! so that f does not depend on any guide. The two terms are returned apart: the first uses the columns
//! 0 … 2k, the second the directions' columns and two of its own, so a guide divides them by different
//! marginals. Dividing is the caller's business: f leaves this module undivided.
//!
//! Blocks of paths go through the stages together (start reading at [`Tracer::trace`]); at each stage the
//! tracer asks a [`NumberSource`] what the stage's numbers shall be. Radiance in W·sr⁻¹·m⁻², linear sRGB.
//! This module draws no number, allocates nothing per path, and knows neither guides nor Python.

use embree4::{Hit, PACKET_WIDTH, Ray};
use serde::{Deserialize, Serialize};

use crate::bsdf::{BsdfSample, ShadingPoint, reuse};
use crate::columns::{Columns, Decision, EmitterStrategy};
use crate::error::TraceError;
use crate::interaction::Interaction;
use crate::math::{Frame, Rgb, Vec3};
use crate::numbers::{Lanes, NumberSource, VertexContext};
use crate::packet::Packet;
use crate::paths::{Paths, State};
use crate::scene::{BsdfTraits, Scene};
use crate::steps::{Join, Step};
use crate::warp::{
    UNIFORM_HEMISPHERE_PDF, cosine_hemisphere_pdf, square_to_cosine_hemisphere,
    square_to_uniform_hemisphere,
};

/// What the two numbers of a direction mean.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Parametrisation {
    /// The BSDF's own importance sampling.
    #[default]
    Bsdf,
    /// A cosine-weighted hemisphere on wi's side, or both sides' where light passes through. Delta lobes are
    /// drawn by the BSDF.
    Cosine,
    /// A uniform hemisphere on wi's side, or both sides' where light passes through. Delta lobes are drawn by
    /// the BSDF.
    Uniform,
}

impl Parametrisation {
    /// The name used in options and hashes.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bsdf => "bsdf",
            Self::Cosine => "cosine",
            Self::Uniform => "uniform",
        }
    }
}

/// A BSDF-sampled ray from x_k under way.
#[derive(Clone, Copy, Default)]
struct Scattered {
    lane: usize,
    /// x_k.
    from: Vec3,
    /// β_k · f_s · |cos θ| ÷ p.
    throughput: Rgb,
    /// p in solid angle; `None` for a delta lobe, which has no rival.
    pdf: Option<f32>,
}

/// Turns numbers into radiance, for one scene and one table of columns.
#[derive(Clone, Copy, Debug)]
pub struct Tracer<'a> {
    scene: &'a Scene,
    columns: Columns,
    parametrisation: Parametrisation,
}

impl<'a> Tracer<'a> {
    /// A tracer for `k` bounces, 1 ≤ k ≤ 32.
    ///
    /// # Errors
    /// [`TraceError::Bounces`].
    pub fn new(
        scene: &'a Scene,
        k: usize,
        parametrisation: Parametrisation,
        strategy: EmitterStrategy,
    ) -> Result<Self, TraceError> {
        if !(1..=32).contains(&k) {
            return Err(TraceError::Bounces(k));
        }
        Ok(Self {
            scene,
            columns: Columns::new(k, strategy),
            parametrisation,
        })
    }

    /// A tracer of what the camera sees shine: light that no surface reflects. It asks for no number.
    pub fn emission(scene: &'a Scene) -> Self {
        Self {
            scene,
            columns: Columns::new(0, EmitterStrategy::Nee),
            parametrisation: Parametrisation::default(),
        }
    }

    /// The table of columns.
    pub fn columns(&self) -> Columns {
        self.columns
    }

    /// The scene.
    pub fn scene(&self) -> &'a Scene {
        self.scene
    }

    /// What a direction's numbers mean.
    pub fn parametrisation(&self) -> Parametrisation {
        self.parametrisation
    }

    /// Traces a block: fills f, q and the flags of `paths` from its film positions and numbers.
    pub fn trace(&self, paths: &mut Paths, numbers: &mut dyn NumberSource) {
        let k = self.columns.k();
        paths.reset();
        if k == 0 {
            self.camera_rays(paths);
            self.seen_emission(paths);
            Self::drop_non_finite(paths);
            return;
        }

        // ---------------- Numbers that are decided before the path is known ----------------
        self.ask(paths, numbers, Decision::Path);
        self.drop_outside(paths);

        // ---------------- Camera → x₁ → … → x_k ----------------
        self.camera_rays(paths);
        for b in 1..=k {
            self.vertices(paths, b);
            self.record_contexts(paths, b);
            if b < k {
                self.ask(paths, numbers, Decision::Direction(b));
                self.scatter(paths, b);
            }
        }
        for &lane in &paths.active {
            paths.found[lane as usize] = true;
        }
        // The BSDF-sampled ray depends on the numbers up to here; the light's come after.
        paths.q_bsdf.copy_from_slice(&paths.q_nee);

        // ---------------- x_k → light: next-event estimation ----------------
        self.ask(paths, numbers, Decision::Emitter);
        self.choose_emitters(paths);
        self.ask(paths, numbers, Decision::Light);
        self.next_event(paths);

        // ---------------- x_k → light: BSDF-sampled ray ----------------
        if self.columns.strategy() == EmitterStrategy::Mis {
            self.ask(paths, numbers, Decision::BsdfRay);
            for (q, q_ray) in paths.q_bsdf.iter_mut().zip(&paths.q_ray) {
                *q *= q_ray;
            }
            self.bsdf_rays(paths);
        }
        Self::drop_non_finite(paths);
    }

    /// Asks the source what a stage's numbers shall be.
    fn ask(&self, paths: &mut Paths, numbers: &mut dyn NumberSource, decision: Decision) {
        if paths.active.is_empty() {
            return;
        }
        paths.stage_contexts.clear();
        if numbers.looks_at(decision) {
            let bounce = match decision {
                Decision::Path => 0,
                Decision::Direction(b) => b,
                Decision::Emitter | Decision::Light | Decision::BsdfRay => self.columns.k(),
            };
            for i in 0..paths.active.len() {
                let context = self.context(paths, paths.active[i] as usize, bounce);
                paths.stage_contexts.push(context);
            }
        }
        numbers.decide(
            decision,
            Lanes {
                active: &paths.active,
                contexts: &paths.stage_contexts,
                u: &mut paths.u,
                width: self.columns.width(),
                columns: self.columns.range(decision),
                // The ray's numbers are no business of next-event estimation.
                q: match decision {
                    Decision::BsdfRay => &mut paths.q_ray,
                    _ => &mut paths.q_nee,
                },
            },
        );
    }

    /// A guide whose prior has no boundary may leave the cube: f is zero out there.
    fn drop_outside(&self, paths: &mut Paths) {
        let learned = self.columns.learned();
        let (u, width) = (&paths.u, self.columns.width());
        paths.active.retain(|&lane| {
            u[lane as usize * width..][..learned]
                .iter()
                .all(|x| (0.0..1.0).contains(x))
        });
    }

    pub(crate) fn camera_rays(&self, paths: &mut Paths) {
        let sensor = self.scene.sensor();
        let (film, lens) = (&paths.film, &paths.lens);
        paths.states.clear();
        paths
            .states
            .extend(film.iter().enumerate().map(|(i, &position)| State {
                ray: sensor.ray(position, lens.get(i).copied().unwrap_or([0.5; 2])),
                throughput: Rgb::ONE,
                si: Interaction::default(),
                frame: Frame::default(),
                wi: Vec3::ZERO,
                emitter: 0,
                emitter_probability: 0.0,
            }));
    }

    /// x_b, by packets. Camera rays are coherent: neighbours in a block are neighbours on the film.
    fn vertices(&self, paths: &mut Paths, b: usize) {
        let (accel, camera) = (self.scene.accel(), b == 1);
        let Paths {
            active,
            states,
            rays: log,
            ..
        } = paths;
        let mut packet = Packet::new();
        let (mut next, mut kept) = (0, 0);
        while next < active.len() {
            for &lane in active[next..].iter().take(PACKET_WIDTH) {
                packet.push(states[lane as usize].ray, lane);
                next += 1;
            }
            if let Some(log) = log {
                log.of(camera).extend_from_slice(packet.rays());
            }
            packet.intersect(accel, camera, |lane, _, hit| {
                let state = &mut states[lane as usize];
                let hit = match hit {
                    Some(hit) if camera => self.scene.behind_emitters(&mut state.ray, hit),
                    hit => hit,
                };
                if let Some(hit) = hit {
                    self.arrive(state, &hit);
                    active[kept] = lane;
                    kept += 1;
                }
            });
        }
        active.truncate(kept);
    }

    /// Sets up shading at a hit.
    #[inline]
    fn arrive(&self, state: &mut State, hit: &Hit) {
        state.si = self.scene.shading(&state.ray, hit);
        // Numbers are measured in a frame of the normal alone, so that neighbours agree; only where the
        // azimuth matters is it the uv frame.
        state.frame = if self.bsdf_traits(state).anisotropic {
            state.si.uv_frame()
        } else {
            Frame::from_normal(state.si.shading_normal)
        };
        state.wi = state.frame.to_local(-Vec3::from_array(state.ray.dir));
    }

    /// x_b → x_{b+1}: a direction from two numbers, and what it does to the throughput.
    fn scatter(&self, paths: &mut Paths, b: usize) {
        let mut kept = 0;
        for i in 0..paths.active.len() {
            let lane = paths.active[i];
            let u = paths.pair(lane as usize, Decision::Direction(b));
            let state = &mut paths.states[lane as usize];
            let Some(sample) = self.sample_direction(state, u) else {
                continue;
            };
            state.throughput *= sample.weight;
            let wo = state.frame.to_world(sample.wo);
            if let Some(steps) = &mut paths.steps {
                steps.scattered[lane as usize * self.columns.k() + b - 1] = Step::new(wo, &sample);
            }
            // A path that reflects nothing has a derivative all the same.
            if state.throughput.max_element() <= 0.0 && paths.steps.is_none() {
                continue;
            }
            state.ray = state.si.spawn_ray(wo);
            paths.active[kept] = lane;
            kept += 1;
        }
        paths.active.truncate(kept);
    }

    /// A direction by the parametrisation's baseline density.
    fn sample_direction(&self, state: &State, u: [f32; 2]) -> Option<BsdfSample> {
        let at = self.shading_point(state);
        let bsdf = self.bsdf(state);
        let traits = self.bsdf_traits(state);
        if self.parametrisation == Parametrisation::Bsdf || !traits.smooth {
            return bsdf.sample(at, state.wi, u);
        }
        // No hemisphere carries delta lobes: the first number chooses them as the BSDF itself would.
        let p_delta = bsdf.delta_probability(at, state.wi);
        if u[0] < p_delta {
            return bsdf.sample_delta(at, state.wi, reuse(u[0], 0.0, p_delta));
        }
        let mut p_side = 1.0 - p_delta;
        let mut u = [reuse(u[0], p_delta, p_side), u[1]];
        let mut side = 1f32.copysign(state.wi.z);
        if traits.transmits {
            // The other side is the second half of the first number.
            let other = u[0] >= 0.5;
            u[0] = reuse(u[0], if other { 0.5 } else { 0.0 }, 0.5);
            side = if other { -side } else { side };
            p_side *= 0.5;
        }
        let (mut wo, pdf) = if self.parametrisation == Parametrisation::Cosine {
            let wo = square_to_cosine_hemisphere(u);
            (wo, p_side * cosine_hemisphere_pdf(wo.z))
        } else {
            (
                square_to_uniform_hemisphere(u),
                p_side * UNIFORM_HEMISPHERE_PDF,
            )
        };
        wo.z *= side;
        if pdf <= 0.0 {
            return None;
        }
        let (value, _) = bsdf.eval_pdf(at, state.wi, wo);
        Some(BsdfSample {
            wo,
            weight: value / pdf,
            pdf,
            delta: false,
        })
    }

    fn choose_emitters(&self, paths: &mut Paths) {
        let column = self.columns.range(Decision::Emitter).start;
        for &lane in &paths.active {
            let u = paths.u[lane as usize * self.columns.width() + column];
            let state = &mut paths.states[lane as usize];
            (state.emitter, state.emitter_probability) =
                match self.scene.emitter_choice().sample_reuse(u) {
                    Some((emitter, probability, _)) => (emitter as u32, probability),
                    None => (0, 0.0),
                };
        }
    }

    /// The first term of f: a point on the chosen emitter, joined to x_k by a shadow ray.
    fn next_event(&self, paths: &mut Paths) {
        let mis = self.columns.strategy() == EmitterStrategy::Mis;
        let accel = self.scene.accel();
        let mut packet = Packet::new();
        for i in 0..paths.active.len() {
            let lane = paths.active[i] as usize;
            let state = &paths.states[lane];
            if state.emitter_probability <= 0.0 || !self.bsdf_traits(state).smooth {
                continue;
            }
            let emitter = self.scene.emitters()[state.emitter as usize].model();
            let u = paths.pair(lane, Decision::Light);
            let Some(light) = emitter.sample_direction(self.scene, state.si.p, u) else {
                continue;
            };
            let wo = state.frame.to_local(light.d);
            let (bsdf_value, p_bsdf) =
                self.bsdf(state)
                    .eval_pdf(self.shading_point(state), state.wi, wo);
            let p_nee = state.emitter_probability * light.pdf;
            let weight = if mis && !light.delta {
                p_nee / (p_nee + p_bsdf)
            } else {
                1.0
            };
            let f = state.throughput * bsdf_value * light.radiance * (weight / p_nee);
            if f == Rgb::ZERO && paths.steps.is_none() {
                continue;
            }
            let join = Join {
                d: light.d.to_array(),
                scale: weight / p_nee,
            };
            let ray = match light.target {
                Some(p) => state.si.spawn_ray_to(p),
                None => state.si.spawn_ray(light.d),
            };
            if let Some(log) = &mut paths.rays {
                log.shadow.push(ray);
            }
            if packet.push(ray, (lane, f, join)) {
                packet.unoccluded(accel, |joined| paths.join(joined));
            }
        }
        packet.unoccluded(accel, |joined| paths.join(joined));
    }

    /// The second term of f: a BSDF-sampled ray from x_k that meets an emitter.
    fn bsdf_rays(&self, paths: &mut Paths) {
        let accel = self.scene.accel();
        let mut packet = Packet::new();
        for i in 0..paths.active.len() {
            let lane = paths.active[i] as usize;
            let state = &paths.states[lane];
            let u = paths.pair(lane, Decision::BsdfRay);
            let Some(sample) = self
                .bsdf(state)
                .sample(self.shading_point(state), state.wi, u)
            else {
                continue;
            };
            let throughput = state.throughput * sample.weight;
            if throughput.max_element() <= 0.0 && paths.steps.is_none() {
                continue;
            }
            let wo = state.frame.to_world(sample.wo);
            let ray = state.si.spawn_ray(wo);
            if let Some(log) = &mut paths.rays {
                log.next.push(ray);
            }
            if let Some(steps) = &mut paths.steps {
                steps.scattered[(lane + 1) * self.columns.k() - 1] = Step::new(wo, &sample);
            }
            let scattered = Scattered {
                lane,
                from: state.si.p,
                throughput,
                pdf: (!sample.delta).then_some(sample.pdf),
            };
            if packet.push(ray, scattered) {
                packet.intersect(accel, false, |s, ray, hit| {
                    paths.arrive(s.lane, self.arriving(&s, ray, hit.as_ref()));
                });
            }
        }
        packet.intersect(accel, false, |s, ray, hit| {
            paths.arrive(s.lane, self.arriving(&s, ray, hit.as_ref()));
        });
    }

    /// What a BSDF-sampled ray brings back from the emitter that it meets, weighted, and the weight.
    fn arriving(&self, from: &Scattered, ray: &Ray, hit: Option<&Hit>) -> (Rgb, f32) {
        let d = Vec3::from_array(ray.dir);
        let brought = |e: usize, surface: Option<&Interaction>| {
            let emitter = self.scene.emitters()[e].model();
            let radiance = emitter.eval(self.scene, d, surface);
            if radiance == Rgb::ZERO {
                return (Rgb::ZERO, 0.0);
            }
            let weight = from.pdf.map_or(1.0, |pdf| {
                let p_nee = self.scene.emitter_choice().probability(e)
                    * emitter.pdf_direction(self.scene, from.from, d, surface);
                pdf / (pdf + p_nee)
            });
            (from.throughput * radiance * weight, weight)
        };
        match hit {
            // Most surfaces shine not at all: their shading is nobody's business then.
            Some(hit) => self.scene.emitter_at(hit).map_or((Rgb::ZERO, 0.0), |e| {
                brought(e, Some(&self.scene.interaction(ray, hit)))
            }),
            None => self
                .scene
                .environments()
                .iter()
                .map(|&e| brought(e, None))
                .fold((Rgb::ZERO, 0.0), |(f, _), (g, weight)| (f + g, weight)),
        }
    }

    /// Radiance that is not finite would spoil its pixel for good: dropped, and counted.
    fn drop_non_finite(paths: &mut Paths) {
        for &lane in &paths.active {
            let lane = lane as usize;
            if !(paths.f_nee[lane] + paths.f_bsdf[lane]).is_finite() {
                paths.f_nee[lane] = Rgb::ZERO;
                paths.f_bsdf[lane] = Rgb::ZERO;
                paths.non_finite += 1;
            }
        }
    }

    fn record_contexts(&self, paths: &mut Paths, b: usize) {
        if !paths.record {
            return;
        }
        for i in 0..paths.active.len() {
            let lane = paths.active[i] as usize;
            paths.contexts[lane * self.columns.k() + b - 1] = self.context(paths, lane, b);
        }
    }

    fn context(&self, paths: &Paths, lane: usize, bounce: usize) -> VertexContext {
        let [width, height] = self.scene.film().crop_size().map(|n| n as f32);
        let [x, y] = paths.film[lane];
        let pixel = [x / width, y / height];
        if bounce == 0 {
            return VertexContext {
                pixel,
                ..Default::default()
            };
        }
        let state = &paths.states[lane];
        VertexContext {
            position: state.si.p.to_array(),
            normal: (state.si.shading_normal * 1f32.copysign(state.wi.z)).to_array(),
            outgoing: (-Vec3::from_array(state.ray.dir)).to_array(),
            pixel,
            emitter: state.emitter,
            bounce: bounce as u32,
        }
    }

    #[inline]
    fn bsdf(&self, state: &State) -> &'a crate::bsdf::Bsdf {
        let id = self.scene.common(state.si.shape as usize).bsdf;
        self.scene.materials().bsdf(id)
    }

    #[inline]
    fn bsdf_traits(&self, state: &State) -> BsdfTraits {
        self.scene
            .traits(self.scene.common(state.si.shape as usize).bsdf)
    }

    #[inline]
    fn shading_point<'s>(&self, state: &'s State) -> ShadingPoint<'s>
    where
        'a: 's,
    {
        ShadingPoint {
            uv: state.si.uv,
            mesh: state.si.mesh_point(),
            materials: self.scene.materials(),
            surface: Some((&state.si, &state.frame)),
        }
    }
}
