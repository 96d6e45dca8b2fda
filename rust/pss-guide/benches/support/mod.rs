//! What the benchmarks and tests of kernels share: records to fit a guide to, a kernel that does nothing but multiply and
//! add, and RealNVP once more in candle.
#![allow(dead_code, reason = "each program takes what it needs")]

pub(crate) mod candle;
pub(crate) mod peak;

use pss_guide::{Context, Decision, Guide, Records};
use pss_rng::{Purpose, Stream};

/// Numbers per path at k = 2.
pub(crate) const DIMS: usize = 5;
/// Vertices of such a path that know where they are.
const VERTICES: usize = 2;
/// Rows per call, as the renderer's blocks.
pub(crate) const BLOCK: usize = 1024;

/// Paths to learn from.
pub(crate) struct Paths {
    u: Vec<f32>,
    f: Vec<f32>,
    g: Vec<f32>,
    pub(crate) contexts: Vec<Context>,
}

impl Paths {
    /// `n` uniform paths, of which two smooth bumps carry light: the cost does not depend on what is learned.
    pub(crate) fn new(n: usize) -> Self {
        let mut numbers = Stream::new(1, Purpose::Test).sequence(0, 0);
        let u: Vec<f32> = (0..n * DIMS).map(|_| numbers.next_f32()).collect();
        let bumps = |u: &[f32]| {
            let bump = |c: f32| (-u.iter().map(|u| (u - c) * (u - c)).sum::<f32>() * 20.0).exp();
            bump(0.3) + bump(0.7)
        };
        let f = u.chunks_exact(DIMS).map(bumps).collect();
        let context = |i: usize| Context {
            position: std::array::from_fn(|_| numbers.next_f32()),
            normal: [0.0, 0.6, 0.8],
            outgoing: [0.0, 0.8, 0.6],
            bounce: (i % VERTICES) as u32 + 1,
            ..Context::default()
        };
        let contexts = (0..n * VERTICES).map(context).collect();
        Self {
            u,
            f,
            g: vec![1.0; n],
            contexts,
        }
    }

    pub(crate) fn records(&self) -> Records<'_> {
        Records {
            dims: DIMS,
            u: &self.u,
            f: &self.f,
            f_max: &self.f,
            g: &self.g,
            contexts: &self.contexts,
            zeros: 0,
            ..Records::default()
        }
    }

    /// Contexts of a block for a guide that looks at them.
    pub(crate) fn places(&self, guide: &dyn Guide, decision: Decision) -> &[Context] {
        if guide.looks_at_contexts(decision) {
            &self.contexts[..BLOCK]
        } else {
            &[]
        }
    }
}

/// Numbers of a decision.
pub(crate) fn width(decision: Decision) -> usize {
    match decision {
        Decision::Path => DIMS,
        Decision::Emitter => 1,
        Decision::Direction | Decision::Light | Decision::Ray => 2,
    }
}

/// `n` uniform numbers.
pub(crate) fn uniform(n: usize, stream: u32) -> Vec<f32> {
    let mut numbers = Stream::new(2, Purpose::Test).sequence(stream, 0);
    (0..n).map(|_| numbers.next_f32()).collect()
}

/// Multiplications of a row by weights that are not masked, for guides that have networks.
pub(crate) fn multiplications(guide: &dyn Guide) -> Option<usize> {
    let told = guide.describe();
    let option = |name: &str| told["options"][name].as_u64().map(|n| n as usize);
    let (hidden, layers) = (option("hidden")?, option("layers")?);
    let net = |inputs, outputs| hidden * (inputs + (layers - 1) * hidden + outputs);
    if let Some(couplings) = option("couplings") {
        let kept = |coupling: usize| (0..DIMS).filter(|i| i % 2 == coupling % 2).count();
        let coupling = |c| 2 * net(kept(c), DIMS - kept(c));
        return Some((0..couplings).map(coupling).sum());
    }
    // Ten numbers tell where a vertex is.
    match (option("components"), option("bins")) {
        (Some(n), _) => Some(net(10, 5 * n)),
        (_, Some(n)) => Some(net(10, 3 * n + 1) + net(11, 3 * n + 1)),
        _ => None,
    }
}
