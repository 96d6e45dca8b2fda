//! Whether a render's own variance can be believed: what docs/diagnostics.md explains number by number.

use pss_render::Developed;
use pss_render::math::{Rgb, luminance};
use serde::Serialize;

use crate::statistics::{Moments, Statistics};

/// Shape of a tail above which a variance estimate is not to be trusted (Vehtari et al. 2024).
const HEAVY_TAIL: f64 = 0.7;

/// How many times more the uniform paths must see than the guided ones, and by how many standard errors, to be told.
const DISAGREEMENT: f64 = 2.0;
const DISAGREEMENT_ERRORS: f64 = 2.0;

/// How many times more rarely than random numbers a guide must draw the light to be told, and by how many standard errors.
const RARE: f64 = 1.5;
const RARE_ERRORS: f64 = 2.0;

/// Standard errors between the means of pilot and guided paths that are told.
const MEAN_ERRORS: f64 = 4.0;

/// Share of all light in a single path, and effective number of paths, that are told, if there are at least so many paths.
const ONE_PATH: f64 = 0.1;
const FEW_PATHS: f64 = 50.0;
const ENOUGH_PATHS: u64 = 10_000;

/// Share of the pixels whose energy is told: the brightest ones.
const BRIGHTEST: f64 = 0.001;

/// A number and its standard error.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Measured {
    /// The estimate.
    pub value: f64,
    /// Its standard error, as far as the samples tell.
    pub error: f64,
}

/// ∫f²/m, which decides the variance, by paths of two kinds. They agree where the guide draws all that carries light.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SecondMoment {
    /// By the uniform paths of the mixture: what the guide misses shows only here.
    pub uniform_pool: Measured,
    /// By the paths that the guide drew.
    pub guide: Measured,
}

impl SecondMoment {
    /// How many times more the uniform paths see.
    pub fn ratio(&self) -> f64 {
        self.uniform_pool.value / self.guide.value
    }

    fn disagrees(&self) -> bool {
        let [u, g] = [self.uniform_pool, self.guide];
        let error = u.error.hypot(g.error);
        u.value > DISAGREEMENT * g.value && u.value - g.value > DISAGREEMENT_ERRORS * error
    }
}

/// Mean luminance of all uniform paths of the pilot, and of those rendered after it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Means {
    /// The pilot's.
    pub pilot: f64,
    /// That of the paths after it.
    pub rendered: f64,
    /// Their difference in standard errors, negative where light is missing after the pilot.
    pub z: f64,
}

/// The second moments of a render's guided passes.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Pools {
    paths: f64,
    /// Uniform, guided: Σ over passes of paths · mean, and of paths² · its variance.
    sums: [[f64; 2]; 2],
}

impl Pools {
    /// Adds a guided pass, whose a may differ from that of others: by its number of paths, so that both kinds see the same
    /// passes alike.
    pub(crate) fn add_pass(&mut self, pass: &Statistics) {
        let paths = pass.counts.camera_rays as f64;
        if pass.squares.iter().any(|kind| kind.paths == 0) {
            return;
        }
        self.paths += paths;
        for (sums, kind) in self.sums.iter_mut().zip(&pass.squares) {
            sums[0] += paths * kind.mean();
            sums[1] += paths * paths * kind.variance_of_mean();
        }
    }

    fn second_moment(&self) -> Option<SecondMoment> {
        (self.paths > 0.0).then(|| {
            let [uniform_pool, guide] = self.sums.map(|[mean, variance]| Measured {
                value: mean / self.paths,
                error: variance.sqrt() / self.paths,
            });
            SecondMoment {
                uniform_pool,
                guide,
            }
        })
    }
}

/// What tells whether the variance of a render can be believed; over all paths in the image unless said otherwise.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Diagnostics {
    /// Kish's effective sample size of the contributions.
    pub ess: f64,
    /// The same by camera ray.
    pub ess_share: f64,
    /// E[(f/m)²] of the luminances over the paths after the pilot; at most E[f²]/a.
    pub mean_square: f64,
    /// Mean 1/m over the paths after the pilot, with or without light: 1 where the guide's densities are right.
    pub mean_weight: f64,
    /// Largest 1/m of a path with light; at most 1/a.
    pub max_weight: f64,
    /// Mean 1/m of the light, Σ(c/m) ÷ Σc over the paths after the pilot: how many times more rarely it is drawn than by random
    /// numbers; null without a guide or light.
    pub light_weight: Option<Measured>,
    /// Largest contribution over the mean one of all camera rays.
    pub max_contribution: f64,
    /// Share of all light that the largest contribution carries.
    pub largest_share: f64,
    /// Shape k̂ of the contributions' tail; null where too few paths carry light.
    pub pareto_k: Option<f64>,
    /// Values that it was fitted to.
    pub tail_paths: usize,
    /// Mass that the guide has outside the cube, as it knows itself; null without a guide.
    pub mass_outside: Option<f64>,
    /// Guided paths whose numbers fell there, of all guided ones.
    pub outside_share: Option<f64>,
    /// ∫f²/m by uniform and by guided paths; null without a guide, and where a is 0 or 1.
    pub second_moment: Option<SecondMoment>,
    /// Means of pilot and rendered paths; null without a pilot or a guide.
    pub means: Option<Means>,
    /// Share of the image's energy in its brightest .1 % of pixels.
    pub brightest_share: f64,
    /// Pixels that this are.
    pub brightest_pixels: usize,
    /// What to worry about, a line each.
    pub warnings: Vec<String>,
}

/// What diagnostics are made of.
pub(crate) struct Evidence<'a> {
    pub(crate) in_image: &'a Statistics,
    pub(crate) pilot: &'a Statistics,
    pub(crate) rendered: &'a Statistics,
    pub(crate) pools: &'a Pools,
    /// Mass outside the cube of the guide that drew.
    pub(crate) mass_outside: Option<f64>,
    pub(crate) film: &'a Developed,
}

impl Diagnostics {
    pub(crate) fn of(evidence: &Evidence<'_>) -> Self {
        let all = evidence.in_image;
        let pareto = all.tail.pareto(all.counts.nonzero);
        let (brightest_share, brightest_pixels) = brightest(evidence.film);
        let guided = evidence.rendered.guided;
        let mut found = Self {
            ess: all.ess(),
            ess_share: all.ess() / (all.counts.camera_rays as f64).max(1.0),
            mean_square: evidence.rendered.estimates().mean_square(),
            mean_weight: evidence.rendered.mean_weight(),
            max_weight: f64::from(all.max_weight),
            light_weight: evidence
                .rendered
                .light_weight()
                .filter(|_| guided > 0)
                .map(|(value, error)| Measured { value, error }),
            max_contribution: all.max_contribution(),
            largest_share: if all.sum > 0.0 {
                f64::from(all.max_estimate) / all.sum
            } else {
                0.0
            },
            pareto_k: pareto.map(|p| p.shape),
            tail_paths: pareto.map_or(0, |p| p.values),
            mass_outside: evidence.mass_outside,
            outside_share: (guided > 0)
                .then(|| evidence.rendered.counts.outside as f64 / guided as f64),
            second_moment: evidence.pools.second_moment(),
            means: means(evidence),
            brightest_share,
            brightest_pixels,
            warnings: Vec::new(),
        };
        found.warnings = found.worries(all.counts.camera_rays);
        found
    }

    /// Measures the image's brightest pixels, where it was not developed before.
    pub(crate) fn see(&mut self, film: &Developed) {
        (self.brightest_share, self.brightest_pixels) = brightest(film);
    }

    fn worries(&self, paths: u64) -> Vec<String> {
        let mut worries = Vec::new();
        if let Some(k) = self.pareto_k {
            let error = tail_error(k, self.tail_paths);
            if k - error > HEAVY_TAIL {
                worries.push(format!(
                    "the contributions' tail is heavy (Pareto k = {k:.2} ± {error:.2} > {HEAVY_TAIL}): the variance estimate \
                     is not to be trusted"
                ));
            }
        }
        if let Some(moment) = self.second_moment.filter(SecondMoment::disagrees) {
            worries.push(format!(
                "uniform paths see {:.2} times the second moment that guided ones see: the guide misses light, and the \
                 variance estimate may be too low",
                moment.ratio()
            ));
        }
        let rare = |w: &Measured| w.value > RARE && w.value - 1.0 > RARE_ERRORS * w.error;
        if let Some(weight) = self.light_weight.filter(rare) {
            worries.push(format!(
                "the guide draws the light {:.2} times more rarely than random numbers do: it was learned where the light is \
                 not, and makes noise",
                weight.value
            ));
        }
        if let Some(means) = self.means.filter(|m| m.z.abs() > MEAN_ERRORS) {
            worries.push(format!(
                "paths after the pilot carry {:.3} times the light of the pilot's ({:.1} standard errors): one of them misses \
                 some",
                means.rendered / means.pilot,
                means.z
            ));
        }
        let few = self.ess > 0.0 && self.ess < FEW_PATHS;
        if (few || self.largest_share > ONE_PATH) && paths >= ENOUGH_PATHS {
            worries.push(format!(
                "the image rests on {:.0} effective paths, and a single one carries {:.0} % of all light: the variance estimate \
                 is not to be trusted",
                self.ess,
                100.0 * self.largest_share
            ));
        }
        worries
    }
}

/// Standard error of a shape k̂ ≥ −½ that was fitted to so many values (asymptotic, as that of the maximum likelihood).
fn tail_error(shape: f64, values: usize) -> f64 {
    (1.0 + shape) / (values as f64).sqrt()
}

/// The means of pilot and guided paths. Their errors contain what differs between pixels, so that z is rather too small.
fn means(evidence: &Evidence<'_>) -> Option<Means> {
    let Moments { paths, .. } = evidence.pilot.estimates();
    if paths == 0 || evidence.rendered.guided == 0 {
        return None;
    }
    let [pilot, rendered] = [evidence.pilot, evidence.rendered].map(Statistics::estimates);
    let error = (pilot.variance_of_mean() + rendered.variance_of_mean()).sqrt();
    let z = (rendered.mean() - pilot.mean()) / error;
    z.is_finite().then(|| Means {
        pilot: pilot.mean(),
        rendered: rendered.mean(),
        z,
    })
}

/// Share of the energy in the brightest pixels, and how many these are. 0 for a black image.
fn brightest(film: &Developed) -> (f64, usize) {
    let luminances = film.image.chunks_exact(3);
    let mut pixels: Vec<f32> = luminances
        .map(|c| luminance(Rgb::new(c[0], c[1], c[2])).max(0.0))
        .collect();
    let count = ((BRIGHTEST * pixels.len() as f64).ceil() as usize).min(pixels.len());
    if count == 0 {
        return (0.0, 0);
    }
    pixels.select_nth_unstable_by(count - 1, |a, b| b.total_cmp(a));
    // Summed in an order of its own: selection leaves none that could be relied on.
    let sum = |values: &mut [f32]| {
        values.sort_unstable_by(f32::total_cmp);
        values.iter().map(|&x| f64::from(x)).sum::<f64>()
    };
    let top = sum(&mut pixels[..count]);
    let whole = top + sum(&mut pixels[count..]);
    (if whole > 0.0 { top / whole } else { 0.0 }, count)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn film(image: Vec<f32>) -> Developed {
        Developed {
            image,
            variance: Vec::new(),
            found: Vec::new(),
            nonzero: Vec::new(),
        }
    }

    #[test]
    fn the_brightest_pixels_are_a_thousandth_and_at_least_one() {
        let mut image = vec![1.0; 3 * 2000];
        image[30..36].fill(500.0);
        let (share, count) = brightest(&film(image));
        assert_eq!(count, 2);
        assert!((share - 1000.0 / 2998.0).abs() < 1e-6, "{share}");
        assert_eq!(brightest(&film(vec![0.0; 12])), (0.0, 1));
        assert_eq!(brightest(&film(vec![2.0; 3])), (1.0, 1));
        assert_eq!(brightest(&film(Vec::new())), (0.0, 0));
    }

    fn moments(paths: u64, values: &[f64]) -> Moments {
        let mut moments = Moments {
            paths,
            ..Moments::default()
        };
        values.iter().for_each(|&x| moments.add_value(x));
        moments
    }

    #[test]
    fn mass_that_only_uniform_paths_find_is_told() {
        let pass = |uniform: &[f64]| {
            let mut pass = Statistics::default();
            pass.counts.camera_rays = 1000;
            pass.squares = [moments(100, uniform), moments(900, &[1.0; 900])];
            let mut pools = Pools::default();
            pools.add_pass(&pass);
            pools.second_moment()
        };
        let agrees = pass(&[1.0; 100]);
        assert_eq!(
            agrees.map(|m| (m.ratio(), m.disagrees())),
            Some((1.0, false))
        );
        // Ten of a hundred uniform paths see a mode that no guided one does.
        let missed = pass(&[100.0; 10]);
        assert_eq!(
            missed.map(|m| (m.ratio(), m.disagrees())),
            Some((10.0, true))
        );
        // One such path is no proof.
        assert_eq!(pass(&[1000.0]).map(|m| m.disagrees()), Some(false));
        // Without uniform paths nothing can be told.
        let pass = Statistics {
            squares: [Moments::default(), moments(900, &[1.0])],
            ..Statistics::default()
        };
        let mut pools = Pools::default();
        pools.add_pass(&pass);
        assert_eq!(pools.second_moment(), None);
    }

    /// What is told of a render without a pilot, of an image of one pixel.
    fn of_one_side(side: &Statistics) -> Diagnostics {
        Diagnostics::of(&Evidence {
            in_image: side,
            pilot: &Statistics::default(),
            rendered: side,
            pools: &Pools::default(),
            mass_outside: None,
            film: &film(vec![1.0; 3]),
        })
    }

    #[test]
    fn light_that_the_guide_draws_rarely_is_told() {
        // Paths of which each brings one, with these weights.
        let found = |weights: &[f32]| {
            let mut side = Statistics {
                guided: 1000,
                ..Statistics::default()
            };
            side.counts.camera_rays = 1000;
            for &w in weights {
                side.add_estimate(Rgb::ONE, w, f64::from(w));
            }
            of_one_side(&side)
        };
        let rare = found(&[8.0; 40]);
        assert_eq!(rare.warnings.len(), 1, "{:?}", rare.warnings);
        assert!(
            rare.light_weight
                .is_some_and(|w| (w.value - 8.0).abs() < 1e-5)
        );
        assert_eq!(found(&[1.0; 40]).warnings, [""; 0]);
        // Ten lights drawn often and one rarely: three times on average, but who knows.
        let unsure = found(&[[0.5; 10].as_slice(), &[28.0]].concat());
        assert!(
            unsure
                .light_weight
                .is_some_and(|w| w.value > 2.5 && w.error > 1.0)
        );
        assert_eq!(unsure.warnings, [""; 0]);
        assert_eq!(found(&[]).light_weight, None);
    }

    #[test]
    fn an_image_that_rests_on_few_paths_is_told() {
        let warned = |lit: u32, rays: u64| {
            let mut side = Statistics::default();
            side.counts.camera_rays = rays;
            for _ in 0..lit {
                side.add_estimate(Rgb::ONE, 1.0, 1.0);
            }
            of_one_side(&side).warnings.len()
        };
        assert_eq!(warned(20, 20_000), 1);
        assert_eq!(warned(20, 1000), 0);
        assert_eq!(warned(60, 20_000), 0);
        assert_eq!(warned(0, 20_000), 0);
    }

    #[test]
    fn a_pilot_and_a_guide_that_disagree_in_the_mean_are_told() {
        let side = |n: u64, lit: u64, guided: u64| {
            let mut side = Statistics {
                guided,
                ..Statistics::default()
            };
            side.counts.camera_rays = n;
            side.sum = lit as f64;
            side.sum_2 = lit as f64;
            side
        };
        let (pilot, half) = (side(10_000, 1000, 0), side(10_000, 500, 10_000));
        let (film, pools) = (film(vec![1.0; 3]), Pools::default());
        let evidence = |rendered| Evidence {
            in_image: rendered,
            pilot: &pilot,
            rendered,
            pools: &pools,
            mass_outside: Some(0.5),
            film: &film,
        };
        let found = Diagnostics::of(&evidence(&half));
        assert!(found.means.is_some_and(|m| m.z < -10.0));
        assert_eq!(found.warnings.len(), 1, "{:?}", found.warnings);
        let same = side(10_000, 990, 10_000);
        assert_eq!(Diagnostics::of(&evidence(&same)).warnings, [""; 0]);
    }

    #[test]
    fn a_tail_is_told_where_it_is_heavy_beyond_its_error() {
        let film = film(vec![1.0; 3]);
        // Quantiles of a Pareto distribution of shape k, from u = 1 down.
        let warned = |k: f64, n: u64| {
            let mut side = Statistics::default();
            side.counts.camera_rays = n;
            side.counts.nonzero = n;
            for i in 1..=n {
                side.tail.add((i as f64 / n as f64).powf(-k) as f32);
            }
            let found = Diagnostics::of(&Evidence {
                in_image: &side,
                pilot: &Statistics::default(),
                rendered: &Statistics::default(),
                pools: &Pools::default(),
                mass_outside: None,
                film: &film,
            });
            let shape = found.pareto_k.unwrap_or_default();
            (shape, found.warnings.len())
        };
        // The same tail, 1: within its error of 200 paths, beyond that of a hundred thousand.
        let (few, many) = (warned(1.0, 200), warned(1.0, 100_000));
        assert!(
            few.0 > HEAVY_TAIL && many.0 > HEAVY_TAIL,
            "{few:?} {many:?}"
        );
        assert_eq!([few.1, many.1], [0, 1]);
        // Far above, few paths suffice; below, none do.
        assert_eq!(warned(2.0, 200).1, 1);
        assert_eq!(warned(0.6, 100_000).1, 0);
    }
}
