//! Passes put together to one image.

use pss_render::{Accumulator, Developed, Film};

/// Edge of the checkerboard's squares, in pixels.
const SQUARE: u32 = 8;

/// Whether a pixel lies on the checkerboard's first half.
fn first_half(x: u32, y: u32) -> bool {
    (x / SQUARE + y / SQUARE).is_multiple_of(2)
}

/// Every pass's samples weighted by 1 ÷ their variance: one number a pass for each half of a checkerboard, estimated on
/// the other half, so that a pixel's weights do not depend on its own samples (but for what a reconstruction filter
/// carries over the squares' edges). Variance is relative, as in relMSE; the numbers come from all pixels of a half, so
/// what correlation is left (a guide learned from one pass draws the next) is of the order of 1 ÷ their samples.
pub(crate) fn by_variance(film: &Film, passes: &[Accumulator]) -> Developed {
    let mut all = Accumulator::whole(film);
    for pass in passes {
        all.merge(pass);
    }
    let mean = all.develop();
    let weights: Vec<[f64; 2]> = passes
        .iter()
        .map(|pass| {
            [true, false].map(|half| {
                let values = mean.image.iter().map(|&x| f64::from(x));
                let level = values.sum::<f64>() / mean.image.len() as f64;
                let epsilon = (0.1 * level).powi(2).max(f64::MIN_POSITIVE);
                let spread = pass.relative_spread(&mean, epsilon, |x, y| first_half(x, y) != half);
                1.0 / spread
            })
        })
        .collect();
    // A pass without any spread, or an image of a single square: nothing to weigh by.
    if weights.iter().flatten().any(|w| !w.is_finite()) {
        return mean;
    }
    let mut weighted = Accumulator::whole(film);
    for (pass, [first, second]) in passes.iter().zip(weights) {
        weighted.merge_weighted(pass, |x, y| if first_half(x, y) { first } else { second });
    }
    weighted.develop()
}
