//! The guides that can be fitted: adding one is a file and a line here; the tests then cover it.

use serde_json::{Map, Value};

use crate::file::Contents;
use crate::flow::{Domain, RealNvp, options::RealNvpOptions};
use crate::net::{Kind as Net, NetGuide};
use crate::table::{Kind, TableGuide};
use crate::vegas::{Vegas, options::VegasOptions};
use crate::{Decision, Fit, Guide, GuideError, Recipe, Records, options};

/// Signature of [`GuideSpec::fit`]: options, data, seed, progress.
pub type FitFn = fn(
    &Map<String, Value>,
    &Records<'_>,
    u64,
    &mut dyn FnMut(f32) -> bool,
) -> Result<Fit, GuideError>;

/// One line of the registry.
#[derive(Debug)]
pub struct GuideSpec {
    /// Name that users type.
    pub name: &'static str,
    /// One line for help texts.
    pub summary: &'static str,
    /// What the guide models.
    pub models: &'static [Decision],
    /// All options with their defaults.
    pub defaults: fn() -> Map<String, Value>,
    /// Checks options without fitting.
    pub validate: fn(&Map<String, Value>) -> Result<(), GuideError>,
    /// Seconds of training that each path costs on one core, roughly, for (options, columns); 0 where it does
    /// not depend on the number of paths. A render under a time budget gives no more paths than it can afford.
    pub seconds_per_path: fn(&Map<String, Value>, usize) -> f64,
    /// Seconds of training on one core that come to it and do not grow with the paths, for (options, columns,
    /// light-carrying paths): a net is shown few paths more often.
    pub seconds: fn(&Map<String, Value>, usize, usize) -> f64,
    /// The defensive mixture's share of uniform paths that suits it when nothing is known of the scene.
    pub uniform_fraction: f32,
    /// What it adds to the cost of a path, in uniform paths: time of a guided pass ÷ time of a uniform one, less one. Most
    /// of it is no arithmetic of the guide: guided paths survive longer and send more rays. Selection uses it, and more
    /// where it measures more.
    pub cost_ratio: f64,
    /// Whether a fit is so cheap (under a microsecond a path, or a second or two in all) that a render may repeat it as its
    /// paths double.
    pub refine: bool,
    /// Fits; see [`fit`].
    pub fit: FitFn,
    /// Rebuilds the guide from a file, or says what does not fit together.
    pub(crate) restore: fn(Contents) -> Result<Box<dyn Guide>, String>,
}

static REGISTRY: &[GuideSpec] = &[
    GuideSpec {
        name: "realnvp",
        summary: "the thesis: RealNVP over all numbers at once, normal prior, samples outside the cube are lost",
        models: &[Decision::Path],
        defaults: || options::to_map(&RealNvpOptions::defaults(Domain::Cube)),
        validate: |o| RealNvpOptions::parse(Domain::Cube, o).map(drop),
        seconds_per_path: |o, d| {
            RealNvpOptions::parse(Domain::Cube, o).map_or(0.0, |o| o.seconds_per_path(d))
        },
        seconds: |_, _, _| 0.0,
        uniform_fraction: 0.25,
        cost_ratio: 4.0,
        refine: false,
        fit: |o, r, s, p| RealNvp::fit(Domain::Cube, o, r, s, p),
        restore: |c| RealNvp::restore(Domain::Cube, c),
    },
    GuideSpec {
        name: "realnvp-logit",
        summary: "the same through a logit, so that every sample lands in the cube",
        models: &[Decision::Path],
        defaults: || options::to_map(&RealNvpOptions::defaults(Domain::Logit)),
        validate: |o| RealNvpOptions::parse(Domain::Logit, o).map(drop),
        seconds_per_path: |o, d| {
            RealNvpOptions::parse(Domain::Logit, o).map_or(0.0, |o| o.seconds_per_path(d))
        },
        seconds: |_, _, _| 0.0,
        uniform_fraction: 0.25,
        cost_ratio: 4.0,
        refine: false,
        fit: |o, r, s, p| RealNvp::fit(Domain::Logit, o, r, s, p),
        restore: |c| RealNvp::restore(Domain::Logit, c),
    },
    GuideSpec {
        name: crate::vegas::NAME,
        summary: "each number by itself: Lepage's VEGAS, a histogram a number for each tile of the image",
        models: &[Decision::Path],
        defaults: || options::to_map(&VegasOptions::default()),
        validate: |o| VegasOptions::parse(o).map(drop),
        seconds_per_path: |_, _| 0.0,
        seconds: |_, _, _| 0.0,
        uniform_fraction: 0.1,
        cost_ratio: 0.5,
        refine: true,
        fit: |o, r, _, p| Vegas::fit(o, r, p),
        restore: Vegas::restore,
    },
    GuideSpec {
        name: Kind::Direction.name(),
        summary: "the direction at each vertex, counted per cell of position and normal",
        models: &[Decision::Direction],
        defaults: || Kind::Direction.defaults(),
        validate: |o| Kind::Direction.validate(o),
        seconds_per_path: |_, _| 0.0,
        seconds: |_, _, _| 0.0,
        uniform_fraction: 0.1,
        cost_ratio: 0.2,
        refine: true,
        fit: |o, r, _, p| TableGuide::fit(Kind::Direction, o, r, p),
        restore: |c| TableGuide::restore(Kind::Direction, c),
    },
    GuideSpec {
        name: Kind::Emitter.name(),
        summary: "which emitter, counted per cell of the last vertex",
        models: &[Decision::Emitter],
        defaults: || Kind::Emitter.defaults(),
        validate: |o| Kind::Emitter.validate(o),
        seconds_per_path: |_, _| 0.0,
        seconds: |_, _, _| 0.0,
        uniform_fraction: 0.1,
        cost_ratio: 0.05,
        refine: true,
        fit: |o, r, _, p| TableGuide::fit(Kind::Emitter, o, r, p),
        restore: |c| TableGuide::restore(Kind::Emitter, c),
    },
    GuideSpec {
        name: Kind::Light.name(),
        summary: "where on the emitter, counted per emitter and cell of the last vertex",
        models: &[Decision::Light],
        defaults: || Kind::Light.defaults(),
        validate: |o| Kind::Light.validate(o),
        seconds_per_path: |_, _| 0.0,
        seconds: |_, _, _| 0.0,
        uniform_fraction: 0.1,
        cost_ratio: 0.1,
        refine: true,
        fit: |o, r, _, p| TableGuide::fit(Kind::Light, o, r, p),
        restore: |c| TableGuide::restore(Kind::Light, c),
    },
    GuideSpec {
        name: Kind::Ray.name(),
        summary: "the BSDF-sampled ray that looks for an emitter, counted per cell of the last vertex",
        models: &[Decision::Ray],
        defaults: || Kind::Ray.defaults(),
        validate: |o| Kind::Ray.validate(o),
        seconds_per_path: |_, _| 0.0,
        seconds: |_, _, _| 0.0,
        uniform_fraction: 0.1,
        cost_ratio: 0.1,
        refine: true,
        fit: |o, r, _, p| TableGuide::fit(Kind::Ray, o, r, p),
        restore: |c| TableGuide::restore(Kind::Ray, c),
    },
    GuideSpec {
        name: Net::Mixture.name(),
        summary: "the direction at each vertex: a network of place, normal and view says a mixture of normals",
        models: &[Decision::Direction],
        defaults: || Net::Mixture.defaults(),
        validate: |o| Net::Mixture.validate(o),
        seconds_per_path: |_, d| Net::seconds_per_path(d),
        seconds: |o, d, n| Net::Mixture.seconds(o, d, n),
        uniform_fraction: 0.25,
        cost_ratio: 0.6,
        refine: true,
        fit: |o, r, s, p| NetGuide::fit(Net::Mixture, o, r, s, p),
        restore: |c| NetGuide::restore(Net::Mixture, c),
    },
    GuideSpec {
        name: Net::Spline.name(),
        summary: "the direction at each vertex: networks of place, normal and view say a spline for each number",
        models: &[Decision::Direction],
        defaults: || Net::Spline.defaults(),
        validate: |o| Net::Spline.validate(o),
        seconds_per_path: |_, d| Net::seconds_per_path(d),
        seconds: |o, d, n| Net::Spline.seconds(o, d, n),
        uniform_fraction: 0.25,
        cost_ratio: 0.6,
        refine: true,
        fit: |o, r, s, p| NetGuide::fit(Net::Spline, o, r, s, p),
        restore: |c| NetGuide::restore(Net::Spline, c),
    },
];

/// All guides that can be fitted. `none`, the uniform density, needs no fit and is the caller's.
pub fn registry() -> &'static [GuideSpec] {
    REGISTRY
}

/// The registry line of `name`.
///
/// # Errors
/// [`GuideError::UnknownGuide`], which lists the known names.
pub fn find(name: &str) -> Result<&'static GuideSpec, GuideError> {
    REGISTRY
        .iter()
        .find(|spec| spec.name == name)
        .ok_or_else(|| GuideError::UnknownGuide {
            name: name.to_owned(),
            known: REGISTRY
                .iter()
                .map(|spec| spec.name)
                .collect::<Vec<_>>()
                .join(", "),
        })
}

/// Fits the guide `name`, or several joined by `+` (see [`Recipe::parse`]), to `records`.
///
/// `options` are written over the guide's defaults. `progress` is called with the share done, a few
/// times per second at least, and cancels by returning false. The result depends on the arguments
/// alone, bit for bit, and not on the number of threads.
///
/// # Errors
/// [`GuideError::UnknownGuide`], [`GuideError::UnknownOption`], [`GuideError::Option`],
/// [`GuideError::Shape`], [`GuideError::TooFewPaths`] with fewer than two usable paths,
/// [`GuideError::Diverged`] when the loss is no longer finite, [`GuideError::Cancelled`].
///
/// # Examples
/// ```
/// use pss_guide::{Decision, Records, fit};
/// // Light arrives only where u₀ < ½.
/// let u: Vec<f32> = (0..4000).flat_map(|i| [(i % 63) as f32 / 126.0, (i % 64) as f32 / 64.0]).collect();
/// let one = vec![1.0; 4000];
/// let records = Records { dims: 2, u: &u, f: &one, f_max: &one, g: &one, zeros: 4000, ..Records::default() };
/// let options = serde_json::json!({ "hidden": 16, "layers": 2 });
/// let fit = fit("realnvp-logit", options.as_object().unwrap(), &records, 1, &mut |_| true)?;
/// let mut q = [0.0; 2];
/// fit.guide.density(Decision::Path, &[], &[0.25, 0.5, 0.75, 0.5], &mut q);
/// assert!(q[0] > 1.0 && q[1] < 1.0);
/// # Ok::<(), pss_guide::GuideError>(())
/// ```
pub fn fit(
    name: &str,
    options: &Map<String, Value>,
    records: &Records<'_>,
    seed: u64,
    progress: &mut dyn FnMut(f32) -> bool,
) -> Result<Fit, GuideError> {
    Recipe::parse(name, options)?.fit(records, seed, progress)
}
