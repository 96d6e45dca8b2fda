//! What is to be fitted: one line of the registry, or several joined by `+`, with their options.

use serde_json::{Map, Value};

use crate::composite::Composite;
use crate::predict::Densities;
use crate::registry::{self, GuideSpec};
use crate::select::is_idle;
use crate::{Decision, Fit, Guide, GuideError, Records};

/// Names that stand for a composite.
pub const ALIASES: [(&str, &str); 1] = [(
    "table",
    "direction-table+emitter-table+light-table+ray-table",
)];

/// Share of uniform paths that a factor assumes in the mixture when it looks past the factors before it.
const DEFENSIVE: f32 = 0.1;

/// Bytes that the factors of a composite share: as many as a guide alone may take by default.
const SHARED: u64 = (crate::options::MEMORY_MIB as u64) << 20;

/// What of [`SHARED`] is kept for each factor that is still to be fitted.
const RESERVED: u64 = SHARED / 8;

/// Option of guides that bound their memory, in MiB.
const MEMORY: &str = "memory_mib";

/// One guide, or a product of guides that model different decisions.
#[derive(Clone, Debug)]
pub struct Recipe {
    name: String,
    factors: Vec<(&'static GuideSpec, Map<String, Value>)>,
}

impl Recipe {
    /// Understands `name`, a registry line, several joined by `+`, or one of [`ALIASES`], and checks the options:
    /// those of the guide itself, or for a composite one object a factor, by the factor's name. Factors that are not
    /// told `memory_mib` share 256 MiB.
    ///
    /// # Errors
    /// [`GuideError::UnknownGuide`], [`GuideError::UnknownOption`], [`GuideError::Option`], and
    /// [`GuideError::Overlap`] where two factors model the same decision.
    pub fn parse(name: &str, options: &Map<String, Value>) -> Result<Self, GuideError> {
        let alias = ALIASES.iter().find(|(alias, _)| *alias == name);
        let parts: Vec<&str> = alias.map_or(name, |(_, parts)| parts).split('+').collect();
        let mut factors: Vec<(&'static GuideSpec, Map<String, Value>)> = Vec::new();
        for part in &parts {
            let spec = registry::find(part)?;
            if let Some((other, _)) = factors.iter().find(|(f, _)| overlap(f.models, spec.models)) {
                return Err(GuideError::Overlap {
                    name: name.to_owned(),
                    first: other.name,
                    second: spec.name,
                });
            }
            let own = if parts.len() == 1 {
                options.clone()
            } else {
                part_options(spec, options)?
            };
            (spec.validate)(&own)?;
            factors.push((spec, own));
        }
        if let Some(stranger) = options
            .keys()
            .find(|key| parts.len() > 1 && !parts.contains(&key.as_str()))
        {
            return Err(GuideError::UnknownOption {
                guide: name.to_owned(),
                option: stranger.clone(),
                known: parts.join(", "),
            });
        }
        Ok(Self {
            name: name.to_owned(),
            factors,
        })
    }

    /// As asked for.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Registry lines of the factors.
    pub fn specs(&self) -> impl Iterator<Item = &'static GuideSpec> + '_ {
        self.factors.iter().map(|(spec, _)| *spec)
    }

    /// Seconds of training that each path costs on one core, roughly.
    pub fn seconds_per_path(&self, dims: usize) -> f64 {
        let each =
            |(spec, options): &(&GuideSpec, Map<_, _>)| (spec.seconds_per_path)(options, dims);
        self.factors.iter().map(each).sum()
    }

    /// Seconds of training on one core that come to it and do not grow with the paths; see [`GuideSpec::seconds`].
    pub fn seconds(&self, dims: usize, rows: usize) -> f64 {
        let each = |(spec, options): &(&GuideSpec, Map<_, _>)| (spec.seconds)(options, dims, rows);
        self.factors.iter().map(each).sum()
    }

    /// The largest of its factors' shares of uniform paths.
    pub fn uniform_fraction(&self) -> f32 {
        self.specs().map(|s| s.uniform_fraction).fold(0.0, f32::max)
    }

    /// Whether all its factors may be fitted again and again; see [`GuideSpec::refine`].
    pub fn refines(&self) -> bool {
        self.specs().all(|s| s.refine)
    }

    /// Whether any of its factors wants to know where a path is.
    pub fn looks_at_contexts(&self) -> bool {
        self.specs().any(|s| s.models != [Decision::Path])
    }

    /// What its factors together add to the cost of a path; see [`GuideSpec::cost_ratio`].
    pub fn cost_ratio(&self) -> f64 {
        self.specs().map(|s| s.cost_ratio).sum()
    }

    /// Fits the factors one after the other, each to what those before it leave: paths count with f²/g of the
    /// density that they would have had in a mixture with the factors so far.
    ///
    /// # Errors
    /// As [`crate::fit`].
    pub fn fit(
        &self,
        records: &Records<'_>,
        seed: u64,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Fit, GuideError> {
        if let [(spec, options)] = &self.factors[..] {
            return (spec.fit)(options, records, seed, progress);
        }
        let start = std::time::Instant::now();
        let fitted = self.fit_factors(records, seed, progress)?;
        Ok(Fit {
            history: Vec::new(),
            seconds: start.elapsed().as_secs_f64(),
            dropped_nonfinite: fitted
                .iter()
                .map(|f| f.dropped_nonfinite)
                .max()
                .unwrap_or(0),
            outliers_removed: fitted.iter().map(|f| f.outliers_removed).max().unwrap_or(0),
            trained_on: fitted.iter().map(|f| f.trained_on).max().unwrap_or(0),
            samples: fitted.iter().map(|f| f.samples).max().unwrap_or(0),
            guide: Box::new(Composite::new(
                fitted
                    .into_iter()
                    .map(|f| f.guide)
                    .collect::<Vec<Box<dyn Guide>>>(),
                records.dims,
            )),
        })
    }

    /// Fits the factors one after the other; see [`Recipe::fit`].
    pub(crate) fn fit_factors(
        &self,
        records: &Records<'_>,
        seed: u64,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Vec<Fit>, GuideError> {
        let rows = records.f.len();
        let mut drawn = [records.g, records.g_bsdf, records.g_both].map(<[f32]>::to_vec);
        let (mut q, mut fitted) = (Densities::one(rows), Vec::<Fit>::new());
        let mut left = SHARED;
        for (i, (spec, options)) in self.factors.iter().enumerate() {
            let [g, g_bsdf, g_both] = &drawn;
            let seen = Records {
                g,
                g_bsdf,
                g_both,
                ..*records
            };
            let share = |done: f32| (i as f32 + done) / self.factors.len() as f32;
            let (mut options, told) = (options.clone(), options.contains_key(MEMORY));
            if bounded(spec) && !told {
                let later = self.factors[i + 1..].iter().filter(|f| bounded(f.0));
                let most = left.saturating_sub(RESERVED * later.count() as u64);
                options.insert(MEMORY.to_owned(), (most >> 20).into());
            }
            let fit = (spec.fit)(&options, &seen, seed, &mut |done| progress(share(done)))?;
            if !told {
                let used = fit.guide.describe()["memory"].as_u64();
                left = left.saturating_sub(used.unwrap_or(0));
            }
            if i + 1 < self.factors.len() {
                q = q.times(&Densities::of(&*fit.guide, records));
                let mixed = |q: f32| DEFENSIVE + (1.0 - DEFENSIVE) * q;
                drawn = std::array::from_fn(|part| {
                    let q = [&q.nee, &q.bsdf, &q.both][part];
                    let all = (0..rows).map(|row| records.densities(row)[part] * mixed(q[row]));
                    all.collect()
                });
            }
            fitted.push(fit);
        }
        Ok(fitted)
    }

    /// Some of the factors, in order.
    pub(crate) fn subset(&self, factors: &[usize]) -> Self {
        let factors: Vec<_> = factors.iter().map(|&i| self.factors[i].clone()).collect();
        let names: Vec<&str> = factors.iter().map(|(spec, _)| spec.name).collect();
        Self {
            name: names.join("+"),
            factors,
        }
    }

    /// All subsets of the factors but the empty one.
    pub(crate) fn subsets(&self) -> impl Iterator<Item = Self> + '_ {
        let n = self.factors.len();
        (1..1usize << n).map(move |set| {
            let factors: Vec<usize> = (0..n).filter(|i| set >> i & 1 == 1).collect();
            self.subset(&factors)
        })
    }

    /// The factors that have something to decide in the paths' scene; `None` if none has.
    pub(crate) fn without_idle(&self, records: &Records<'_>) -> Option<Self> {
        let busy = |i: &usize| !is_idle(self.factors[*i].0.models, records);
        let factors: Vec<usize> = (0..self.factors.len()).filter(busy).collect();
        (!factors.is_empty()).then(|| self.subset(&factors))
    }

    /// The name, with the options that were set.
    pub fn label(&self) -> String {
        let mut set: Vec<String> = self
            .factors
            .iter()
            .flat_map(|(_, options)| options.iter().map(|(k, v)| format!("{k}={v}")))
            .collect();
        set.dedup();
        if set.is_empty() {
            self.name.clone()
        } else {
            format!("{} ({})", self.name, set.join(", "))
        }
    }
}

/// Whether a guide bounds its memory by an option.
fn bounded(spec: &GuideSpec) -> bool {
    (spec.defaults)().contains_key(MEMORY)
}

/// A guide over the whole path models every other decision, too.
fn overlap(a: &[Decision], b: &[Decision]) -> bool {
    a.contains(&Decision::Path) || b.contains(&Decision::Path) || a.iter().any(|d| b.contains(d))
}

fn part_options(
    spec: &'static GuideSpec,
    options: &Map<String, Value>,
) -> Result<Map<String, Value>, GuideError> {
    match options.get(spec.name) {
        None => Ok(Map::new()),
        Some(Value::Object(own)) => Ok(own.clone()),
        Some(other) => Err(crate::options::bad(
            spec.name,
            spec.name,
            other,
            "in a composite, an object of this factor's options",
        )),
    }
}
