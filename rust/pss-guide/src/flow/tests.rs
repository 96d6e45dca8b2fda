//! What holds for any weights; what holds after training is in `tests/guide`.
#![allow(clippy::unwrap_used)]

use pss_rng::{Purpose, Sequence, Stream};
use serde_json::json;

use super::kernel::{Direction, Kernel};
use super::options::{Prior, RealNvpOptions};
use super::twin::{self, Twin};
use super::weights::{Shape, Weights};
use super::{Domain, RealNvp, train};
use crate::{Decision, Guide};

fn numbers(stream: u32) -> Sequence {
    Stream::new(11, Purpose::Test).sequence(stream, 0)
}

fn options(domain: Domain, given: serde_json::Value) -> RealNvpOptions {
    RealNvpOptions::parse(domain, given.as_object().unwrap()).unwrap()
}

/// Weights that are larger than any start of training, so that every layer bends.
fn weights(dims: usize, options: &RealNvpOptions, gain: f32) -> Weights {
    let mut weights = Weights::random(Shape::new(dims, options), 5);
    weights
        .tensors
        .iter_mut()
        .flatten()
        .for_each(|w| *w *= gain);
    weights
}

fn flow(domain: Domain, dims: usize, given: serde_json::Value, gain: f32) -> RealNvp {
    let options = options(domain, given);
    let weights = weights(dims, &options, gain);
    RealNvp::new(domain, options, weights)
}

fn uniform(rows: usize, dims: usize, stream: u32) -> Vec<f32> {
    let mut numbers = numbers(stream);
    (0..rows * dims).map(|_| numbers.next_f32()).collect()
}

fn normal(rows: usize, dims: usize, stream: u32) -> Vec<f32> {
    let mut numbers = numbers(stream);
    (0..rows * dims)
        .map(|_| numbers.next_normal() as f32)
        .collect()
}

fn f64s(row: &[f32]) -> Vec<f64> {
    row.iter().map(|&x| f64::from(x)).collect()
}

#[test]
fn the_thesis_flow_has_85_840_parameters() {
    for domain in [Domain::Cube, Domain::Logit] {
        assert_eq!(flow(domain, 5, json!({}), 1.0).parameters(), 85_840);
    }
}

/// Numbers, couplings, units, hidden layers, condition: widths are no multiple of any vector length, down to one number per
/// path, and the film position is wider than all else once.
const SHAPES: [(usize, usize, usize, usize, &str); 8] = [
    (5, 8, 40, 4, "none"),
    (1, 2, 7, 1, "none"),
    (2, 4, 16, 2, "none"),
    (3, 5, 13, 3, "none"),
    (7, 4, 33, 1, "none"),
    (12, 3, 5, 2, "none"),
    (5, 4, 13, 2, "pixel"),
    (1, 2, 1, 1, "pixel"),
];

#[test]
fn the_kernel_computes_the_formula_both_ways_and_inverts_itself() {
    for (dims, couplings, hidden, layers, condition) in SHAPES {
        let given = json!({
            "couplings": couplings,
            "hidden": hidden,
            "layers": layers,
            "condition": condition,
            "s_max": 2.0,
        });
        let options = options(Domain::Logit, given);
        let weights = weights(dims, &options, 1.5);
        let exact = Twin::from(&weights);
        let kernel = Kernel::new(&weights, options.s_max);
        let rows = 53;
        let z = normal(rows, dims, 1);
        let known = normal(rows, options.known(), 9);
        let with_known = |numbers: &[f32], row: usize| {
            let known = &known[row * options.known()..][..options.known()];
            f64s(&[&numbers[row * dims..][..dims], known].concat())
        };
        let (mut x, mut det) = (z.clone(), vec![0.0; rows]);
        kernel.run(Direction::Generate, &mut x, &known, &mut det);
        let (mut back, mut det_back) = (x.clone(), vec![0.0; rows]);
        kernel.run(Direction::Normalise, &mut back, &known, &mut det_back);
        for row in 0..rows {
            let at = row * dims..(row + 1) * dims;
            let close = |a: f32, b: f64| (f64::from(a) - b).abs() < 1e-4 * (1.0 + b.abs());
            let (want, log_det) = twin::generate(&exact, options.s_max, &with_known(&z, row));
            assert!(
                x[at.clone()].iter().zip(&want).all(|(&a, &b)| close(a, b)),
                "{dims}-D: {:?} {want:?}",
                &x[at]
            );
            assert!(
                close(det[row], log_det),
                "{dims}-D log-det: {} {log_det}",
                det[row]
            );
            let (_, log_det) = twin::normalise(&exact, options.s_max, &with_known(&x, row));
            assert!(
                close(det_back[row], log_det),
                "{dims}-D inverse log-det: {} {log_det}",
                det_back[row]
            );
            for (a, b) in z[at.clone()].iter().zip(&back[at]) {
                assert!((a - b).abs() < 1e-4, "{dims}-D round trip: {a} {b}");
            }
        }
    }
}

#[test]
fn the_log_determinant_is_that_of_the_jacobian() {
    let shapes = SHAPES.into_iter().filter(|shape| shape.4 == "none");
    for (dims, couplings, hidden, layers, _) in shapes {
        let given = json!({ "couplings": couplings, "hidden": hidden, "layers": layers });
        let options = options(Domain::Logit, given);
        let weights = weights(dims, &options, 1.5);
        let exact = Twin::from(&weights);
        for z in normal(10, dims, 2).chunks_exact(dims).map(f64s) {
            let (x, log_det) = twin::generate(&exact, options.s_max, &z);
            let numeric = twin::log_det_numeric(|z| twin::generate(&exact, options.s_max, z).0, &z);
            // A kink of LeakyReLU within the step of 1e-6 would spoil a row; the fixed rows meet none.
            assert!(
                (log_det - numeric).abs() < 1e-6 * (1.0 + numeric.abs()),
                "{dims}-D: {log_det} {numeric}"
            );
            let inverse =
                twin::log_det_numeric(|x| twin::normalise(&exact, options.s_max, x).0, &x);
            assert!(
                (log_det + inverse).abs() < 1e-6 * (1.0 + inverse.abs()),
                "{dims}-D: {log_det} {inverse}"
            );
        }
    }
}

#[test]
fn a_row_does_not_depend_on_the_rows_beside_it() {
    let flow = flow(Domain::Logit, 5, json!({}), 1.5);
    let base = uniform(100, 5, 3);
    let (mut all, mut q) = (base.clone(), vec![0.0; 100]);
    flow.sample(Decision::Path, &[], &mut all, &mut q);
    for row in 0..100 {
        let (mut one, mut q_one) = (base[row * 5..row * 5 + 5].to_vec(), [0.0]);
        flow.sample(Decision::Path, &[], &mut one, &mut q_one);
        assert_eq!(one, all[row * 5..row * 5 + 5]);
        assert_eq!(q_one[0].to_bits(), q[row].to_bits());
    }
}

#[test]
fn gradients_are_those_of_the_f64_twin() {
    for (domain, prior, condition) in [
        (Domain::Cube, "gaussian", None),
        (Domain::Logit, "gaussian", None),
        (Domain::Cube, "hypercube", None),
        (Domain::Logit, "gaussian", Some("pixel")),
    ] {
        let mut given = json!({ "couplings": 3, "hidden": 6, "layers": 2, "prior": prior });
        if let Some(condition) = condition {
            given["condition"] = condition.into();
        }
        let options = options(domain, given);
        let width = 3 + options.known();
        let weights = weights(3, &options, if prior == "hypercube" { 0.2 } else { 1.0 });
        let x: Vec<f32> = uniform(20, width, 4)
            .iter()
            .map(|u| 0.3 + 0.4 * u)
            .collect();
        let rows: Vec<u32> = (0..20).collect();
        let exact = Twin::from(&weights);
        let mean = |twin: &Twin| -> f64 {
            let row = |x: &[f32]| twin::log_density(twin, options.s_max, options.prior, &f64s(x));
            -x.chunks_exact(width)
                .map(|x| row(x).max(-87.0))
                .sum::<f64>()
                / 20.0
        };
        let (loss, gradients) = train::gradients(&options, &weights, &x, &rows).unwrap();
        assert!(
            (loss - mean(&exact)).abs() < 1e-5,
            "{loss} {}",
            mean(&exact)
        );
        let mut seen = 0;
        for (tensor, gradient) in gradients.iter().enumerate() {
            for (i, &g) in gradient.iter().enumerate() {
                let moved = |by: f64| {
                    let mut twin = exact.clone();
                    twin.tensors[tensor][i] += by;
                    mean(&twin)
                };
                let numeric = (moved(1e-6) - moved(-1e-6)) / 2e-6;
                // f32 against f64; the fixed rows meet no kink of LeakyReLU within the step.
                let error = (f64::from(g) - numeric).abs();
                assert!(
                    error < 1e-5 * (1.0 + numeric.abs()),
                    "{prior} tensor {tensor}[{i}]: {g} {numeric}"
                );
                seen += usize::from(g != 0.0);
            }
        }
        // Of 522 parameters, masks silence 118; a flat prior does not see the last shifts either.
        // The film position adds two inputs to each of six networks of 6 units.
        let live = match (prior, condition) {
            ("gaussian", None) => 404..=404,
            ("gaussian", Some(_)) => 476..=476,
            _ => 200..=403,
        };
        assert!(
            live.contains(&seen),
            "{prior}, {condition:?}: {seen} gradients are not 0"
        );
    }
}

#[test]
fn parts_of_a_batch_add_up_to_the_batch() {
    let options = options(
        Domain::Cube,
        json!({ "couplings": 2, "hidden": 512, "layers": 1 }),
    );
    let weights = weights(2, &options, 1.0);
    let x = uniform(100, 2, 5);
    let rows: Vec<u32> = (0..100).collect();
    let (loss, whole) = train::gradients(&options, &weights, &x, &rows).unwrap();
    let halves =
        [&rows[..50], &rows[50..]].map(|r| train::gradients(&options, &weights, &x, r).unwrap());
    assert!((loss - 0.5 * (halves[0].0 + halves[1].0)).abs() < 1e-6);
    for (t, whole) in whole.iter().enumerate() {
        for (i, w) in whole.iter().enumerate() {
            let sum = 0.5 * (halves[0].1[t][i] + halves[1].1[t][i]);
            assert!(
                (w - sum).abs() < 1e-5 * (1.0 + w.abs()),
                "tensor {t}[{i}]: {w} {sum}"
            );
        }
    }
}

#[test]
fn the_reported_density_is_that_of_the_returned_numbers() {
    for (domain, gain) in [
        (Domain::Cube, 1.0),
        (Domain::Logit, 1.0),
        (Domain::Logit, 1.8),
    ] {
        let flow = flow(domain, 5, json!({}), gain);
        let rows = 20_000;
        let (mut u, mut q, mut again) = (uniform(rows, 5, 6), vec![0.0; rows], vec![0.0; rows]);
        flow.sample(Decision::Path, &[], &mut u, &mut q);
        flow.density(Decision::Path, &[], &u, &mut again);
        for ((u, a), b) in u.chunks_exact(5).zip(&q).zip(&again) {
            assert!(
                a == b || (a / b - 1.0).abs() < 1e-4,
                "{domain:?}, gain {gain}: {a} {b} at {u:?}"
            );
        }
    }
}

#[test]
fn a_sample_beyond_the_last_number_below_one_counts_as_outside() {
    // A shift of +40 in the logit: nearly all of the mass lies where f32 has no number left.
    let given = json!({ "couplings": 2, "hidden": 4, "layers": 1 });
    let options = options(Domain::Logit, given);
    let mut weights = weights(1, &options, 0.0);
    weights.tensors[7][1] = 40.0;
    let mut flow = RealNvp::new(Domain::Logit, options, weights);
    let (mut u, mut q) = (uniform(500, 1, 8), vec![1.0; 500]);
    flow.sample(Decision::Path, &[], &mut u, &mut q);
    assert!(
        u.iter().all(|&u| u == 1.0) && q.iter().all(|&q| q == 0.0),
        "{u:?}"
    );
    flow.outside = flow.count_outside();
    assert_eq!(flow.mass_outside(), 1.0);
}

#[test]
fn the_edges_of_the_cube_have_finite_densities() {
    let edges = [
        0.0,
        f32::MIN_POSITIVE,
        2f32.powi(-24),
        0.5,
        1.0 - f32::EPSILON / 2.0,
    ];
    for (domain, prior) in [
        (Domain::Cube, "gaussian"),
        (Domain::Logit, "gaussian"),
        (Domain::Logit, "hypercube"),
    ] {
        let flow = flow(domain, 2, json!({ "prior": prior }), 1.0);
        for a in edges {
            for b in edges {
                let (mut u, mut q) = ([a, b], [f32::NAN]);
                flow.density(Decision::Path, &[], &u, &mut q);
                assert!(
                    q[0].is_finite() && q[0] >= 0.0,
                    "{domain:?} density at {u:?}: {}",
                    q[0]
                );
                flow.sample(Decision::Path, &[], &mut u, &mut q);
                assert!(
                    q[0].is_finite() && u.iter().all(|u| u.is_finite()),
                    "{domain:?} sample of ({a}, {b}): {u:?} {q:?}"
                );
                if domain == Domain::Logit {
                    assert!(
                        u.iter().all(|u| *u > 0.0 && *u < 1.0),
                        "sample of ({a}, {b}): {u:?}"
                    );
                }
            }
        }
    }
}

#[test]
fn the_hypercube_prior_has_no_density_outside_its_image() {
    let flow = flow(Domain::Cube, 2, json!({ "prior": "hypercube" }), 1.0);
    assert_eq!(flow.options.prior, Prior::Hypercube);
    let rows = 2000;
    let (mut u, mut q, mut again) = (uniform(rows, 2, 7), vec![0.0; rows], vec![0.0; rows]);
    flow.sample(Decision::Path, &[], &mut u, &mut q);
    flow.density(Decision::Path, &[], &u, &mut again);
    // Rounding may move a row across the border of its support; 2,000 rows have few so near.
    let equal = q
        .iter()
        .zip(&again)
        .filter(|(a, b)| (*a / *b - 1.0).abs() < 1e-4)
        .count();
    assert!(equal > rows - 5, "{equal}");
    flow.density(Decision::Path, &[], &[50.0, 50.0], &mut again[..1]);
    assert_eq!(again[0], 0.0);
}

#[test]
fn decisions_that_are_not_modelled_stay_uniform() {
    let flow = flow(Domain::Cube, 5, json!({}), 1.0);
    let (mut u, mut q) = ([0.25, 0.75], [0.0]);
    flow.sample(Decision::Direction, &[], &mut u, &mut q);
    assert_eq!((u, q), ([0.25, 0.75], [1.0]));
    flow.density(Decision::Emitter, &[], &u, &mut q);
    assert_eq!(q, [1.0]);
}
