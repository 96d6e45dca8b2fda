//! Data, fits and statistics that the tests share.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock};

use pss_guide::{Context, Decision, Fit, Guide, GuideSpec, Header, Records, fit, registry};
use pss_rng::{Purpose, Stream};
use serde_json::{Map, Value};

use crate::world::{self, World};

/// What the tests' files claim to be fitted for.
pub(crate) fn header() -> Header {
    Header {
        columns_hash: "columns-1".to_owned(),
        scene_hash: "scene-1".to_owned(),
    }
}

pub(crate) fn options(list: &[(&str, Value)]) -> Map<String, Value> {
    list.iter()
        .map(|(name, value)| ((*name).to_owned(), value.clone()))
        .collect()
}

/// `n` rows of uniform numbers.
pub(crate) fn uniform(n: usize, dims: usize, stream: u32) -> Vec<f32> {
    let mut numbers = Stream::new(21, Purpose::Test).sequence(stream, dims as u32);
    (0..n * dims).map(|_| numbers.next_f32()).collect()
}

/// Records of two paths, for tests that never get to look at them.
pub(crate) fn two_paths() -> Records<'static> {
    Records {
        dims: 1,
        u: &[0.25, 0.75],
        f: &[1.0; 2],
        f_max: &[1.0; 2],
        g: &[1.0; 2],
        zeros: 0,
        ..Records::default()
    }
}

/// Records of paths of the density `g`, f being their largest component as well.
pub(crate) fn records<'a>(dims: usize, u: &'a [f32], f: &'a [f32], g: &'a [f32]) -> Records<'a> {
    Records {
        dims,
        u,
        f,
        f_max: f,
        g,
        ..Records::default()
    }
}

/// A contribution with a known integral: Π over the columns of 30 u² (1 − u)² where the first column is
/// below 3/4, and 0 beyond, as if something stood in the way there.
#[derive(Clone, Copy)]
pub(crate) struct Target {
    pub(crate) dims: usize,
}

impl Target {
    pub(crate) fn f(&self, u: &[f32]) -> f32 {
        if u[0] >= 0.75 {
            return 0.0;
        }
        u.iter()
            .map(|u| 30.0 * u * u * (1.0 - u) * (1.0 - u))
            .product()
    }

    /// Each column's integral is 1; the first one's ends at x = 3/4: 10x³ − 15x⁴ + 6x⁵.
    pub(crate) fn integral(&self) -> f64 {
        let x = 0.75f64;
        10.0 * x.powi(3) - 15.0 * x.powi(4) + 6.0 * x.powi(5)
    }

    /// Uniform paths and their contributions, zeros among them.
    pub(crate) fn paths(&self, n: usize, stream: u32) -> (Vec<f32>, Vec<f32>) {
        let u = uniform(n, self.dims, 100 + stream);
        let f = u.chunks_exact(self.dims).map(|u| self.f(u)).collect();
        (u, f)
    }
}

/// Whether a guide models whole paths, and is fitted to [`Target`]; others are fitted to a [`World`].
pub(crate) fn is_whole(name: &str) -> bool {
    pss_guide::find(name)
        .unwrap()
        .models
        .contains(&Decision::Path)
}

/// The registry's lines whose fit takes epochs.
pub(crate) fn trained() -> impl Iterator<Item = &'static GuideSpec> {
    registry()
        .iter()
        .filter(|spec| (spec.defaults)().contains_key("epochs"))
}

/// Options that make training short where there is training.
pub(crate) fn epochs(name: &str, n: u32) -> Map<String, Value> {
    let trained = trained().any(|spec| spec.name == name);
    let list = [("epochs", n.into())];
    options(if trained { &list } else { &[] })
}

/// A guide fitted to `n` uniform paths; `dims` is odd unless it models whole paths.
pub(crate) fn fit_with(
    name: &str,
    dims: usize,
    n: usize,
    options: Map<String, Value>,
    seed: u64,
) -> Fit {
    if !is_whole(name) {
        let world = World {
            k: (dims - 1) / 2,
            ..World::DEFAULT
        };
        let paths = world.draw(n, None, 0);
        return fit(name, &options, &paths.records(), seed, &mut |_| true).unwrap();
    }
    let (u, f) = Target { dims }.paths(n, 0);
    let g = vec![1.0; n];
    let pixels = uniform(n, 2, 200);
    let records = Records {
        pixel: pixels.as_chunks().0,
        ..records(dims, &u, &f, &g)
    };
    fit(name, &options, &records, seed, &mut |_| true).unwrap()
}

/// One decision of a guide, at one place.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Case {
    pub(crate) decision: Decision,
    pub(crate) width: usize,
    place: Option<Context>,
}

impl Case {
    /// The place for `n` rows.
    pub(crate) fn contexts(&self, n: usize) -> Vec<Context> {
        self.place.map_or(Vec::new(), |c| vec![c; n])
    }

    pub(crate) fn sample(&self, guide: &dyn Guide, u: &mut [f32], q: &mut [f32]) {
        guide.sample(self.decision, &self.contexts(q.len()), u, q);
    }

    pub(crate) fn density(&self, guide: &dyn Guide, u: &[f32], q: &mut [f32]) {
        guide.density(self.decision, &self.contexts(q.len()), u, q);
    }
}

/// All decisions of a guide, each at several places.
pub(crate) fn cases(guide: &dyn Guide) -> Vec<Case> {
    let mut list = Vec::new();
    for &decision in guide.models() {
        let width = match decision {
            Decision::Path => guide.dims(),
            Decision::Emitter => 1,
            Decision::Direction | Decision::Light | Decision::Ray => 2,
        };
        let case = |place| Case {
            decision,
            width,
            place,
        };
        if guide.looks_at_contexts(decision) {
            list.extend(
                world::places(&World::DEFAULT, decision)
                    .into_iter()
                    .map(|c| case(Some(c))),
            );
        } else {
            list.push(case(None));
        }
    }
    list
}

/// Samples and densities of every case, bit for bit.
pub(crate) fn fingerprint(guide: &dyn Guide) -> Vec<u32> {
    let mut bits = Vec::new();
    for case in cases(guide) {
        let (mut u, mut q) = (uniform(500, case.width, 5), vec![0.0; 500]);
        case.sample(guide, &mut u, &mut q);
        bits.extend(u.iter().chain(&q).map(|x| x.to_bits()));
        case.density(guide, &uniform(500, case.width, 4), &mut q);
        bits.extend(q.iter().map(|x| x.to_bits()));
    }
    bits
}

/// The default fit of the tests, made once in each process.
pub(crate) fn fit_small(name: &'static str, dims: usize) -> Arc<Fit> {
    type Made = Mutex<BTreeMap<(&'static str, usize), Arc<OnceLock<Arc<Fit>>>>>;
    static MADE: Made = Mutex::new(BTreeMap::new());
    let cell = MADE
        .lock()
        .unwrap()
        .entry((name, dims))
        .or_default()
        .clone();
    cell.get_or_init(|| {
        Arc::new(fit_with(
            name,
            dims,
            if is_whole(name) { 6000 } else { 20_000 },
            sharp(name),
            1,
        ))
    })
    .clone()
}

/// Options with which few paths make a table that is far from uniform, so that a wrong sampler shows.
fn sharp(name: &str) -> Map<String, Value> {
    let mut options = Map::new();
    if name.ends_with("-table") {
        options.insert("kappa".to_owned(), Value::from(8.0));
    }
    options
}

/// Mean and its standard error.
pub(crate) fn mean(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (mut n, mut mean, mut square) = (0.0, 0.0, 0.0);
    for x in values {
        n += 1.0;
        let delta = x - mean;
        mean += delta / n;
        square += delta * (x - mean);
    }
    (mean, (square / (n - 1.0) / n).sqrt())
}

/// p-value of Pearson's χ² over 16 cells along each of one or two numbers and the outside, 200,000 samples against the
/// integrated density; a share `wrong` of the samples is replaced by uniform numbers.
pub(crate) fn chi_square(guide: &dyn Guide, case: Case, wrong: f64) -> f64 {
    const CELLS: usize = 16;
    let (n, width) = (200_000, case.width);
    // Bins whose borders are anywhere: points within their squares at random, so that what one misses another finds.
    let jittered = ["vegas", "spline-net"].contains(&guide.name());
    let inner = match width {
        1 => 2000,
        _ if jittered => 64,
        _ => 8,
    };
    let all = CELLS.pow(width as u32);
    let base = uniform(n, width, 7);
    let (mut u, mut q) = (base.clone(), vec![0.0; n]);
    case.sample(guide, &mut u, &mut q);
    let replaced = (wrong * n as f64) as usize * width;
    u[..replaced].copy_from_slice(&base[..replaced]);
    let mut counts = vec![0.0; all + 1];
    for u in u.chunks_exact(width) {
        let inside = u.iter().all(|u| (0.0..1.0).contains(u));
        let cell = u
            .iter()
            .rev()
            .fold(0, |i, u| i * CELLS + (u * CELLS as f32) as usize);
        counts[if inside { cell } else { all }] += 1.0;
    }

    let side = CELLS * inner;
    let points = side.pow(width as u32);
    let within = if jittered {
        uniform(points, width, 8)
    } else {
        vec![0.5; points * width]
    };
    let at = |point: usize, axis: usize| point / side.pow(axis as u32) % side;
    let grid: Vec<f32> = (0..points)
        .flat_map(|p| (0..width).map(move |axis| (p, axis)))
        .map(|(p, axis)| (at(p, axis) as f32 + within[p * width + axis]) / side as f32)
        .collect();
    let mut density = vec![0.0; points];
    case.density(guide, &grid, &mut density);
    let mut expected = vec![0.0; all + 1];
    for (p, q) in density.iter().enumerate() {
        let cell = (0..width)
            .rev()
            .fold(0, |i, axis| i * CELLS + at(p, axis) / inner);
        expected[cell] += n as f64 * f64::from(*q) / points as f64;
    }
    expected[all] = (n as f64 - expected.iter().sum::<f64>()).max(0.0);

    // Cells that expect less than five samples are pooled.
    let (mut statistic, mut degrees, mut pool) = (0.0, -1.0, (0.0, 0.0));
    let mut add = |count: f64, expected: f64| {
        statistic += (count - expected).powi(2) / expected;
        degrees += 1.0;
    };
    for (&count, &expected) in counts.iter().zip(&expected) {
        if expected < 5.0 {
            pool = (pool.0 + count, pool.1 + expected);
        } else {
            add(count, expected);
        }
    }
    if pool.1 >= 5.0 {
        add(pool.0, pool.1);
    }
    chi_square_tail(statistic, degrees)
}

/// P(χ² > x) after Wilson and Hilferty (1931): good to a few per cent where it is used here.
fn chi_square_tail(x: f64, degrees: f64) -> f64 {
    let v = 2.0 / (9.0 * degrees);
    let z = ((x / degrees).cbrt() - (1.0 - v)) / v.sqrt();
    // Upper tail of the normal by its continued fraction for z > 0, and by symmetry below.
    let tail = |z: f64| {
        let fraction = (1..=200).rev().fold(z, |f, k| z + f64::from(k) / f);
        (-0.5 * z * z).exp() / (fraction * std::f64::consts::TAU.sqrt())
    };
    if z.abs() < 0.5 {
        return 0.5 - z * 0.398_942;
    }
    if z > 0.0 { tail(z) } else { 1.0 - tail(-z) }
}

/// Two interleaved half circles of radius 1 with normal noise of 0.1, scaled into the cube.
pub(crate) mod moons {
    use pss_rng::{Purpose, Stream};

    const NOISE: f64 = 0.1;
    /// Extent of the square that becomes the cube.
    const SIZE: [f64; 2] = [4.0, 3.0];
    const CORNER: [f64; 2] = [-1.5, -1.25];

    fn centre(moon: bool, angle: f64) -> [f64; 2] {
        let (sin, cos) = angle.sin_cos();
        if moon {
            [cos, sin]
        } else {
            [1.0 - cos, 0.5 - sin]
        }
    }

    /// `n` points.
    pub(crate) fn points(n: usize, stream: u32) -> Vec<f32> {
        let mut numbers = Stream::new(31, Purpose::Test).sequence(stream, 0);
        let mut points = Vec::with_capacity(2 * n);
        while points.len() < 2 * n {
            let c = centre(
                numbers.next_f64() < 0.5,
                std::f64::consts::PI * numbers.next_f64(),
            );
            let p: [f32; 2] = std::array::from_fn(|i| {
                ((c[i] + NOISE * numbers.next_normal() - CORNER[i]) / SIZE[i]) as f32
            });
            // Both moons keep at least 4 standard deviations from every side.
            if p.iter().all(|u| (0.0..1.0).contains(u)) {
                points.extend(p);
            }
        }
        points
    }

    /// Mean ln of the true density, by quadrature along the arcs.
    pub(crate) fn mean_log_density(points: &[f32]) -> f64 {
        const STEPS: usize = 400;
        let centres: Vec<[f64; 2]> = [true, false]
            .into_iter()
            .flat_map(|moon| {
                (0..STEPS).map(move |i| {
                    centre(moon, std::f64::consts::PI * (i as f64 + 0.5) / STEPS as f64)
                })
            })
            .collect();
        let scale =
            SIZE[0] * SIZE[1] / (centres.len() as f64 * std::f64::consts::TAU * NOISE * NOISE);
        mean(points, |u| {
            let x: [f64; 2] = std::array::from_fn(|i| CORNER[i] + SIZE[i] * f64::from(u[i]));
            let bump = |c: &[f64; 2]| {
                (-((x[0] - c[0]).powi(2) + (x[1] - c[1]).powi(2)) / (2.0 * NOISE * NOISE)).exp()
            };
            (scale * centres.iter().map(bump).sum::<f64>()).ln()
        })
    }

    /// Mean ln density of the normal with the points' own moments.
    pub(crate) fn normal_log_density(points: &[f32]) -> f64 {
        let m = [0, 1].map(|i| mean(points, |u| f64::from(u[i])));
        let c = |i: usize, j: usize| {
            mean(points, |u| {
                (f64::from(u[i]) - m[i]) * (f64::from(u[j]) - m[j])
            })
        };
        let determinant = c(0, 0) * c(1, 1) - c(0, 1) * c(0, 1);
        -0.5 * determinant.ln() - std::f64::consts::TAU.ln() - 1.0
    }

    fn mean(points: &[f32], f: impl Fn(&[f32]) -> f64) -> f64 {
        points.chunks_exact(2).map(f).sum::<f64>() / (points.len() / 2) as f64
    }
}
