//! Densities and samples after training.

use pss_guide::{Decision, Records, fit, registry};
use pss_rng::{Purpose, Stream};

use crate::common::{self, Target, fit_small, fit_with, moons, options};

/// Significance of each statistical test. Seeds are fixed: a red test stays red until the code changes.
const SIGMAS: f64 = 5.0;

#[test]
fn the_density_integrates_to_one_less_the_mass_outside() {
    for spec in registry() {
        for dims in 1..=3 {
            let guide = &fit_small(spec.name, dims).guide;
            let n = 200_000;
            let u = common::uniform(n, dims, 1);
            let mut q = vec![0.0; n];
            guide.density(Decision::Path, &[], &u, &mut q);
            let (mean, error) = common::mean(q.iter().map(|&q| f64::from(q)));
            let outside = guide.mass_outside();
            let error = error.hypot((outside * (1.0 - outside) / 65_536.0).sqrt());
            let (sum, name) = (mean + outside, spec.name);
            assert!(
                (sum - 1.0).abs() < SIGMAS * error,
                "{name}, {dims}-D: ∫q + outside = {sum:.5} ± {error:.5}"
            );
        }
    }
}

#[test]
fn samples_follow_the_density() {
    for spec in registry() {
        let guide = &fit_small(spec.name, 2).guide;
        let p = common::chi_square(&**guide, 0.0);
        assert!(p > 1e-4, "{}: p = {p:.2e}", spec.name);
        // The test of the test: 3 % of the samples replaced by uniform ones are seen.
        let p = common::chi_square(&**guide, 0.03);
        assert!(
            p < 1e-4,
            "{}: a wrong sampler passes with p = {p:.2e}",
            spec.name
        );
    }
}

#[test]
fn a_defensive_mixture_estimates_a_known_integral() {
    for spec in registry() {
        for dims in [2, 5] {
            let guide = &fit_small(spec.name, dims).guide;
            let target = Target { dims };
            for a in [0.1, 0.5] {
                let n = 100_000;
                let uniform = common::uniform(n, dims, 2);
                let (mut u, mut q) = (uniform.clone(), vec![0.0; n]);
                guide.sample(Decision::Path, &[], &mut u, &mut q);
                let mut coin = Stream::new(2, Purpose::Test).sequence(9, 0);
                for row in 0..n {
                    if coin.next_f64() < a {
                        let at = row * dims..(row + 1) * dims;
                        u[at.clone()].copy_from_slice(&uniform[at]);
                    }
                }
                guide.density(Decision::Path, &[], &u, &mut q);
                let (mean, error) = common::mean(u.chunks_exact(dims).zip(&q).map(|(u, &q)| {
                    if !u.iter().all(|u| (0.0..1.0).contains(u)) {
                        return 0.0;
                    }
                    f64::from(target.f(u)) / (a + (1.0 - a) * f64::from(q))
                }));
                let want = target.integral();
                let name = spec.name;
                assert!(
                    (mean - want).abs() < SIGMAS * error && error < 0.02 * want,
                    "{name}, {dims}-D, a = {a}: {mean:.6} ± {error:.6}, not {want:.6}"
                );
            }
        }
    }
}

#[test]
fn sample_and_density_agree_and_a_logit_stays_inside() {
    for spec in registry() {
        let guide = &fit_small(spec.name, 5).guide;
        let n = 20_000;
        let (mut u, mut q, mut again) = (common::uniform(n, 5, 3), vec![0.0; n], vec![0.0; n]);
        guide.sample(Decision::Path, &[], &mut u, &mut q);
        guide.density(Decision::Path, &[], &u, &mut again);
        let outside = u
            .chunks_exact(5)
            .filter(|u| !u.iter().all(|u| (0.0..1.0).contains(u)))
            .count();
        for (a, b) in q.iter().zip(&again) {
            assert!((a / b - 1.0).abs() < 1e-4, "{}: {a} {b}", spec.name);
        }
        let (share, p) = (outside as f64 / n as f64, guide.mass_outside());
        let error = (p * (1.0 - p) * (1.0 / n as f64 + 1.0 / 65_536.0)).sqrt();
        assert!(
            (share - p).abs() <= SIGMAS * error,
            "{}: {share} of the samples outside, reported {p}",
            spec.name
        );
    }
}

#[test]
fn one_seed_gives_one_guide_on_any_number_of_threads() {
    for spec in registry() {
        let bits = |seed: u64, threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            let guide = pool.install(|| {
                fit_with(spec.name, 3, 2000, options(&[("epochs", 2.into())]), seed).guide
            });
            let mut q = vec![0.0; 1000];
            guide.density(Decision::Path, &[], &common::uniform(1000, 3, 4), &mut q);
            q.into_iter().map(f32::to_bits).collect::<Vec<_>>()
        };
        let one = bits(1, 1);
        assert_eq!(one, bits(1, 3), "{}", spec.name);
        assert_ne!(one, bits(2, 1), "{}: the seed is ignored", spec.name);
    }
}

#[test]
fn the_loss_falls_and_is_a_likelihood_on_the_cube() {
    for spec in registry() {
        let fit = fit_small(spec.name, 2);
        let (first, last) = (fit.history[0].loss, fit.history.last().unwrap().loss);
        assert!(
            last < first && last < -0.3,
            "{}: loss from {first} to {last}",
            spec.name
        );
        assert_eq!(
            fit.history.iter().map(|e| e.epoch).collect::<Vec<_>>(),
            (1..=7).collect::<Vec<_>>()
        );
        assert!(fit.seconds > 0.0 && fit.samples == fit.trained_on && fit.guide.parameters() > 0);
        assert_eq!(fit.guide.describe()["name"], spec.name);
    }
}

/// Claim, stated beforehand: trained on 8192 points of two moons for 15 epochs, a guide's mean ln q of
/// fresh points is within 0.25 nats of the truth's, which is 1.49; a normal with the points' own mean and
/// covariance stays 0.9 below it.
#[test]
fn two_moons_are_learned() {
    let (train, test) = (moons::points(8192, 1), moons::points(8192, 2));
    let truth = moons::mean_log_density(&test);
    assert!(
        moons::normal_log_density(&test) < truth - 0.8,
        "the claim would say little"
    );
    let one = vec![1.0; 8192];
    let records = Records {
        dims: 2,
        u: &train,
        f: &one,
        f_max: &one,
        g: &one,
        zeros: 0,
        ..Records::default()
    };
    for spec in registry() {
        let guide = fit(
            spec.name,
            &options(&[("epochs", 15.into())]),
            &records,
            1,
            &mut |_| true,
        )
        .unwrap()
        .guide;
        let mut q = vec![0.0; 8192];
        guide.density(Decision::Path, &[], &test, &mut q);
        let mean = q.iter().map(|&q| f64::from(q).ln()).sum::<f64>() / 8192.0;
        assert!(
            mean > truth - 0.25,
            "{}: mean ln q = {mean:.3}, truth {truth:.3}",
            spec.name
        );
    }
}

#[test]
fn the_hypercube_prior_fails_as_the_thesis_found() {
    let target = Target { dims: 2 };
    let (u, f) = target.paths(4096, 1);
    let g = vec![1.0; 4096];
    let records = Records {
        dims: 2,
        u: &u,
        f: &f,
        f_max: &f,
        g: &g,
        zeros: 0,
        ..Records::default()
    };
    let fitted = fit(
        "realnvp",
        &options(&[("prior", "hypercube".into())]),
        &records,
        1,
        &mut |_| true,
    )
    .unwrap();
    let mut q = vec![0.0; 4096];
    fitted.guide.density(Decision::Path, &[], &u, &mut q);
    let lost = q.iter().filter(|&&q| q == 0.0).count();
    assert!(
        lost > 400,
        "only {lost} of 4096 training paths have density 0"
    );
}
