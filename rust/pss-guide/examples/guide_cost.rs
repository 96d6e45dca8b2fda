//! What the guides cost on one thread: seconds per training epoch, µs per sample and per density.
//!
//! `cargo run --release -p pss-guide --example guide_cost [NAME…]`
#![allow(clippy::print_stdout, reason = "a table is what this program is for")]

use std::time::Instant;

use pss_guide::{Context, Decision, GuideError, Records, fit, registry};
use pss_rng::{Purpose, Stream};
use serde_json::Map;

/// Numbers per path at k = 2.
const DIMS: usize = 5;
const VERTICES: usize = 2;
const TRAINING: usize = 100_000;
/// Rows per call, as the renderer's blocks.
const BLOCK: usize = 1024;
const BLOCKS: usize = 200;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let wanted: Vec<String> = std::env::args().skip(1).collect();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    Ok(pool.install(|| measure(&wanted))?)
}

fn measure(wanted: &[String]) -> Result<(), GuideError> {
    let mut numbers = Stream::new(1, Purpose::Test).sequence(0, 0);
    let u: Vec<f32> = (0..TRAINING * DIMS).map(|_| numbers.next_f32()).collect();
    // Two smooth bumps: the cost does not depend on what is learned.
    let f: Vec<f32> = u
        .chunks_exact(DIMS)
        .map(|u| {
            let bump = |c: f32| (-u.iter().map(|u| (u - c) * (u - c)).sum::<f32>() * 20.0).exp();
            bump(0.3) + bump(0.7)
        })
        .collect();
    let contexts: Vec<Context> = (0..TRAINING * VERTICES)
        .map(|i| Context {
            position: std::array::from_fn(|_| numbers.next_f32()),
            normal: [0.0, 0.6, 0.8],
            outgoing: [0.0, 0.8, 0.6],
            bounce: (i % VERTICES) as u32 + 1,
            ..Context::default()
        })
        .collect();
    let g = vec![1.0; TRAINING];
    let records = Records {
        dims: DIMS,
        u: &u,
        f: &f,
        f_max: &f,
        g: &g,
        contexts: &contexts,
        zeros: 0,
        ..Records::default()
    };
    println!(
        "{:15} {:>10} {:>14} {:>12} {:>13}",
        "guide", "parameters", "epoch 100k [s]", "sample [µs]", "density [µs]"
    );
    let measured = registry()
        .iter()
        .filter(|s| wanted.is_empty() || wanted.iter().any(|w| w == s.name));
    for spec in measured {
        let decision = spec.models[0];
        let width = match decision {
            Decision::Path => DIMS,
            Decision::Emitter => 1,
            Decision::Direction | Decision::Light | Decision::Ray => 2,
        };
        let epochs = if (spec.defaults)().contains_key("epochs") {
            2
        } else {
            1 // Counted, once.
        };
        let mut options = Map::new();
        if epochs > 1 {
            options.insert("epochs".to_owned(), epochs.into());
        }
        let fitted = fit(spec.name, &options, &records, 1, &mut |_| true)?;
        let places = if fitted.guide.looks_at_contexts(decision) {
            &contexts[..BLOCK]
        } else {
            &[]
        };
        let uniform: Vec<f32> = (0..BLOCK * width).map(|_| numbers.next_f32()).collect();
        let (mut block, mut q) = (uniform.clone(), vec![0.0; BLOCK]);
        let micros = |start: Instant| start.elapsed().as_secs_f64() * 1e6 / (BLOCK * BLOCKS) as f64;
        let start = Instant::now();
        for _ in 0..BLOCKS {
            block.copy_from_slice(&uniform);
            fitted.guide.sample(decision, places, &mut block, &mut q);
        }
        let sample = micros(start);
        let start = Instant::now();
        for _ in 0..BLOCKS {
            fitted.guide.density(decision, places, &uniform, &mut q);
        }
        println!(
            "{:15} {:>10} {:>14.2} {:>12.2} {:>13.2}",
            spec.name,
            fitted.guide.parameters(),
            fitted.seconds / f64::from(epochs),
            sample,
            micros(start)
        );
    }
    Ok(())
}
