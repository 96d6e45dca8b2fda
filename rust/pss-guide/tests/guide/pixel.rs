//! Guides over whole paths that look at the film position.

use pss_guide::{Context, Decision, Fit, Records, find, fit, registry};
use serde_json::{Map, Value};

use crate::common::{self, mean, options};

/// Guides that can be conditioned on the pixel.
fn conditioned() -> impl Iterator<Item = &'static str> {
    registry()
        .iter()
        .filter(|spec| (spec.defaults)().contains_key("condition"))
        .map(|spec| spec.name)
}

/// The light stands where the film position says, in both of two numbers.
fn f(u: &[f32], pixel: &[f32; 2]) -> f32 {
    let bump = |i: usize| {
        let x: f32 = (u[i] - 0.2 - 0.6 * pixel[i]) / 0.1;
        (-0.5 * x * x).exp() + 0.01
    };
    bump(0) * bump(1)
}

fn fitted(name: &str, condition: &str) -> Fit {
    let n = 20_000;
    let (u, pixels) = (common::uniform(n, 2, 300), common::uniform(n, 2, 301));
    let pixels = pixels.as_chunks::<2>().0;
    let rows = u.chunks_exact(2).zip(pixels);
    let f: Vec<f32> = rows.map(|(u, pixel)| f(u, pixel)).collect();
    let g = vec![1.0; n];
    let records = Records {
        pixel: pixels,
        ..common::records(2, &u, &f, &g)
    };
    let given: Map<String, Value> = options(&[("condition", condition.into())]);
    fit(name, &given, &records, 1, &mut |_| true).unwrap()
}

/// Variance of the estimate of ∫f over numbers and pixels, and its mean with the mean's error.
fn estimate(fit: &Fit) -> (f64, f64, f64) {
    let n = 50_000;
    let pixels = common::uniform(n, 2, 302);
    let contexts: Vec<Context> = pixels
        .as_chunks::<2>()
        .0
        .iter()
        .map(|&pixel| Context {
            pixel,
            ..Context::default()
        })
        .collect();
    let guide = &fit.guide;
    let known: &[Context] = if guide.looks_at_contexts(Decision::Path) {
        &contexts
    } else {
        &[]
    };
    let (mut u, mut q) = (common::uniform(n, 2, 303), vec![0.0; n]);
    let uniform = common::uniform(n, 2, 304);
    guide.sample(Decision::Path, known, &mut u, &mut q);
    let tenth = n / 10 * 2;
    u[..tenth].copy_from_slice(&uniform[..tenth]);
    guide.density(Decision::Path, known, &u, &mut q);
    let rows = u.chunks_exact(2).zip(&contexts).zip(&q);
    let (mean, error) = mean(rows.map(|((u, c), &q)| {
        let inside = u.iter().all(|u| (0.0..1.0).contains(u));
        let m = 0.1 + 0.9 * f64::from(q);
        f64::from(u8::from(inside)) * f64::from(f(u, &c.pixel)) / m
    }));
    (error * error * n as f64, mean, error)
}

/// Claim: where the light stands elsewhere for each pixel, knowing the pixel makes the variance at least 1.5 times smaller;
/// with it and without, the mean is the same within five standard errors.
#[test]
fn knowing_the_pixel_pays_where_the_light_depends_on_it() {
    let mut seen = 0;
    for name in conditioned() {
        let [with, without] = ["pixel", "none"].map(|c| estimate(&fitted(name, c)));
        assert!(
            without.0 > 1.5 * with.0,
            "{name}: variance {:.4} with the pixel, {:.4} without",
            with.0,
            without.0
        );
        let difference = (with.1 - without.1).abs();
        assert!(difference < 5.0 * with.2.hypot(without.2), "{name}");
        seen += 1;
    }
    assert!(seen > 0);
}

/// Without film positions, and at such as do not exist, the density is still one.
#[test]
fn pixels_that_are_nowhere_are_harmless() {
    for name in conditioned() {
        assert!(find(name).unwrap().models == [Decision::Path]);
        let guide = fitted(name, "pixel").guide;
        for pixel in [[f32::NAN; 2], [-1.0, 7.0], [f32::INFINITY; 2]] {
            let n = 20_000;
            let contexts = vec![
                Context {
                    pixel,
                    ..Context::default()
                };
                n
            ];
            let (mut u, mut q) = (common::uniform(n, 2, 305), vec![0.0; n]);
            guide.density(Decision::Path, &contexts, &u, &mut q);
            let (sum, error) = mean(q.iter().map(|&q| f64::from(q)));
            assert!(
                (sum - 1.0).abs() < 5.0 * error,
                "{name} at {pixel:?}: ∫q = {sum} ± {error}"
            );
            guide.sample(Decision::Path, &contexts, &mut u, &mut q);
            assert!(q.iter().all(|q| q.is_finite()), "{name} at {pixel:?}");
        }
    }
}

/// When a whole path is drawn its vertices are not known yet: what a context says of them changes no bit.
#[test]
fn vertices_are_not_read() {
    for name in conditioned() {
        let guide = fitted(name, "pixel").guide;
        assert!(guide.looks_at_contexts(Decision::Path));
        let n = 500;
        let bits = |position: f32| {
            let pixels = common::uniform(n, 2, 306);
            let context = |&pixel| Context {
                position: [position; 3],
                normal: [position; 3],
                outgoing: [position; 3],
                pixel,
                emitter: 7,
                bounce: 3,
            };
            let contexts: Vec<Context> = pixels.as_chunks().0.iter().map(context).collect();
            let (mut u, mut q) = (common::uniform(n, 2, 307), vec![0.0; n]);
            guide.sample(Decision::Path, &contexts, &mut u, &mut q);
            let mut again = vec![0.0; n];
            guide.density(Decision::Path, &contexts, &u, &mut again);
            let all = u.into_iter().chain(q).chain(again);
            all.map(f32::to_bits).collect::<Vec<_>>()
        };
        assert_eq!(bits(0.0), bits(f32::NAN), "{name}");
    }
}
