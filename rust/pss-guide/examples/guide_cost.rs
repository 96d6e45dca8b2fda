//! What the guides cost on one thread: seconds per training epoch, µs per sample and per density.
//!
//! `cargo run --release -p pss-guide --example guide_cost`
#![allow(clippy::print_stdout, reason = "a table is what this program is for")]

use std::time::Instant;

use pss_guide::{Decision, GuideError, Records, fit, registry};
use pss_rng::{Purpose, Stream};

/// Numbers per path at k = 2.
const DIMS: usize = 5;
const TRAINING: usize = 100_000;
/// Rows per call, as the renderer's blocks.
const BLOCK: usize = 1024;
const BLOCKS: usize = 200;

fn main() -> Result<(), GuideError> {
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
    let g = vec![1.0; TRAINING];
    let records = Records {
        dims: DIMS,
        u: &u,
        f: &f,
        f_max: &f,
        g: &g,
        zeros: 0,
        ..Records::default()
    };
    println!(
        "{:15} {:>10} {:>14} {:>12} {:>13}",
        "guide", "parameters", "epoch 100k [s]", "sample [µs]", "density [µs]"
    );
    // Tables have no numbers without a place: what they cost shows in a render.
    for spec in registry().iter().filter(|s| s.models == [Decision::Path]) {
        let options = serde_json::Map::from_iter([("epochs".to_owned(), 2.into())]);
        let fitted = fit(spec.name, &options, &records, 1, &mut |_| true)?;
        let mut block: Vec<f32> = (0..BLOCK * DIMS).map(|_| numbers.next_f32()).collect();
        let uniform = block.clone();
        let mut q = vec![0.0; BLOCK];
        let micros = |start: Instant| start.elapsed().as_secs_f64() * 1e6 / (BLOCK * BLOCKS) as f64;
        let start = Instant::now();
        for _ in 0..BLOCKS {
            block.copy_from_slice(&uniform);
            fitted.guide.sample(Decision::Path, &[], &mut block, &mut q);
        }
        let sample = micros(start);
        let start = Instant::now();
        for _ in 0..BLOCKS {
            fitted.guide.density(Decision::Path, &[], &uniform, &mut q);
        }
        println!(
            "{:15} {:>10} {:>14.2} {:>12.2} {:>13.2}",
            spec.name,
            fitted.guide.parameters(),
            fitted.seconds / 2.0,
            sample,
            micros(start)
        );
    }
    Ok(())
}
