//! A block of paths, structure of arrays: what the main loop reads and writes.

use embree4::{Hit, PACKET_WIDTH, Ray};

use crate::columns::{Columns, Decision};
use crate::error::TraceError;
use crate::interaction::Interaction;
use crate::math::{Frame, Rgb, Vec3};
use crate::numbers::VertexContext;
use crate::steps::{Join, Steps};

/// A block of paths: what goes in, and what comes out. Structure of arrays, reused block after block.
#[derive(Debug)]
pub struct Paths {
    columns: Columns,
    /// In: film positions in pixels from the crop's corner.
    pub film: Vec<[f32; 2]>,
    /// In: numbers of the lens, two a path; empty without a lens, and for its centre.
    pub lens: Vec<[f32; 2]>,
    /// In: uniform numbers, [`Columns::width`] a path. Out: the numbers that were used.
    pub u: Vec<f32>,
    /// Out: the term of next-event estimation, undivided.
    pub f_nee: Vec<Rgb>,
    /// Out: the term of the BSDF-sampled ray, undivided; zero with `nee`.
    pub f_bsdf: Vec<Rgb>,
    /// Out: density of the numbers that `f_nee` uses.
    pub q_nee: Vec<f32>,
    /// Out: density of the numbers that `f_bsdf` uses.
    pub q_bsdf: Vec<f32>,
    /// Out: the ray's part of `q_bsdf`, so that q_nee·q_ray is the density of all numbers.
    pub q_ray: Vec<f32>,
    /// Out: whether x₁ … x_k all exist.
    pub found: Vec<bool>,
    /// Out, if `record`: contexts of x₁ … x_k, k a path; default where a vertex does not exist.
    pub contexts: Vec<VertexContext>,
    /// In: whether to record contexts.
    pub record: bool,
    /// In and out: where to note every ray, for measuring them alone; `None` costs nothing.
    pub rays: Option<RayLog>,
    /// In and out: where to note what was decided; `None` costs nothing.
    pub steps: Option<Steps>,
    /// Out: paths whose f was not finite and was set to zero.
    pub non_finite: u64,
    pub(crate) active: Vec<u32>,
    pub(crate) states: Vec<State>,
    pub(crate) stage_contexts: Vec<VertexContext>,
}

/// The rays of a block by the kind of query that they were sent through.
#[derive(Clone, Debug, Default)]
pub struct RayLog {
    /// Camera rays, in coherent packets.
    pub camera: Vec<Ray>,
    /// Rays from a surface to the nearest hit, in packets as they come.
    pub next: Vec<Ray>,
    /// Shadow rays.
    pub shadow: Vec<Ray>,
}

impl RayLog {
    /// Where the camera's or later rays go.
    pub(crate) fn of(&mut self, camera: bool) -> &mut Vec<Ray> {
        if camera {
            &mut self.camera
        } else {
            &mut self.next
        }
    }

    /// Number of rays.
    pub fn len(&self) -> usize {
        self.camera.len() + self.next.len() + self.shadow.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Sends them again, as [`crate::Tracer::trace`] does, and returns how many met something.
    pub fn replay(&self, accel: &embree4::Scene) -> u64 {
        let mut met = 0;
        let mut hits: [Option<Hit>; PACKET_WIDTH] = [None; PACKET_WIDTH];
        for (rays, coherent) in [(&self.camera, true), (&self.next, false)] {
            for rays in rays.chunks(PACKET_WIDTH) {
                accel.intersect_packet16(rays, &mut hits[..rays.len()], coherent);
                met += hits[..rays.len()].iter().flatten().count() as u64;
            }
        }
        let mut blocked = [false; PACKET_WIDTH];
        for rays in self.shadow.chunks(PACKET_WIDTH) {
            accel.occluded_packet16(rays, &mut blocked[..rays.len()], false);
            met += blocked[..rays.len()].iter().filter(|&&b| b).count() as u64;
        }
        met
    }
}

/// Where a path stands.
#[derive(Clone, Copy, Debug)]
pub(crate) struct State {
    pub(crate) ray: Ray,
    /// β: product of f_s·|cos θ| ÷ p so far.
    pub(crate) throughput: Rgb,
    pub(crate) si: Interaction,
    pub(crate) frame: Frame,
    /// Local direction back along the path.
    pub(crate) wi: Vec3,
    pub(crate) emitter: u32,
    pub(crate) emitter_probability: f32,
}

impl Paths {
    /// An empty block for the given columns.
    pub fn new(columns: Columns) -> Self {
        Self {
            columns,
            film: Vec::new(),
            lens: Vec::new(),
            u: Vec::new(),
            f_nee: Vec::new(),
            f_bsdf: Vec::new(),
            q_nee: Vec::new(),
            q_bsdf: Vec::new(),
            q_ray: Vec::new(),
            found: Vec::new(),
            contexts: Vec::new(),
            record: false,
            rays: None,
            steps: None,
            non_finite: 0,
            active: Vec::new(),
            states: Vec::new(),
            stage_contexts: Vec::new(),
        }
    }

    /// Number of paths.
    pub fn len(&self) -> usize {
        self.film.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.film.is_empty()
    }

    /// f(u) of path `i`, both terms.
    pub fn f(&self, i: usize) -> Rgb {
        self.f_nee[i] + self.f_bsdf[i]
    }

    /// Takes numbers from outside, checked.
    ///
    /// # Errors
    /// [`TraceError`] where the shape of `u` or a value in it is wrong.
    pub fn set(&mut self, u: &[f32], width: usize, film: &[[f32; 2]]) -> Result<(), TraceError> {
        let expected = self.columns.width();
        if width != expected {
            return Err(TraceError::Columns {
                found: width,
                expected,
                k: self.columns.k(),
                strategy: self.columns.strategy().name(),
                columns: self.columns.names().join(", "),
            });
        }
        if film.len() * width != u.len() {
            return Err(TraceError::Rows {
                found: film.len(),
                expected: u.len() / width,
            });
        }
        if let Some(i) = u.iter().position(|x| !(0.0..1.0).contains(x)) {
            return Err(TraceError::Range {
                row: i / width,
                column: i % width,
                value: u[i],
            });
        }
        self.u.clear();
        self.u.extend_from_slice(u);
        self.film.clear();
        self.film.extend_from_slice(film);
        self.lens.clear();
        Ok(())
    }

    /// Film positions in [0, 1)² of a traced block that recorded its contexts.
    pub fn pixels(&self) -> impl Iterator<Item = [f32; 2]> + '_ {
        self.contexts
            .chunks_exact(self.columns.k())
            .map(|c| c[0].pixel)
    }

    /// The emitter that each path of a traced block chose.
    pub fn emitters(&self) -> impl Iterator<Item = u32> + '_ {
        self.states.iter().map(|s| s.emitter)
    }

    /// The emitter that path `i` of a traced block chose.
    pub fn emitter(&self, i: usize) -> u32 {
        self.states[i].emitter
    }

    pub(crate) fn reset(&mut self) {
        let n = self.film.len();
        self.f_nee.clear();
        self.f_nee.resize(n, Rgb::ZERO);
        self.f_bsdf.clear();
        self.f_bsdf.resize(n, Rgb::ZERO);
        self.q_nee.clear();
        self.q_nee.resize(n, 1.0);
        self.q_bsdf.clear();
        self.q_bsdf.resize(n, 1.0);
        self.q_ray.clear();
        self.q_ray.resize(n, 1.0);
        self.found.clear();
        self.found.resize(n, false);
        self.active.clear();
        self.active.extend(0..n as u32);
        self.contexts.clear();
        if self.record {
            self.contexts
                .resize(n * self.columns.k(), VertexContext::default());
        }
        if let Some(steps) = &mut self.steps {
            steps.reset(n, self.columns.k());
        }
        self.non_finite = 0;
    }

    /// A light was joined: no surface is in between.
    pub(crate) fn join(&mut self, (lane, f, join): (usize, Rgb, Join)) {
        self.f_nee[lane] = f;
        if let Some(steps) = &mut self.steps {
            steps.joins[lane] = join;
        }
    }

    /// A BSDF-sampled ray has met what it met.
    pub(crate) fn arrive(&mut self, lane: usize, (f, weight): (Rgb, f32)) {
        self.f_bsdf[lane] = f;
        if let Some(steps) = &mut self.steps {
            steps.mis[lane] = weight;
        }
    }

    /// The numbers of a two-number decision.
    pub(crate) fn pair(&self, lane: usize, decision: Decision) -> [f32; 2] {
        let at = lane * self.columns.width() + self.columns.range(decision).start;
        [self.u[at], self.u[at + 1]]
    }
}
