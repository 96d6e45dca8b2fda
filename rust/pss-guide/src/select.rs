//! `auto`: the smallest model that pays, or none.
//!
//! A quarter of the paths so far is held out; candidates are fitted to the rest, and what they would gain is predicted
//! from the quarter (`predict`), for several shares a of uniform paths. Of the gain goes what the guide costs: its
//! share of a path's time, and its training out of what is left of the budget. What passes to come will teach is
//! foreseen: a guide that is refined gains more than the paths so far can show ([`Remaining::refinement`]). Whatever wins
//! is fitted again to all paths; where nothing surely wins, uniform numbers stay, and no path was wasted.
//!
//! A composite's factors are fitted once; every subset of them is a candidate, so factors that do not pay are dropped.

use std::time::Instant;

use serde::Serialize;
use serde_json::{Map, json};

use crate::predict::{Densities, HeldOut};
use crate::records::OwnedRecords;
use crate::{Context, Decision, Fit, Guide, GuideError, Recipe, Records};

/// Shares of uniform paths that are tried.
const FRACTIONS: [f32; 3] = [0.1, 0.25, 0.5];

/// A guide must gain as much, costs deducted, and on the held-out paths the more the fewer these are; see [`least_gain`].
const LEAST_GAIN: f64 = 1.05;

/// A smaller model is taken where it comes as close to the best.
const AS_GOOD: f64 = 0.98;

/// Training may take this share of the time that is left, where it grows with the number of paths and is tried on a part
/// of them.
const MOST_TRAINING: f64 = 0.1;

/// The same where it costs about as much for few paths: it is paid once to look, and again to use what was found.
const MOST_FIXED_TRAINING: f64 = 0.025;

/// Light-carrying paths that are looked at, at most: more would tell little, and the choice must not cost more than it
/// brings.
const MOST_ROWS: usize = 1 << 16;

/// Of `HOLD_OUT` paths, one is held out.
const HOLD_OUT: u64 = 4;

/// Rows that a guide's cost is measured with.
const COST_ROWS: usize = 1 << 14;

/// Seconds that a uniform path is taken to cost where the choice must not depend on the machine.
const NOMINAL_PATH: f64 = 1e-6;

/// What is left to do when a guide is chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Remaining {
    /// Paths still to be rendered, about, if they were uniform.
    pub paths: f64,
    /// Measured cost of a uniform path on one thread, in seconds; `None` where the choice must not depend on the machine:
    /// costs are then the registry's fixed ratios.
    pub seconds_per_path: Option<f64>,
    /// Threads that render.
    pub threads: usize,
    /// Share of the paths that find all their vertices, in [0, 1]: only these ask the guide everything.
    pub found: f64,
}

/// A gain's excess over one grows with the paths learned from by this power, and not beyond this factor. Of twelve scenes
/// with four times the paths, the middle one's grew by a power of .25, the least one's by .17.
const REFINEMENT: (f64, f64) = (0.2, 2.0);

impl Remaining {
    /// How much more a guide that is refined gains over the paths to come than one fitted to `tried` of `paths` so far: it
    /// draws half of all from a fit to the other half, about.
    fn refinement(&self, tried: f64, paths: f64) -> f64 {
        let (power, most) = REFINEMENT;
        let more = 0.5 * (paths + self.paths) / tried.max(1.0);
        more.max(1.0).powf(power).min(most)
    }
}

/// What was thought of a candidate.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CandidateReport {
    /// Its name.
    pub name: String,
    /// The best share of uniform paths in its mixture.
    pub a: f32,
    /// Predicted variance of uniform numbers ÷ that of the mixture, as fitted to the paths so far; 1 for `none`.
    pub predicted_gain: f64,
    /// What the guide adds to the cost of a path, as a share of it.
    pub cost_ratio: f64,
    /// Share of the time that is left that training it takes.
    pub training_share: f64,
    /// The gain that is expected of all paths to come, costs deducted.
    pub net_gain: f64,
    /// Whether it is used.
    pub chosen: bool,
    /// Why, or why not.
    pub why: String,
}

/// What [`select`] came to.
#[derive(Debug)]
pub struct Selection {
    /// What to fit; `None` for uniform numbers.
    pub recipe: Option<Recipe>,
    /// Share of uniform paths in the mixture.
    pub uniform_fraction: f32,
    /// The recipe fitted to all paths.
    pub fit: Option<Fit>,
    /// All that was considered, the best first.
    pub candidates: Vec<CandidateReport>,
}

/// The candidates of `auto`; every subset of a composite's factors is meant, too.
///
/// `mixture-net` and `spline-net` are none: in equal time they lose (ARCHITECTURE.md).
///
/// # Errors
/// None that the registry of this build does not cause.
pub fn candidates() -> Result<Vec<Recipe>, GuideError> {
    let stiff = json!({
        "direction-table": { "kappa": 64.0 },
        "emitter-table": { "kappa": 64.0 },
        "light-table": { "kappa": 64.0 },
        "ray-table": { "kappa": 64.0 },
    });
    let stiff = stiff.as_object().cloned().unwrap_or_default();
    Ok(vec![
        Recipe::parse("table", &Map::new())?,
        Recipe::parse("table", &stiff)?,
    ])
}

/// The candidate of a label that [`select`] gave, for a replay.
pub fn recall(label: &str) -> Option<Recipe> {
    let families = candidates().ok()?;
    families
        .iter()
        .flat_map(Recipe::subsets)
        .find(|recipe| recipe.label() == label)
}

/// Picks a guide for the paths that are left, from the paths so far. The result depends on the arguments alone, bit for
/// bit, unless costs were measured.
///
/// # Errors
/// [`GuideError`] of the fits, but for [`GuideError::TooFewPaths`], which ends in uniform numbers.
pub fn select(
    records: &Records<'_>,
    candidates: &[Recipe],
    remaining: &Remaining,
    seed: u64,
    progress: &mut dyn FnMut(f32) -> bool,
) -> Result<Selection, GuideError> {
    let (fitted_to, held) = split(records);
    let (fitted_to, held) = (fitted_to.view(records), held.view(records));
    // The winner is fitted again to all of them.
    let growth = records.f.len() as f64 / (fitted_to.f.len() as f64).max(1.0);
    let least = least_gain(held.f.len());
    let mut considered = vec![Considered::none()];
    if let Some(held) = HeldOut::new(held) {
        for (i, family) in candidates.iter().enumerate() {
            let family = family.without_idle(records);
            let Some(family) = family.filter(|f| affordable(f, records, remaining)) else {
                continue;
            };
            let share = |done: f32| 0.7 * (i as f32 + done) / candidates.len() as f32;
            let mut progress = |done| progress(share(done));
            match consider(
                &family,
                &fitted_to,
                (growth, records.paths()),
                &held,
                remaining,
                seed,
                &mut progress,
            ) {
                Ok(members) => {
                    for member in members {
                        // Families share factors.
                        if considered
                            .iter()
                            .all(|c| c.report.name != member.report.name)
                        {
                            considered.push(member);
                        }
                    }
                }
                Err(GuideError::TooFewPaths { .. } | GuideError::Diverged { .. }) => {}
                Err(e) => return Err(e),
            }
        }
    }
    considered.sort_by(|x, y| y.report.net_gain.total_cmp(&x.report.net_gain));
    // By what they gain, the most first.
    let mut paying: Vec<usize> = (0..considered.len())
        .filter(|&i| considered[i].pays(least))
        .collect();
    let best = paying
        .first()
        .map_or(1.0, |&i| considered[i].report.net_gain);
    paying.retain(|&i| considered[i].report.net_gain >= AS_GOOD * best);
    let smallest = paying.into_iter().min_by_key(|&i| considered[i].size());
    let none = considered.iter().position(|c| c.recipe.is_none());
    let at = smallest.or(none).unwrap_or(0);
    explain(&mut considered, at, best, least);
    let chosen = &considered[at];
    let mut selection = Selection {
        recipe: chosen.recipe.clone(),
        uniform_fraction: chosen.report.a,
        fit: None,
        candidates: Vec::new(),
    };
    if let Some(recipe) = &selection.recipe {
        selection.fit = Some(recipe.fit(records, seed, &mut |done| progress(0.7 + 0.3 * done))?);
    }
    selection.candidates = considered.into_iter().map(|c| c.report).collect();
    Ok(selection)
}

/// A candidate and what was thought of it.
struct Considered {
    recipe: Option<Recipe>,
    report: CandidateReport,
}

impl Considered {
    fn none() -> Self {
        Self {
            recipe: None,
            report: CandidateReport {
                name: "none".to_owned(),
                a: 1.0,
                predicted_gain: 1.0,
                cost_ratio: 0.0,
                training_share: 0.0,
                net_gain: 1.0,
                chosen: false,
                why: String::new(),
            },
        }
    }

    /// Whether it surely gains, on the held-out paths alone, and is worth its cost with what later passes are foreseen to
    /// teach: foresight multiplies chance, too.
    fn pays(&self, least: f64) -> bool {
        self.report.predicted_gain >= least && self.report.net_gain >= LEAST_GAIN
    }

    /// Number of factors.
    fn size(&self) -> usize {
        self.recipe.as_ref().map_or(0, |r| r.specs().count())
    }
}

/// Fits the factors of a composite, and predicts the gain of all subsets of them; a fit to all rows has `growth` times
/// as many, of so many paths.
fn consider(
    family: &Recipe,
    fitted_to: &Records<'_>,
    (growth, paths): (f64, f64),
    held: &HeldOut<'_>,
    remaining: &Remaining,
    seed: u64,
    progress: &mut dyn FnMut(f32) -> bool,
) -> Result<Vec<Considered>, GuideError> {
    let fits = family.fit_factors(fitted_to, seed, progress)?;
    let densities: Vec<Densities> = fits
        .iter()
        .map(|fit| Densities::of(&*fit.guide, held.records()))
        .collect();
    let costs: Vec<f64> = family
        .specs()
        .zip(&fits)
        .map(|(spec, fit)| cost_ratio(spec.cost_ratio, &*fit.guide, held.records(), remaining))
        .collect();
    let mut members = Vec::new();
    for set in 1..1usize << fits.len() {
        let factors: Vec<usize> = (0..fits.len()).filter(|i| set >> i & 1 == 1).collect();
        let mut q = densities[factors[0]].clone();
        for &i in &factors[1..] {
            q = q.times(&densities[i]);
        }
        let gains = FRACTIONS.map(|a| (a, held.gain(&q, a)));
        let (a, gain) = gains
            .into_iter()
            .fold((1.0, 0.0), |best, g| if g.1 > best.1 { g } else { best });
        let cost_ratio: f64 = factors.iter().map(|&i| costs[i]).sum();
        let recipe = family.subset(&factors);
        let seconds = factors.iter().map(|&i| fits[i].seconds).sum();
        let training_share = training_share(&recipe, fitted_to, growth, seconds, remaining);
        let refinement = if recipe.refines() {
            remaining.refinement(fitted_to.paths(), paths)
        } else {
            1.0
        };
        let expected = gain + (gain - 1.0).max(0.0) * (refinement - 1.0);
        members.push(Considered {
            report: CandidateReport {
                name: recipe.label(),
                a,
                predicted_gain: gain,
                cost_ratio,
                training_share,
                net_gain: expected / (1.0 + cost_ratio) * (1.0 - training_share).max(0.0),
                chosen: false,
                why: String::new(),
            },
            recipe: Some(recipe),
        });
    }
    Ok(members)
}

/// What a guide must gain on a prediction from so many light-carrying paths: the best of many candidates is the one that
/// chance favours, by about so much.
fn least_gain(held: usize) -> f64 {
    LEAST_GAIN + 5.0 / (held.max(1) as f64).sqrt()
}

/// Seconds that the paths which are left take on all threads.
fn seconds_left(remaining: &Remaining) -> f64 {
    let each = remaining.seconds_per_path.unwrap_or(NOMINAL_PATH);
    remaining.paths * each / remaining.threads.max(1) as f64
}

/// Whether training is worth a thought.
fn affordable(recipe: &Recipe, records: &Records<'_>, remaining: &Remaining) -> bool {
    let left = seconds_left(remaining);
    let growing = recipe.seconds_per_path(records.dims) * records.f.len() as f64;
    let fixed = fixed_seconds(recipe, records.dims, records.f.len(), remaining);
    growing <= MOST_TRAINING * left && fixed <= MOST_FIXED_TRAINING * left
}

/// Seconds on all threads of the part of training on `rows` paths that does not grow with them.
fn fixed_seconds(recipe: &Recipe, dims: usize, rows: usize, remaining: &Remaining) -> f64 {
    recipe.seconds(dims, rows) / remaining.threads.max(1) as f64
}

/// Share of the time that is left that fitting to all paths takes, `growth` times those that it was tried on: measured
/// there, or as the registry says.
fn training_share(
    recipe: &Recipe,
    fitted_to: &Records<'_>,
    growth: f64,
    seconds: f64,
    remaining: &Remaining,
) -> f64 {
    let (dims, tried) = (fitted_to.dims, fitted_to.f.len());
    let all = (growth * tried as f64) as usize;
    let [small, large] = [tried, all].map(|rows| fixed_seconds(recipe, dims, rows, remaining));
    let training = match remaining.seconds_per_path {
        // Which part of a measured time grows is not known; where another is expected, it is by far the larger.
        Some(_) if small > 0.0 => seconds * large / small,
        Some(_) => growth * seconds,
        None => recipe.seconds_per_path(dims) * all as f64 + large,
    };
    (training / seconds_left(remaining).max(f64::MIN_POSITIVE)).min(1.0)
}

/// What a guide adds to a path's cost, as a share of it: measured where the path's own cost is.
fn cost_ratio(fixed: f64, guide: &dyn Guide, records: &Records<'_>, remaining: &Remaining) -> f64 {
    let Some(path) = remaining.seconds_per_path else {
        return fixed;
    };
    let rows = records.f.len().min(COST_ROWS);
    if rows == 0 {
        return fixed;
    }
    let mut seconds = 0.0;
    for &decision in guide.models() {
        for (vertex, columns) in records.columns(decision) {
            let mut u: Vec<f32> = (0..rows)
                .flat_map(|row| records.numbers(decision, row, columns.clone()))
                .copied()
                .collect();
            let contexts: Vec<Context> = if guide.looks_at_contexts(decision) {
                (0..rows)
                    .map(|row| records.known(decision, row, vertex))
                    .collect()
            } else {
                Vec::new()
            };
            let mut q = vec![1.0; rows];
            let start = Instant::now();
            guide.sample(decision, &contexts, &mut u, &mut q);
            seconds += start.elapsed().as_secs_f64();
        }
    }
    // The registry's ratio holds what this cannot see: guided paths survive longer and send more rays.
    fixed.max(seconds / rows as f64 * remaining.found / path)
}

/// Puts reasons into words.
fn explain(considered: &mut [Considered], at: usize, best: f64, least: f64) {
    let least_percent = 100.0 * (least - 1.0);
    for (i, c) in considered.iter_mut().enumerate() {
        c.report.chosen = i == at;
        let net = c.report.net_gain;
        let pays = c.pays(least);
        c.report.why = if i == at {
            match c.recipe {
                None => format!("nothing surely gains {least_percent:.0} % and is worth its cost"),
                Some(_) if net < best => "as good as the best, and smaller".to_owned(),
                Some(_) => "the largest gain after its cost".to_owned(),
            }
        } else if c.recipe.is_none() {
            "random numbers, for comparison".to_owned()
        } else if !pays {
            format!("does not surely gain {least_percent:.0} %, or not its cost")
        } else if net >= AS_GOOD * best {
            "no better than a smaller model".to_owned()
        } else {
            format!("{:.0} % below the best", 100.0 * (1.0 - net / best))
        };
    }
}

/// Rows of records that were picked out.
#[derive(Default)]
struct Part {
    rows: OwnedRecords,
    /// Share of all rows that were meant to be picked.
    share: f64,
}

impl Part {
    fn view<'a>(&'a self, records: &Records<'a>) -> Records<'a> {
        let paths = (records.paths() * self.share) as u64;
        let zeros = paths.saturating_sub(self.rows.f.len() as u64);
        self.rows.view(records.dims, records.emitters, zeros)
    }
}

/// The paths to fit to, and those that are held out.
fn split(records: &Records<'_>) -> (Part, Part) {
    let rows = records.f.len();
    let stride = rows.div_ceil(MOST_ROWS).max(1);
    let kept = 1.0 / stride as f64;
    let held_share = kept / HOLD_OUT as f64;
    let (mut fitted_to, mut held) = (Part::default(), Part::default());
    (fitted_to.share, held.share) = (kept - held_share, held_share);
    for (i, row) in (0..rows).step_by(stride).enumerate() {
        // Scrambled, since the samples of a pixel lie next to each other.
        let scrambled = (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32;
        if scrambled.is_multiple_of(HOLD_OUT) {
            held.rows.push(records, row);
        } else {
            fitted_to.rows.push(records, row);
        }
    }
    (fitted_to, held)
}

/// Whether a factor's decision has anything to decide.
pub(crate) fn is_idle(models: &[Decision], records: &Records<'_>) -> bool {
    let idle = |d: &Decision| match d {
        Decision::Direction => records.bounces() < 2,
        Decision::Emitter => records.emitters.len() < 2,
        Decision::Light => records.emitters.is_empty(),
        Decision::Ray => records.ray.is_empty() || records.f_bsdf.iter().all(|&f| f == 0.0),
        Decision::Path => false,
    };
    models.iter().all(idle)
}
