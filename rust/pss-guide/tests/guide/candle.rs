//! The flow's kernel beside the same flow in candle's own operations, by way of what a caller sees.

use pss_guide::{Decision, fit};
use serde_json::json;

use crate::support::candle::{Flow, matrix};
use crate::support::{DIMS, Paths, uniform};

/// Claim: candle takes every sample back to the base numbers that it was made of, and gives the density reported, for
/// networks of several sizes with the weights of one short fit.
#[test]
fn samples_and_densities_are_candles() {
    let paths = Paths::new(600);
    for (couplings, hidden, layers) in [(8, 40, 4), (3, 13, 1), (2, 33, 2)] {
        let given = json!({ "couplings": couplings, "hidden": hidden, "layers": layers, "epochs": 1, "prior": "hypercube" });
        let options = given.as_object().unwrap();
        let fitted = fit("realnvp", options, &paths.records(), 1, &mut |_| true).unwrap();
        let flow = Flow::of(&*fitted.guide).unwrap();
        let rows = 203;
        let uniform = uniform(rows * DIMS, 7);
        let (mut u, mut q) = (uniform.clone(), vec![0.0; rows]);
        fitted.guide.sample(Decision::Path, &[], &mut u, &mut q);

        let (back, log_det) = flow.run(&matrix(&u, DIMS).unwrap(), false).unwrap();
        let back = back.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (base, back) in uniform.iter().zip(&back) {
            assert!((base - back).abs() < 1e-5, "{base} comes back as {back}");
        }
        // The base is uniform, so that ln q is −Σ s.
        let (again, forward) = flow.run(&matrix(&uniform, DIMS).unwrap(), true).unwrap();
        let again = again.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (u, again) in u.iter().zip(&again) {
            assert!(
                (u - again).abs() < 1e-5 * (1.0 + u.abs()),
                "{u}, not {again}"
            );
        }
        for candle in [log_det, forward] {
            for (q, log_det) in q.iter().zip(candle.to_vec1::<f32>().unwrap()) {
                assert!(
                    (q.ln() + log_det).abs() < 2e-5,
                    "ln q = {}, not {}",
                    q.ln(),
                    -log_det
                );
            }
        }
    }
}
