//! Nets: a small network looks at a vertex (position, normal, outgoing direction) and says how the two numbers of the
//! direction there are distributed.
//!
//! ```text
//! context ─ place ─► inputs ─ network (32-32 units) ─► outputs ─ head ─► q(u₀, u₁ | context)
//! ```
//!
//! `mixture-net`'s head is a mixture of truncated normals (`mixture`). `spline-net` has two networks: one says a monotone
//! spline for u₀, the other, which sees u₀ as well, one for u₁ (`spline`). Networks are evaluated on blocks of rows (`model`)
//! and trained on the second moment of the estimate (`train`). All vertices x₁ … x_{k−1} of a path share them. In a
//! composite it is fitted on f²/g of what the factors before it leave, as every guide is ([`crate::Recipe::fit`]). Learned mixtures
//! for path guiding: Huang et al. 2024, doi:10.1145/3649310; here over primary numbers, so that the BSDF is part of what is learnt.

mod mixture;
mod mlp;
mod model;
pub(crate) mod options;
mod spline;
#[cfg(test)]
mod tests;
mod train;

use serde_json::{Map, Value, json};

use self::mlp::{Mlp, Place};
use self::model::{Model, Packed};
use self::options::{NetOptions, Options};
use self::train::Data;
use crate::file::{self, Contents};
use crate::predict::HeldOut;
use crate::records::Clipped;
use crate::{Context, Decision, Fit, Guide, GuideError, Records};

/// Seconds on one core that a decision, forward and back, takes with the default network, as `examples/guide_cost` shows.
const SECONDS_PER_DECISION: f64 = 1.4e-6;

/// Multiplications of the default `mixture-net`.
const USUAL_PRODUCTS: f64 = 2624.0;

/// Seconds that preparing a path takes, per number of it.
const SECONDS_PER_FEATURES: f64 = 2e-8;

/// Which head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Mixture,
    Spline,
}

impl Kind {
    /// Name in the registry.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Mixture => "mixture-net",
            Self::Spline => "spline-net",
        }
    }

    /// Options with their defaults.
    pub(crate) fn defaults(self) -> Map<String, Value> {
        Options::parse(self, &Map::new()).map_or_else(|_| Map::new(), |options| options.map)
    }

    /// Checks options.
    pub(crate) fn validate(self, given: &Map<String, Value>) -> Result<(), GuideError> {
        Options::parse(self, given).map(drop)
    }

    /// Seconds on one core that a path given costs beside the training: its features and its weight.
    pub(crate) fn seconds_per_path(dims: usize) -> f64 {
        SECONDS_PER_FEATURES * dims as f64
    }

    /// Seconds on one core that training on `rows` paths of `dims` numbers takes: of few, it makes more epochs.
    pub(crate) fn seconds(self, given: &Map<String, Value>, dims: usize, rows: usize) -> f64 {
        let Ok(options) = Options::parse(self, given) else {
            return 0.0;
        };
        let products = |w: Vec<usize>| w.windows(2).map(|w| w[0] * w[1]).sum::<usize>();
        let size: usize = options.widths().into_iter().map(products).sum();
        let size = size as f64 / USUAL_PRODUCTS;
        let vertices = dims.saturating_sub(3) / 2;
        (options.net.seen(rows) * vertices) as f64 * size * SECONDS_PER_DECISION
    }
}

/// A net as a guide.
#[derive(Debug)]
pub(crate) struct NetGuide {
    kind: Kind,
    dims: usize,
    options: Options,
    /// What was met in training.
    facts: Value,
    place: Place,
    model: Model,
    packed: Packed,
}

impl NetGuide {
    fn new(
        kind: Kind,
        dims: usize,
        options: Options,
        facts: Value,
        place: Place,
        model: Model,
    ) -> Self {
        let packed = Packed::new(&model, place.clone());
        Self {
            kind,
            dims,
            options,
            facts,
            place,
            model,
            packed,
        }
    }

    /// Fits a net.
    pub(crate) fn fit(
        kind: Kind,
        given: &Map<String, Value>,
        records: &Records<'_>,
        seed: u64,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Fit, GuideError> {
        let start = std::time::Instant::now();
        let options = Options::parse(kind, given)?;
        let mut stage = |done: f32| progress(done).then_some(()).ok_or(GuideError::Cancelled);
        stage(0.0)?;
        let usable = records.usable(1.0)?;
        stage(0.02)?;
        let rows = Weighted::new(records, &usable.rows, &options.net);
        let vertices = records.columns(Decision::Direction).count();
        let positions: Vec<[f32; 3]> = rows
            .paths
            .iter()
            .flat_map(|&row| (0..vertices).map(move |v| records.context(row, v).position))
            .collect();
        let place = Place::around(&positions, records.bounces());
        stage(0.05)?;
        let data = rows.data(records, &place, vertices);
        stage(0.08)?;
        let mut model = Model::random(&options, seed);
        let mut history = Vec::new();
        if vertices > 0 && !data.weights.is_empty() {
            let mut share = |done: f32| progress(0.1 + 0.9 * done);
            history = train::train(
                kind.name(),
                &options.net,
                &mut model,
                &data,
                seed,
                &mut share,
            )?;
        }
        let samples = rows.paths.len();
        let facts = json!({
            "paths": records.paths(),
            "clipped": rows.clipped,
            "rows": samples,
            "epochs": history.len(),
        });
        progress(1.0).then_some(()).ok_or(GuideError::Cancelled)?;
        let guide = Self::new(kind, records.dims, options, facts, place, model);
        Ok(Fit {
            guide: Box::new(guide),
            history,
            seconds: start.elapsed().as_secs_f64(),
            dropped_nonfinite: usable.nonfinite,
            outliers_removed: 0,
            trained_on: usable.rows.len(),
            samples,
        })
    }

    /// Rebuilds a net from a file.
    pub(crate) fn restore(kind: Kind, contents: Contents) -> Result<Box<dyn Guide>, String> {
        let mut config = contents.config;
        let dims = config["dims"]
            .as_u64()
            .and_then(|d| usize::try_from(d).ok());
        let dims = dims.ok_or("its configuration has no `dims`")?;
        let given = config["options"].take();
        let given = given
            .as_object()
            .ok_or("its configuration has no `options`")?;
        let options = Options::parse(kind, given).map_err(|e| e.to_string())?;
        if let Some((name, ..)) = contents.words.first() {
            return Err(format!("tensor {name:?} belongs to no net"));
        }
        let mut values = file::take(contents.tensors, &names(&options))?;
        if values.iter().flatten().any(|x| !x.is_finite()) {
            return Err("a weight is not a number".to_owned());
        }
        let bounds = values.pop().unwrap_or_default();
        let &[ox, oy, oz, sx, sy, sz] = &bounds[..] else {
            return Err("tensor \"place\" has the wrong size".to_owned());
        };
        let place = Place {
            origin: [ox, oy, oz],
            scale: [sx, sy, sz],
            bounces: dims.saturating_sub(1) / 2,
        };
        let mut values = values.into_iter();
        let net = |widths: Vec<usize>| Mlp {
            tensors: values.by_ref().take(2 * (widths.len() - 1)).collect(),
            widths,
        };
        let nets = options.widths().into_iter().map(net).collect();
        let head = options.head;
        let (model, facts) = (Model { head, nets }, config["facts"].take());
        Ok(Box::new(Self::new(
            kind, dims, options, facts, place, model,
        )))
    }
}

/// All tensors of a file, the box last.
fn names(options: &Options) -> Vec<(String, Vec<usize>)> {
    let widths = options.widths().into_iter().enumerate();
    let nets = widths.flat_map(|(i, w)| Mlp::names(&w, &format!("net.{i}.linear.")));
    nets.chain([("place".to_owned(), vec![6])]).collect()
}

impl Guide for NetGuide {
    fn name(&self) -> &str {
        self.kind.name()
    }

    fn models(&self) -> &[Decision] {
        &[Decision::Direction]
    }

    fn dims(&self) -> usize {
        self.dims
    }

    fn sample(&self, decision: Decision, contexts: &[Context], u: &mut [f32], q: &mut [f32]) {
        if decision != Decision::Direction {
            return q.fill(1.0);
        }
        let rows = q.len().min(u.len() / 2);
        self.packed
            .sample(contexts, &mut u[..2 * rows], &mut q[..rows]);
    }

    fn density(&self, decision: Decision, contexts: &[Context], u: &[f32], q: &mut [f32]) {
        if decision != Decision::Direction {
            return q.fill(1.0);
        }
        let rows = q.len().min(u.len() / 2);
        self.packed
            .density(contexts, &u[..2 * rows], &mut q[..rows]);
    }

    fn mass_outside(&self) -> f64 {
        0.0
    }

    fn parameters(&self) -> usize {
        self.model.nets.iter().map(Mlp::parameters).sum()
    }

    fn describe(&self) -> Value {
        json!({
            "name": self.name(),
            "models": self.models(),
            "dims": self.dims,
            "parameters": self.parameters(),
            "memory": 8 * self.parameters(),
            "paths": self.facts["paths"],
            "rows": self.facts["rows"],
            "epochs": self.facts["epochs"],
            "clipped": self.facts["clipped"],
            "options": self.options.map,
        })
    }

    fn contents(&self) -> Option<Contents> {
        let bounds = self.place.origin.iter().chain(&self.place.scale).copied();
        let tensors = self.model.nets.iter().flat_map(|net| net.tensors.clone());
        let tensors = tensors.chain([bounds.collect()]);
        let names = names(&self.options).into_iter();
        Some(Contents {
            guide: self.name().to_owned(),
            config: json!({
                "dims": self.dims,
                "options": self.options.map,
                "facts": self.facts,
            }),
            tensors: names.zip(tensors).map(|((n, s), v)| (n, s, v)).collect(),
            ..Contents::default()
        })
    }
}

/// Paths to learn from, and their weights.
struct Weighted {
    paths: Vec<usize>,
    weights: Vec<f32>,
    clipped: usize,
}

impl Weighted {
    /// Weights are estimates of ∫f² that the directions can change, relative to the square of the mean in the tile of the
    /// image, as in the prediction of gains: else the network would serve the brightest part of it alone. Clipped at a
    /// quantile and scaled to mean 1.
    fn new(records: &Records<'_>, usable: &[usize], options: &NetOptions) -> Self {
        let stride = usable.len().div_ceil(options.max_rows).max(1);
        let tiles = HeldOut::new(*records);
        let weight = |row: usize| {
            let terms = records.terms(row);
            let relative = tiles.as_ref().map_or(1.0, |t| t.weight(row));
            terms.square() * relative
        };
        let rows = usable.iter().step_by(stride).copied();
        let Clipped { rows, count, .. } = Clipped::new(rows, weight, options.clip_quantile);
        let mean = rows.iter().map(|r| r.1).sum::<f64>() / rows.len().max(1) as f64;
        Self {
            weights: rows.iter().map(|r| (r.1 / mean) as f32).collect(),
            paths: rows.into_iter().map(|r| r.0).collect(),
            clipped: count,
        }
    }

    fn data(&self, records: &Records<'_>, place: &Place, vertices: usize) -> Data {
        let (mut inputs, mut u) = (Vec::new(), Vec::new());
        for &row in &self.paths {
            for vertex in 0..vertices {
                inputs.extend(place.features(&records.context(row, vertex)));
                let at = row * records.dims + 2 * vertex;
                u.extend_from_slice(&records.u[at..at + 2]);
            }
        }
        Data {
            vertices,
            inputs,
            u,
            weights: self.weights.clone(),
        }
    }
}
