//! Joins guides to the tracer: at each decision, gathers the paths' numbers, asks the guide, puts them back.

use pss_guide::{Context, Decision as GuideDecision, Guide};
use pss_render::numbers::Lanes;
use pss_render::{Decision, NumberSource, VertexContext};

use crate::mixture::Mixture;

/// A guide as a source of numbers for one block of paths.
pub(crate) struct GuidedNumbers<'a> {
    guide: &'a dyn Guide,
    /// Per path of the block: whether its coin chose the guide.
    guided: Vec<bool>,
    scratch: Scratch,
}

/// Reused buffers: nothing is allocated per path.
#[derive(Default)]
struct Scratch {
    lanes: Vec<u32>,
    contexts: Vec<Context>,
    u: Vec<f32>,
    q: Vec<f32>,
}

impl<'a> GuidedNumbers<'a> {
    pub(crate) fn new(guide: &'a dyn Guide) -> Self {
        Self {
            guide,
            guided: Vec::new(),
            scratch: Scratch::default(),
        }
    }

    /// Tosses the block's coins.
    pub(crate) fn toss(&mut self, coins: impl Iterator<Item = f32>, mixture: Mixture) {
        self.guided.clear();
        self.guided.extend(coins.map(|c| mixture.is_guided(c)));
    }

    /// Asks the guide about the lanes whose coin fell on `guided`: to draw numbers, or, for uniform paths,
    /// for the density of those that they have.
    fn ask(&mut self, decision: GuideDecision, lanes: &mut Lanes<'_>, guided: bool) {
        let s = &mut self.scratch;
        s.lanes.clear();
        s.contexts.clear();
        s.u.clear();
        for (i, &lane) in lanes.active.iter().enumerate() {
            if self.guided[lane as usize] != guided {
                continue;
            }
            s.lanes.push(lane);
            let row = lane as usize * lanes.width;
            s.u.extend_from_slice(&lanes.u[row..][lanes.columns.clone()]);
            // One an active path, or none at all where the guide looks at nothing.
            if let Some(c) = lanes.contexts.get(i) {
                s.contexts.push(context(c));
            }
        }
        if s.lanes.is_empty() {
            return;
        }
        s.q.clear();
        s.q.resize(s.lanes.len(), 0.0);
        if guided {
            self.guide.sample(decision, &s.contexts, &mut s.u, &mut s.q);
        } else {
            self.guide.density(decision, &s.contexts, &s.u, &mut s.q);
        }
        let n = lanes.columns.len();
        for (i, &lane) in s.lanes.iter().enumerate() {
            let lane = lane as usize;
            lanes.q[lane] *= s.q[i];
            if guided {
                let row = lane * lanes.width;
                lanes.u[row..][lanes.columns.clone()].copy_from_slice(&s.u[i * n..][..n]);
            }
        }
    }
}

/// A vertex as guides see it.
pub(crate) fn context(c: &VertexContext) -> Context {
    Context {
        position: c.position,
        normal: c.normal,
        outgoing: c.outgoing,
        pixel: c.pixel,
        emitter: c.emitter,
        bounce: c.bounce,
    }
}

/// The guides' name of a decision.
fn guides_name(decision: Decision) -> GuideDecision {
    match decision {
        Decision::Path => GuideDecision::Path,
        Decision::Direction(_) => GuideDecision::Direction,
        Decision::Emitter => GuideDecision::Emitter,
        Decision::Light => GuideDecision::Light,
        Decision::BsdfRay => GuideDecision::Ray,
    }
}

impl NumberSource for GuidedNumbers<'_> {
    fn decide(&mut self, decision: Decision, mut lanes: Lanes<'_>) {
        let decision = guides_name(decision);
        if self.guide.models().contains(&decision) {
            self.ask(decision, &mut lanes, true);
            self.ask(decision, &mut lanes, false);
        }
    }

    fn looks_at(&self, decision: Decision) -> bool {
        let decision = guides_name(decision);
        self.guide.models().contains(&decision) && self.guide.looks_at_contexts(decision)
    }
}
