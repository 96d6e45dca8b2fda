//! Densities and samples after training.

use pss_guide::{Decision, GuideSpec, fit, registry};
use pss_rng::{Purpose, Stream};

use crate::common::{self, Target, cases, fit_small, fit_with, moons, options};

/// Significance of each statistical test. Seeds are fixed: a red test stays red until the code changes.
const SIGMAS: f64 = 5.0;

/// Number of columns that a guide is tested with.
fn dimensions(name: &str) -> std::ops::RangeInclusive<usize> {
    if common::is_whole(name) { 1..=3 } else { 5..=5 }
}

#[test]
fn the_density_integrates_to_one_less_the_mass_outside() {
    for spec in registry() {
        for dims in dimensions(spec.name) {
            let guide = &fit_small(spec.name, dims).guide;
            for case in cases(&**guide) {
                let n = 200_000;
                let u = common::uniform(n, case.width, 1);
                let mut q = vec![0.0; n];
                case.density(&**guide, &u, &mut q);
                let (mean, error) = common::mean(q.iter().map(|&q| f64::from(q)));
                let outside = guide.mass_outside();
                let error = error.hypot((outside * (1.0 - outside) / 65_536.0).sqrt());
                let (sum, name) = (mean + outside, spec.name);
                assert!(
                    (sum - 1.0).abs() <= SIGMAS * error,
                    "{name}, {dims}-D, {case:?}: ∫q + outside = {sum:.5} ± {error:.5}"
                );
            }
        }
    }
}

#[test]
fn samples_follow_the_density() {
    for spec in registry() {
        let dims = if common::is_whole(spec.name) { 2 } else { 5 };
        let guide = &fit_small(spec.name, dims).guide;
        let mut seen = false;
        for case in cases(&**guide) {
            let p = common::chi_square(&**guide, case, 0.0);
            assert!(p > 1e-4, "{}, {case:?}: p = {p:.2e}", spec.name);
            // The test of the test: 3 % of the samples replaced by uniform ones are seen, unless all are uniform.
            seen |= common::chi_square(&**guide, case, 0.03) < 1e-4;
        }
        assert!(seen, "{}: a wrong sampler passes", spec.name);
    }
}

/// One decision at one place: a product of 30 u² (1 − u)², cut off, is integrated with numbers from the guide.
#[test]
fn a_defensive_mixture_estimates_a_known_integral() {
    for spec in registry() {
        let whole = common::is_whole(spec.name);
        for dims in if whole { vec![2, 5] } else { vec![5] } {
            let guide = &fit_small(spec.name, dims).guide;
            for case in cases(&**guide) {
                let target = Target { dims: case.width };
                for a in [0.1, 0.5] {
                    let n = 100_000;
                    let uniform = common::uniform(n, case.width, 2);
                    let (mut u, mut q) = (uniform.clone(), vec![0.0; n]);
                    case.sample(&**guide, &mut u, &mut q);
                    let mut coin = Stream::new(2, Purpose::Test).sequence(9, 0);
                    for row in 0..n {
                        if coin.next_f64() < a {
                            let at = row * case.width..(row + 1) * case.width;
                            u[at.clone()].copy_from_slice(&uniform[at]);
                        }
                    }
                    case.density(&**guide, &u, &mut q);
                    let estimates = u.chunks_exact(case.width).zip(&q).map(|(u, &q)| {
                        if !u.iter().all(|u| (0.0..1.0).contains(u)) {
                            return 0.0;
                        }
                        f64::from(target.f(u)) / (a + (1.0 - a) * f64::from(q))
                    });
                    let (mean, error) = common::mean(estimates);
                    let (want, name) = (target.integral(), spec.name);
                    assert!(
                        (mean - want).abs() < SIGMAS * error && error < 0.03 * want,
                        "{name}, {case:?}, a = {a}: {mean:.6} ± {error:.6}, not {want:.6}"
                    );
                }
            }
        }
    }
}

#[test]
fn sample_and_density_agree_and_a_logit_stays_inside() {
    for spec in registry() {
        let guide = &fit_small(spec.name, 5).guide;
        for case in cases(&**guide) {
            let n = 20_000;
            let mut u = common::uniform(n, case.width, 3);
            // The first and the last number that there are, in every column.
            u[..4 * case.width].fill(0.0);
            u[2 * case.width..4 * case.width].fill(1.0 - f32::EPSILON / 2.0);
            let (mut q, mut again) = (vec![0.0; n], vec![0.0; n]);
            case.sample(&**guide, &mut u, &mut q);
            case.density(&**guide, &u, &mut again);
            let outside = u
                .chunks_exact(case.width)
                .filter(|u| !u.iter().all(|u| (0.0..1.0).contains(u)))
                .count();
            for (a, b) in q.iter().zip(&again) {
                assert!(
                    a == b || (a / b - 1.0).abs() < 1e-4,
                    "{}, {case:?}: {a} {b}",
                    spec.name
                );
            }
            let (share, p) = (outside as f64 / n as f64, guide.mass_outside());
            let error = (p * (1.0 - p) * (1.0 / n as f64 + 1.0 / 65_536.0)).sqrt();
            assert!(
                (share - p).abs() <= SIGMAS * error + 4.0 / n as f64 * f64::from(u8::from(p > 0.0)),
                "{}: {share} of the samples outside, reported {p}",
                spec.name
            );
        }
    }
}

#[test]
fn decisions_that_a_guide_does_not_model_stay_uniform() {
    let all = [
        Decision::Path,
        Decision::Direction,
        Decision::Emitter,
        Decision::Light,
        Decision::Ray,
    ];
    for spec in registry() {
        let guide = &fit_small(spec.name, 5).guide;
        assert_eq!(guide.models(), spec.models);
        for decision in all.into_iter().filter(|d| !spec.models.contains(d)) {
            let before = common::uniform(10, 5, 6);
            let (mut u, mut q) = (before.clone(), vec![0.0; 10]);
            guide.sample(decision, &[], &mut u, &mut q);
            assert_eq!(
                (&u, &q),
                (&before, &vec![1.0; 10]),
                "{} {decision:?}",
                spec.name
            );
            q.fill(0.0);
            guide.density(decision, &[], &u, &mut q);
            assert_eq!(q, [1.0; 10]);
        }
    }
}

#[test]
fn one_seed_gives_one_guide_on_any_number_of_threads() {
    for spec in registry() {
        let dims = if common::is_whole(spec.name) { 3 } else { 5 };
        let bits = |seed: u64, threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            let guide = pool.install(|| {
                fit_with(spec.name, dims, 2000, common::epochs(spec.name, 2), seed).guide
            });
            common::fingerprint(&*guide)
        };
        let one = bits(1, 1);
        assert_eq!(one, bits(1, 3), "{}", spec.name);
        if common::trained().any(|t| t.name == spec.name) {
            assert_ne!(one, bits(2, 1), "{}: the seed is ignored", spec.name);
        }
    }
}

/// The guides that are fitted by maximum likelihood.
fn flows() -> impl Iterator<Item = &'static GuideSpec> {
    registry().iter().filter(|s| s.name.starts_with("realnvp"))
}

#[test]
fn the_loss_falls_and_is_a_likelihood_on_the_cube() {
    for spec in flows() {
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
    let records = common::records(2, &train, &one, &one);
    for spec in flows() {
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
    let records = common::records(2, &u, &f, &g);
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
