//! `Scene`: tracing and rendering from Python.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

use numpy::PyReadonlyArray2;
use pss_render::math::Rgb;
use pss_render::{Columns, EmitterStrategy, Parametrisation, Paths, Tracer};
use pssflow::{Budget, Combine, GuideChoice, Mixture, Options, PassPlan};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde::Deserialize;
use serde_json::{Map, Value, json};

use crate::foreign::{ForeignGuide, Guarded};
use crate::guide::{self, Guide};
use crate::watch::watched;
use crate::{arrays, drawn, errors, outcome};

/// A scene that can be traced.
#[pyclass(module = "pssflow._core", frozen)]
pub(crate) struct Scene {
    pub(crate) inner: pss_render::Scene,
    embree: String,
}

/// One device a process: its threads and its library stay anyway.
fn device(search_dirs: Vec<PathBuf>) -> PyResult<embree4::Device> {
    static DEVICE: OnceLock<embree4::Device> = OnceLock::new();
    if let Some(device) = DEVICE.get() {
        return Ok(device.clone());
    }
    embree4::add_search_dirs(&search_dirs);
    let device = embree4::Device::new().map_err(errors::load)?;
    Ok(DEVICE.get_or_init(|| device).clone())
}

/// What Python asks for, as JSON.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Request {
    guide: String,
    #[serde(default)]
    guide_options: Map<String, Value>,
    k: usize,
    parametrisation: String,
    emitter_strategy: String,
    spp: Option<u32>,
    time: Option<f64>,
    #[serde(default)]
    snapshots: Vec<f64>,
    replay: Option<Vec<PassPlan>>,
    #[serde(default = "always")]
    survival: f32,
    uniform_fraction: Option<f32>,
    pilot_spp: Option<u32>,
    keep_pilot: bool,
    #[serde(default)]
    combine: Combine,
    seed: u64,
    threads: usize,
}

fn always() -> f32 {
    1.0
}

/// The longest path length that `Scene.lengths` probes.
#[pyfunction]
pub(crate) fn last_probed(rr_depth: usize) -> usize {
    pssflow::last_probed(rr_depth)
}

pub(crate) fn parametrisation(name: &str) -> PyResult<Parametrisation> {
    match name {
        "bsdf" => Ok(Parametrisation::Bsdf),
        "cosine" => Ok(Parametrisation::Cosine),
        "uniform" => Ok(Parametrisation::Uniform),
        _ => Err(errors::value(format!(
            "parametrisation {name:?} is not known (known: bsdf, cosine, uniform)"
        ))),
    }
}

pub(crate) fn strategy(name: &str) -> PyResult<EmitterStrategy> {
    match name {
        "mis" => Ok(EmitterStrategy::Mis),
        "nee" => Ok(EmitterStrategy::Nee),
        _ => Err(errors::value(format!(
            "emitter_strategy {name:?} is not known (known: mis, nee)"
        ))),
    }
}

#[pymethods]
impl Scene {
    #[new]
    #[pyo3(signature = (description, arrays, search_dirs=Vec::new()))]
    fn new(
        py: Python<'_>,
        description: &str,
        arrays: &Bound<'_, PyAny>,
        search_dirs: Vec<PathBuf>,
    ) -> PyResult<Self> {
        // One by one: what an iterator hands over it need not hold any longer.
        let owned = arrays
            .try_iter()?
            .enumerate()
            .map(|(i, a)| arrays::any(&a?, i))
            .collect::<PyResult<Vec<_>>>()?;
        let device = device(search_dirs)?;
        let (major, minor, patch) = device.version();
        let embree = format!("{major}.{minor}.{patch} ({})", device.library());
        let inner = py
            .detach(|| pss_render::Scene::new(description, owned, &device))
            .map_err(errors::scene)?;
        Ok(Self { inner, embree })
    }

    /// Hash of everything that decides the image.
    #[getter]
    fn hash(&self) -> &str {
        self.inner.hash()
    }

    /// Columns of the crop.
    #[getter]
    fn width(&self) -> u32 {
        self.inner.film().crop_size()[0]
    }

    /// Rows of the crop.
    #[getter]
    fn height(&self) -> u32 {
        self.inner.film().crop_size()[1]
    }

    /// Version and path of Embree.
    #[getter]
    fn embree(&self) -> &str {
        &self.embree
    }

    /// Counts and sizes, JSON.
    fn summary(&self) -> String {
        json!(self.inner.summary()).to_string()
    }

    /// What each column of u decides.
    fn columns(&self, k: usize, emitter_strategy: &str) -> PyResult<Vec<String>> {
        let strategy = strategy(emitter_strategy)?;
        Tracer::new(&self.inner, k, Parametrisation::Bsdf, strategy).map_err(errors::trace)?;
        Ok(Columns::new(k, strategy).names())
    }

    /// Per emitter: the upper end of its interval of the emitter's number, and whether it surrounds the scene.
    fn emitter_intervals(&self) -> Vec<(f32, bool)> {
        self.inner.emitter_intervals().collect()
    }

    /// Hash of the learned columns' meaning.
    fn columns_hash(&self, k: usize, parametrisation: &str) -> PyResult<String> {
        let name = self::parametrisation(parametrisation)?.name();
        Tracer::new(&self.inner, k, Parametrisation::Bsdf, EmitterStrategy::Nee)
            .map_err(errors::trace)?;
        Ok(Columns::new(k, EmitterStrategy::Nee).hash(name))
    }

    /// What `emitter_strategy="auto"` means here, and why.
    #[pyo3(signature = (*, k, parametrisation, threads=0))]
    fn auto_strategy(
        &self,
        py: Python<'_>,
        k: usize,
        parametrisation: &str,
        threads: usize,
    ) -> PyResult<(&'static str, String, Option<f64>)> {
        let parametrisation = self::parametrisation(parametrisation)?;
        let chosen = py
            .detach(|| pssflow::auto_strategy(&self.inner, k, parametrisation, threads))
            .map_err(errors::render)?;
        Ok((chosen.strategy.name(), chosen.reason, chosen.ratio))
    }

    /// Traces one path a row of u.
    #[pyo3(signature = (u, pixels, *, k, parametrisation, emitter_strategy, threads=0))]
    #[allow(clippy::too_many_arguments)]
    fn trace<'py>(
        &self,
        py: Python<'py>,
        u: PyReadonlyArray2<'py, f32>,
        pixels: PyReadonlyArray2<'py, f32>,
        k: usize,
        parametrisation: &str,
        emitter_strategy: &str,
        threads: usize,
    ) -> PyResult<Bound<'py, PyDict>> {
        let tracer = self.tracer(k, parametrisation, emitter_strategy)?;
        let (u, width) = arrays::matrix(&u);
        let (pixels, lens) = film_and_lens(&pixels)?;
        let mut paths = Paths::new(tracer.columns());
        paths.record = true;
        paths.set(&u, width, &pixels).map_err(errors::trace)?;
        paths.lens = lens;
        drop(u);
        let blocks = py
            .detach(|| pssflow::trace_blocks(&tracer, &paths, threads))
            .map_err(errors::render)?;
        traced(py, &blocks, k)
    }

    /// All uniform paths of a pilot.
    #[pyo3(signature = (*, spp, k, parametrisation, emitter_strategy, seed=0, threads=0))]
    #[allow(clippy::too_many_arguments)]
    fn pilot<'py>(
        &self,
        py: Python<'py>,
        spp: u32,
        k: usize,
        parametrisation: &str,
        emitter_strategy: &str,
        seed: u64,
        threads: usize,
    ) -> PyResult<Bound<'py, PyDict>> {
        let tracer = self.tracer(k, parametrisation, emitter_strategy)?;
        self.check_at_once(spp)?;
        let width = tracer.columns().width();
        let (paths, blocks) = py
            .detach(|| {
                let paths = pssflow::uniform_paths(&tracer, seed, spp);
                pssflow::trace_blocks(&tracer, &paths, threads).map(|blocks| (paths, blocks))
            })
            .map_err(errors::render)?;
        let dict = traced(py, &blocks, k)?;
        let pixels = if paths.lens.is_empty() {
            arrays::to_rows2(py, &paths.film)?
        } else {
            let rows = paths.film.iter().zip(&paths.lens);
            let flat = rows.flat_map(|([x, y], [u, v])| [*x, *y, *u, *v]).collect();
            arrays::to_matrix(py, flat, 4)?
        };
        dict.set_item("pixels", pixels)?;
        dict.set_item("g", arrays::to_vector(py, vec![1f32; paths.len()]))?;
        dict.set_item("u", arrays::to_matrix(py, paths.u, width)?)?;
        Ok(dict)
    }

    /// Renders; see the stub for the request and what comes back.
    #[pyo3(signature = (options, guide=None, progress=None))]
    fn render<'py>(
        &self,
        py: Python<'py>,
        options: &str,
        guide: Option<Bound<'py, PyAny>>,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let request: Request = serde_json::from_str(options)
            .map_err(|e| errors::value(format!("render options: {e}")))?;
        let dims = match request.k {
            0 => 0,
            k => {
                let tracer = self.tracer(k, &request.parametrisation, &request.emitter_strategy)?;
                tracer.columns().learned()
            }
        };
        let mut foreign = None;
        let choice = self.choice(&request, dims, guide.as_ref(), &mut foreign)?;
        let options = self.options(&request, choice)?;
        let outcome = watched(py, progress.as_ref(), |shared| {
            let guarded = Guarded {
                progress: shared,
                guide: foreign.as_ref(),
            };
            pssflow::render(&self.inner, &options, &guarded)
        })?;
        // What the foreign guide raised is the cause of whatever else went wrong.
        if let Some(error) = foreign.as_ref().and_then(ForeignGuide::take_error) {
            return Err(error);
        }
        let outcome = outcome.map_err(errors::render)?;
        let object = foreign.and(guide);
        outcome::to_dict(py, outcome, &options, object.as_ref())
    }

    /// What a probe sees of path lengths, each (k, strategy), and the samples per pixel that each gets of `spp`, JSON.
    #[pyo3(signature = (lengths, *, spp, parametrisation, rr_depth=None, threads=0))]
    fn lengths(
        &self,
        py: Python<'_>,
        lengths: Vec<(usize, String)>,
        spp: f64,
        parametrisation: &str,
        rr_depth: Option<usize>,
        threads: usize,
    ) -> PyResult<String> {
        let parametrisation = self::parametrisation(parametrisation)?;
        let lengths = lengths
            .into_iter()
            .map(|(k, name)| Ok((k, strategy(&name)?)))
            .collect::<PyResult<Vec<_>>>()?;
        let probed = py
            .detach(|| {
                pssflow::probe_lengths(&self.inner, &lengths, parametrisation, rr_depth, threads)
            })
            .map_err(errors::render)?;
        let shares = pssflow::allot(&probed, spp, rr_depth);
        let with_share = |(length, spp): (&pssflow::Length, f64)| {
            let mut value = json!(length);
            value["spp"] = json!(spp);
            value
        };
        let values: Vec<Value> = probed.iter().zip(shares).map(with_share).collect();
        Ok(Value::from(values).to_string())
    }

    /// Draws paths as a pass does and returns what each decision came to, in the order of pixels.
    #[pyo3(signature = (
        guide=None, *, uniform_fraction, first_sample, spp, k, parametrisation, emitter_strategy, seed=0, threads=0,
        numbers=false
    ))]
    #[allow(clippy::too_many_arguments)]
    fn draw<'py>(
        &self,
        py: Python<'py>,
        guide: Option<PyRef<'py, Guide>>,
        uniform_fraction: f32,
        first_sample: u32,
        spp: u32,
        k: usize,
        parametrisation: &str,
        emitter_strategy: &str,
        seed: u64,
        threads: usize,
        numbers: bool,
    ) -> PyResult<Bound<'py, PyDict>> {
        let tracer = self.tracer(k, parametrisation, emitter_strategy)?;
        self.check_at_once(spp)?;
        if !(uniform_fraction > 0.0 && uniform_fraction <= 1.0) {
            return Err(errors::value(format!(
                "uniform_fraction = {uniform_fraction}: must be in (0, 1]"
            )));
        }
        let guide = guide.map(|g| Arc::clone(&g.inner));
        if let Some(guide) = &guide {
            let expected = tracer.columns().learned();
            if guide.dims() != expected {
                return Err(errors::value(format!(
                    "guide {:?} models {} columns, but k = {k} bounces have {expected}",
                    guide.name(),
                    guide.dims()
                )));
            }
        }
        let mixture = Mixture { uniform_fraction };
        let blocks = py
            .detach(|| {
                let guide = guide.as_deref().map(|g| (g, mixture));
                pssflow::drawn_blocks(&tracer, guide, seed, (first_sample, spp), threads)
            })
            .map_err(errors::render)?;
        let dict = drawn::to_dict(py, &blocks, mixture, k)?;
        if numbers {
            drawn::set_numbers(py, &dict, &blocks, mixture, tracer.columns().width())?;
        }
        Ok(dict)
    }

    /// Times the Embree queries of a render alone.
    #[pyo3(signature = (*, spp, k, threads=0))]
    fn rays_alone(
        &self,
        py: Python<'_>,
        spp: u32,
        k: usize,
        threads: usize,
    ) -> PyResult<HashMap<&'static str, f64>> {
        let tracer = Tracer::new(&self.inner, k, Parametrisation::Bsdf, EmitterStrategy::Mis)
            .map_err(errors::trace)?;
        self.check_at_once(spp)?;
        let timing = py
            .detach(|| pssflow::rays_alone(&tracer, spp, threads))
            .map_err(errors::render)?;
        Ok(HashMap::from([
            ("seconds", timing.seconds),
            ("rays", timing.rays as f64),
            (
                "rays_per_path",
                timing.rays as f64 / timing.paths.max(1) as f64,
            ),
        ]))
    }
}

/// Paths that are held in memory together, at most.
const MOST_AT_ONCE: u64 = 1 << 28;

impl Scene {
    /// Errors unless all paths of `spp` samples a pixel can be held together.
    fn check_at_once(&self, spp: u32) -> PyResult<()> {
        let paths = self.inner.film().pixels() as u64 * u64::from(spp);
        if (1..=MOST_AT_ONCE).contains(&paths) {
            return Ok(());
        }
        Err(errors::value(format!(
            "spp = {spp} makes {paths} paths at once: must be between 1 and {MOST_AT_ONCE}; trace them in parts"
        )))
    }

    fn tracer(
        &self,
        k: usize,
        parametrisation: &str,
        emitter_strategy: &str,
    ) -> PyResult<Tracer<'_>> {
        Tracer::new(
            &self.inner,
            k,
            self::parametrisation(parametrisation)?,
            strategy(emitter_strategy)?,
        )
        .map_err(errors::trace)
    }

    fn choice(
        &self,
        request: &Request,
        dims: usize,
        guide: Option<&Bound<'_, PyAny>>,
        foreign: &mut Option<ForeignGuide>,
    ) -> PyResult<GuideChoice> {
        let given = || {
            guide.ok_or_else(|| {
                errors::value(format!("guide = {:?} needs a guide object", request.guide))
            })
        };
        match request.guide.as_str() {
            "none" => Ok(GuideChoice::None),
            "ready" => {
                let guide = given()?.extract::<PyRef<'_, Guide>>()?;
                Ok(GuideChoice::Ready(Arc::clone(&guide.inner)))
            }
            "foreign" => {
                let object = ForeignGuide::new(given()?, dims)?;
                *foreign = Some(object.clone());
                Ok(GuideChoice::Learn(Arc::new(object)))
            }
            // Before minutes of pilot, not after.
            name => guide::choice(name, &request.guide_options),
        }
    }

    fn options(&self, request: &Request, guide: GuideChoice) -> PyResult<Options> {
        let budget = match (&request.replay, request.time, request.spp) {
            (Some(passes), _, _) => Budget::Replay(passes.clone()),
            (None, Some(time), _) => Budget::Time(time),
            (None, None, Some(spp)) => Budget::Spp(spp),
            (None, None, None) => {
                return Err(errors::value("one of spp, time and replay must be given"));
            }
        };
        let defaults = Options::default();
        Ok(Options {
            guide,
            k: request.k,
            parametrisation: parametrisation(&request.parametrisation)?,
            strategy: strategy(&request.emitter_strategy)?,
            budget,
            snapshots: request.snapshots.clone(),
            survival: request.survival,
            uniform_fraction: request.uniform_fraction,
            pilot_spp: request.pilot_spp,
            keep_pilot: request.keep_pilot,
            combine: request.combine,
            seed: request.seed,
            threads: request.threads,
            max_records: defaults.max_records,
        })
    }
}

/// Film positions, and the lens' numbers where each row has four.
#[allow(clippy::type_complexity)]
fn film_and_lens(pixels: &PyReadonlyArray2<'_, f32>) -> PyResult<(Vec<[f32; 2]>, Vec<[f32; 2]>)> {
    if numpy::PyUntypedArrayMethods::shape(&**pixels)[1] != 4 {
        return Ok((arrays::rows::<2>(pixels, "pixels")?, Vec::new()));
    }
    let rows = arrays::rows::<4>(pixels, "pixels")?;
    let split = rows.into_iter().map(|[x, y, u, v]| ([x, y], [u, v]));
    Ok(split.unzip())
}

/// Blocks of traced paths as one dictionary of arrays.
pub(crate) fn traced<'py>(
    py: Python<'py>,
    blocks: &[Paths],
    k: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let all = |get: &dyn Fn(&Paths) -> &Vec<Rgb>| -> Vec<Rgb> {
        blocks.iter().flat_map(|b| get(b).iter().copied()).collect()
    };
    let (nee, bsdf) = (all(&|b| &b.f_nee), all(&|b| &b.f_bsdf));
    let sum: Vec<Rgb> = nee.iter().zip(&bsdf).map(|(a, b)| *a + *b).collect();
    let contexts = || blocks.iter().flat_map(|b| &b.contexts);
    let n = sum.len();
    let cube = |get: &dyn Fn(&pss_render::VertexContext) -> [f32; 3]| {
        arrays::to_cube(py, contexts().flat_map(get).collect(), [n, k, 3])
    };
    let dict = PyDict::new(py);
    dict.set_item("f", arrays::to_rows3(py, &sum)?)?;
    dict.set_item("f_nee", arrays::to_rows3(py, &nee)?)?;
    dict.set_item("f_bsdf", arrays::to_rows3(py, &bsdf)?)?;
    let found = blocks
        .iter()
        .flat_map(|b| b.found.iter().copied())
        .collect();
    dict.set_item("found", arrays::to_vector::<bool>(py, found))?;
    dict.set_item("position", cube(&|c| c.position)?)?;
    dict.set_item("normal", cube(&|c| c.normal)?)?;
    dict.set_item("outgoing", cube(&|c| c.outgoing)?)?;
    let pixel: Vec<[f32; 2]> = blocks.iter().flat_map(Paths::pixels).collect();
    dict.set_item("pixel", arrays::to_rows2(py, &pixel)?)?;
    let emitter = blocks.iter().flat_map(Paths::emitters).collect();
    dict.set_item("emitter", arrays::to_vector::<u32>(py, emitter))?;
    Ok(dict)
}
