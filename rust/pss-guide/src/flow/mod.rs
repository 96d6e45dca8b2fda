//! RealNVP guides (Dinh et al. 2017, arXiv:1605.08803): a chain of affine couplings between base numbers
//! z and the cube.
//!
//! Sampling, z → x, coupling after coupling, with the columns split into a (kept) and b (changed),
//! alternating even and odd: x_a = z_a, x_b = z_b ⊙ exp(s(z_a)) + t(z_a). So
//! ln q(x) = ln prior(z) − Σ s, exactly, and z is found from x by the same networks, run backwards.
//!
//! - `realnvp`: u = x. The base is normal on R^d, the cube is not: part of the samples falls outside.
//! - `realnvp-logit`: u = sigmoid(x), every sample lands inside; ln q(u) = ln q(x) − Σ ln(u (1 − u)).
//!   Where f32 has no number left (x > 17.3 rounds to u = 1, x < −87 to 0) the sample counts as outside
//!   after all: moved to the last number, it would carry mass that the density there does not have.
//!
//! With the condition `pixel` (`realnvp-logit` only) all networks also look at the film position, as Zheng and Zwicker's do:
//! ln q(u | pixel). Nothing is known of the vertices when a whole path is drawn.
//!
//! Base numbers come from the caller's uniform ones, z = Φ⁻¹(u + 2⁻²⁵): the middle of a 24-bit step, so
//! that 0 is no special case. Start reading at [`RealNvp`]; networks are evaluated by `kernel`, trained by
//! `train` in candle.

mod kernel;
mod ops;
pub(crate) mod options;
mod plain;
#[cfg(test)]
mod tests;
mod train;
#[cfg(test)]
mod twin;
mod weights;

use pss_rng::{Purpose, Stream, to_unit};
use serde_json::{Map, Value, json};

use self::kernel::{Direction, Kernel};
use self::options::{Prior, RealNvpOptions};
use self::weights::{Shape, Weights};
use crate::file::{self, Contents};
use crate::kernel::math;
use crate::{Context, Decision, Fit, Guide, GuideError, Records, normal, options as json_options};

/// Base samples behind [`Guide::mass_outside`].
const OUTSIDE_SAMPLES: u32 = 65_536;

/// Largest number below 1 that a 24-bit uniform number takes.
const BELOW_ONE: f32 = 1.0 - f32::EPSILON / 2.0;

/// Half a step of a 24-bit uniform number: where the density of u = 0 is evaluated.
const HALF_STEP: f32 = 1.0 / 33_554_432.0;

/// A number outside the cube.
const OUTSIDE: f32 = -1.0;

/// Where x lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Domain {
    /// u = x.
    Cube,
    /// u = sigmoid(x).
    Logit,
}

impl Domain {
    /// Name of the guide in the registry.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Cube => "realnvp",
            Self::Logit => "realnvp-logit",
        }
    }
}

/// ln prior(z) without regard to its support.
#[inline]
fn log_prior(prior: Prior, z: &[f32]) -> f64 {
    match prior {
        Prior::Gaussian => {
            let square: f64 = z.iter().map(|&z| f64::from(z) * f64::from(z)).sum();
            -0.5 * square - z.len() as f64 * normal::LN_SQRT_TAU
        }
        Prior::Hypercube => 0.0,
    }
}

/// x of a number u of the cube, and ln |∂x/∂u|, for [`Domain::Logit`].
#[inline]
fn logit(u: f32) -> (f64, f64) {
    let u = f64::from(if u == 0.0 {
        HALF_STEP
    } else {
        u.clamp(f32::MIN_POSITIVE, BELOW_ONE)
    });
    let (a, b) = (u.ln(), (-u).ln_1p());
    (a - b, -(a + b))
}

/// A film position as the networks see it, in [−1, 1]².
fn film(pixel: &[f32; 2]) -> [f32; 2] {
    pixel.map(|x| math::inside(2.0 * x - 1.0))
}

/// A trained flow.
#[derive(Debug)]
pub(crate) struct RealNvp {
    domain: Domain,
    options: RealNvpOptions,
    weights: Weights,
    kernel: Kernel,
    /// Of [`OUTSIDE_SAMPLES`], how many fell outside the cube.
    outside: u32,
}

impl RealNvp {
    fn new(domain: Domain, options: RealNvpOptions, weights: Weights) -> Self {
        let kernel = Kernel::new(&weights, options.s_max);
        Self {
            domain,
            options,
            weights,
            kernel,
            outside: 0,
        }
    }

    /// Fits a flow; the `fit` of both registry lines.
    pub(crate) fn fit(
        domain: Domain,
        options: &Map<String, Value>,
        records: &Records<'_>,
        seed: u64,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Fit, GuideError> {
        let start = std::time::Instant::now();
        let options = RealNvpOptions::parse(domain, options)?;
        let d = records.dims;
        if !(1..=64).contains(&d) {
            return Err(json_options::bad(
                domain.name(),
                "dims",
                &json!(d),
                "1 to 64 numbers per path",
            ));
        }
        let usable = records.usable(options.outlier_quantile)?;
        let samples = options.training_rows(usable.rows.len());

        let shape = Shape::new(d, &options);
        let mut x = Vec::with_capacity(samples * shape.row());
        let mut log_jacobian = 0.0;
        for row in usable.resample(samples, seed) {
            for &u in &records.u[row * d..(row + 1) * d] {
                match domain {
                    Domain::Cube => x.push(u),
                    Domain::Logit => {
                        let (y, ln) = logit(u);
                        x.push(y as f32);
                        log_jacobian += ln;
                    }
                }
            }
            if shape.known > 0 {
                x.extend(film(&records.pixel(row)));
            }
        }
        let trained = train::train(
            domain,
            &options,
            Weights::random(shape, seed),
            &x,
            seed,
            progress,
        )?;
        let mut history = trained.history;
        for epoch in &mut history {
            epoch.loss -= log_jacobian / samples as f64;
        }
        let mut guide = Self::new(domain, options, trained.weights);
        guide.outside = guide.count_outside();
        Ok(Fit {
            guide: Box::new(guide),
            history,
            seconds: start.elapsed().as_secs_f64(),
            dropped_nonfinite: usable.nonfinite,
            outliers_removed: usable.outliers,
            trained_on: usable.rows.len(),
            samples,
        })
    }

    /// Rebuilds a flow from a file's contents; the error says what does not fit together.
    pub(crate) fn restore(domain: Domain, contents: Contents) -> Result<Box<dyn Guide>, String> {
        let integer = |key: &str| {
            let value = contents.config.get(key).and_then(Value::as_u64);
            value
                .and_then(|v| usize::try_from(v).ok())
                .ok_or(format!("`{key}` is missing from its configuration"))
        };
        let dims = integer("dims")?;
        let outside = integer("outside")?;
        if !(1..=64).contains(&dims) || outside > OUTSIDE_SAMPLES as usize {
            return Err(format!(
                "its configuration holds dims = {dims}, outside = {outside}"
            ));
        }
        let empty = Map::new();
        let given = contents
            .config
            .get("options")
            .and_then(Value::as_object)
            .unwrap_or(&empty);
        let options = RealNvpOptions::parse(domain, given).map_err(|e| e.to_string())?;
        let shape = Shape::new(dims, &options);
        let tensors = file::take(contents.tensors, &shape.tensors())?;
        let weights = Weights { shape, tensors };
        if !weights.is_finite() {
            return Err("it holds weights that are not finite".to_owned());
        }
        let mut guide = Self::new(domain, options, weights);
        guide.outside = outside as u32;
        Ok(Box::new(guide))
    }

    fn dims(&self) -> usize {
        self.weights.shape.dims
    }

    /// Base numbers of uniform ones, in place.
    fn base(&self, u: &mut [f32]) {
        for u in u {
            let middle = f64::from(*u) + f64::from(HALF_STEP);
            *u = match self.options.prior {
                Prior::Gaussian => normal::inverse_cdf(middle) as f32,
                Prior::Hypercube => middle as f32,
            };
        }
    }

    /// Uniform numbers → (u, q).
    fn sample_path(&self, u: &mut [f32], known: &[f32], q: &mut [f32]) {
        let d = self.dims();
        self.base(u);
        let prior: Vec<f64> = u
            .chunks_exact(d)
            .map(|z| log_prior(self.options.prior, z))
            .collect();
        self.kernel.run(Direction::Generate, u, known, q);
        let mut again = Vec::new();
        for (row, ((u, q), prior)) in u.chunks_exact_mut(d).zip(&mut *q).zip(prior).enumerate() {
            let mut log_q = prior - f64::from(*q);
            if self.domain == Domain::Logit {
                let (mut moved, mut inside) = (false, true);
                for x in u.iter_mut() {
                    let y = f64::from(*x);
                    *x = sigmoid(y);
                    let (rounded, ln) = logit(*x);
                    log_q += ln;
                    moved |= (rounded - y).abs() > 4e-6;
                    inside &= (0.0..1.0).contains(x);
                }
                if !inside {
                    log_q = f64::NEG_INFINITY;
                } else if moved {
                    // Near 1 the steps of f32 are wide: the density is then that of the number given.
                    again.push(row);
                }
            }
            *q = to_density(log_q);
            if u.iter().any(|u| u.is_nan()) {
                u.fill(OUTSIDE); // Overflow inside the flow counts as outside the cube.
            }
        }
        if !again.is_empty() {
            let rows = |of: &[f32], width: usize| -> Vec<f32> {
                let row = |&r: &usize| of[r * width..][..width].to_vec();
                again.iter().flat_map(row).collect()
            };
            let (numbers, known) = (rows(u, d), rows(known, self.weights.shape.known));
            let mut densities = vec![0.0; again.len()];
            self.density_path(&numbers, &known, &mut densities);
            for (row, density) in again.into_iter().zip(densities) {
                q[row] = density;
            }
        }
    }

    /// u → q.
    fn density_path(&self, u: &[f32], known: &[f32], q: &mut [f32]) {
        let d = self.dims();
        let mut x = u[..q.len() * d].to_vec();
        let mut log_jacobian = Vec::new();
        if self.domain == Domain::Logit {
            log_jacobian = x
                .chunks_exact_mut(d)
                .map(|row| {
                    row.iter_mut().fold(0.0, |sum, x| {
                        let (y, ln) = logit(*x);
                        *x = y as f32;
                        sum + ln
                    })
                })
                .collect();
        }
        self.kernel.run(Direction::Normalise, &mut x, known, q);
        for (row, (z, q)) in x.chunks_exact(d).zip(&mut *q).enumerate() {
            let outside = match self.domain {
                Domain::Logit => !u[row * d..(row + 1) * d]
                    .iter()
                    .all(|u| (0.0..1.0).contains(u)),
                Domain::Cube => false,
            } || self.options.prior == Prior::Hypercube
                && !z.iter().all(|z| (0.0..=1.0).contains(z));
            let log_q = log_prior(self.options.prior, z) - f64::from(*q);
            *q = if outside {
                0.0
            } else {
                to_density(log_q + log_jacobian.get(row).unwrap_or(&0.0))
            };
        }
    }

    /// What is known of each row, (rows, known); a row without context is at the film's corner.
    fn known(&self, contexts: &[Context], rows: usize) -> Vec<f32> {
        if self.weights.shape.known == 0 {
            return Vec::new();
        }
        let pixel = |row| contexts.get(row).map_or([0.0; 2], |c: &Context| c.pixel);
        (0..rows).flat_map(|row| film(&pixel(row))).collect()
    }

    fn count_outside(&self) -> u32 {
        let d = self.dims();
        let stream = Stream::new(0, Purpose::Guide);
        let rows = 1024;
        let (mut u, mut q) = (vec![0.0; rows * d], vec![0.0; rows]);
        let mut known = vec![0.0; rows * self.weights.shape.known];
        let mut outside = 0;
        for block in 0..OUTSIDE_SAMPLES / rows as u32 {
            for (row, u) in u.chunks_exact_mut(d).enumerate() {
                for (group, u) in u.chunks_mut(4).enumerate() {
                    let words = stream.block(block * rows as u32 + row as u32, group as u32, 0);
                    u.iter_mut()
                        .zip(words)
                        .for_each(|(u, word)| *u = to_unit(word));
                }
            }
            // Of all pixels together; a path's numbers take far fewer groups.
            for (row, known) in known.chunks_exact_mut(2).enumerate() {
                let words = stream.block(block * rows as u32 + row as u32, u32::MAX, 0);
                known.copy_from_slice(&film(&[to_unit(words[0]), to_unit(words[1])]));
            }
            self.sample_path(&mut u, &known, &mut q);
            outside += u
                .chunks_exact(d)
                .filter(|u| !u.iter().all(|u| (0.0..1.0).contains(u)))
                .count() as u32;
        }
        outside
    }
}

/// sigmoid(y) in f32; 1 or [`OUTSIDE`] where no number of the open cube is near. NaN stays NaN.
#[inline]
fn sigmoid(y: f64) -> f32 {
    let u = (1.0 / (1.0 + (-y).exp())) as f32;
    if u < f32::MIN_POSITIVE { OUTSIDE } else { u }
}

/// exp, finite.
#[inline]
fn to_density(log_q: f64) -> f32 {
    if log_q.is_nan() {
        0.0
    } else {
        log_q.min(88.7).exp() as f32
    }
}

impl Guide for RealNvp {
    fn name(&self) -> &str {
        self.domain.name()
    }

    fn models(&self) -> &[Decision] {
        &[Decision::Path]
    }

    fn dims(&self) -> usize {
        self.dims()
    }

    fn looks_at_contexts(&self, decision: Decision) -> bool {
        decision == Decision::Path && self.weights.shape.known > 0
    }

    fn sample(&self, decision: Decision, contexts: &[Context], u: &mut [f32], q: &mut [f32]) {
        if decision != Decision::Path {
            return q.fill(1.0);
        }
        let rows = q.len().min(u.len() / self.dims());
        let known = self.known(contexts, rows);
        self.sample_path(&mut u[..rows * self.dims()], &known, &mut q[..rows]);
    }

    fn density(&self, decision: Decision, contexts: &[Context], u: &[f32], q: &mut [f32]) {
        if decision != Decision::Path {
            return q.fill(1.0);
        }
        let rows = q.len().min(u.len() / self.dims());
        let known = self.known(contexts, rows);
        self.density_path(u, &known, &mut q[..rows]);
    }

    fn mass_outside(&self) -> f64 {
        f64::from(self.outside) / f64::from(OUTSIDE_SAMPLES)
    }

    fn parameters(&self) -> usize {
        self.weights.shape.parameters()
    }

    fn describe(&self) -> Value {
        json!({
            "name": self.name(),
            "models": self.models(),
            "dims": self.dims(),
            "parameters": self.parameters(),
            "memory": 8 * self.parameters(),
            "mass_outside": self.mass_outside(),
            "options": json_options::to_map(&self.options),
        })
    }

    fn contents(&self) -> Option<Contents> {
        let names = self.weights.shape.tensors();
        let tensors = names
            .into_iter()
            .zip(&self.weights.tensors)
            .map(|((n, s), v)| (n, s, v.clone()))
            .collect();
        let config = json!({
            "dims": self.dims(),
            "outside": self.outside,
            "options": json_options::to_map(&self.options),
        });
        Some(Contents {
            guide: self.name().to_owned(),
            config,
            tensors,
            ..Contents::default()
        })
    }
}
