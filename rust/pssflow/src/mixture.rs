//! The joint defensive mixture, and the one place where f is divided by a density.

use pss_render::math::{Rgb, luminance};

/// m = a + (1 − a)·q over all guided decisions of a path together: one coin a path makes either all of
/// them from q or all of them uniform, and both cases are divided by the same m. So 1/m ≤ 1/a for any
/// number of bounces and any composite of guides, and an unguided path (q ≡ 1) has m = 1.
///
/// This is one-sample multiple importance sampling with the balance heuristic (Veach 1997, §9.2.4;
/// Hesterberg 1995 calls it a defensive mixture).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mixture {
    /// Share of uniform paths, in [0, 1]; 0 is the thesis' estimator, whose weights have no bound.
    pub uniform_fraction: f32,
}

/// f_nee and f_bsdf of a path, each with the guide's density of the numbers that it uses.
pub type Terms = [(Rgb, f32); 2];

/// Those that carry light: a term of zero stays zero, also where its density is zero.
#[inline]
fn lit(terms: Terms) -> impl Iterator<Item = (Rgb, f32)> {
    terms.into_iter().filter(|&(f, _)| f != Rgb::ZERO)
}

impl Mixture {
    /// m for a product of guide densities `q`.
    #[inline]
    pub fn density(&self, q: f32) -> f32 {
        let a = self.uniform_fraction;
        // At a = 1, an infinite q must not make 0·∞.
        if a >= 1.0 { 1.0 } else { a + (1.0 - a) * q }
    }

    /// Whether the coin `c` ∈ [0, 1) sends a path to the guide.
    #[inline]
    pub fn is_guided(&self, coin: f32) -> bool {
        coin >= self.uniform_fraction
    }

    /// f ÷ m, each term by the density of the numbers that it uses, and the larger 1/m of the terms that
    /// carry light (0 where none does).
    #[inline]
    pub fn divide(&self, terms: Terms) -> (Rgb, f32) {
        let (mut estimate, mut weight) = (Rgb::ZERO, 0.0f32);
        for (f, q) in lit(terms) {
            let m = self.density(q);
            estimate += f / m;
            weight = weight.max(1.0 / m);
        }
        (estimate, weight)
    }

    /// 1/m; 0 where that is not finite, which needs a = 0 and a guide that drew what it holds impossible.
    #[inline]
    pub(crate) fn weight(&self, q: f32) -> f32 {
        let weight = 1.0 / self.density(q);
        if weight.is_finite() { weight } else { 0.0 }
    }

    /// Σ lum(f/m)/m over the terms. Its mean is Σ∫f/m, so that its ratio to the mean of f/m is the mean 1/m of the light:
    /// how many times more rarely the mixture draws it than uniform numbers would.
    #[inline]
    pub fn rarity(&self, terms: Terms) -> f64 {
        let rarity = |(f, q)| {
            let m = f64::from(self.density(q));
            f64::from(luminance(f)) / (m * m)
        };
        lit(terms).map(rarity).sum()
    }

    /// f²/m of the luminances, term by term: its mean over uniform numbers is ∫f²/m, which decides the variance. For a
    /// path that the guide drew it is divided by q, too: the same integral, as far as the guide's own paths see it.
    #[inline]
    pub fn square(&self, terms: Terms, guided: bool) -> f64 {
        let square = |(f, q): (Rgb, f32)| {
            let drawn = if guided {
                q.max(f32::MIN_POSITIVE)
            } else {
                1.0
            };
            let (y, m) = (f64::from(luminance(f)), f64::from(self.density(q)));
            y * y / (m * f64::from(drawn))
        };
        lit(terms).map(square).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_weight_is_bounded_by_the_uniform_fraction() {
        for a in [0.1, 0.25, 0.5, 1.0] {
            let m = Mixture {
                uniform_fraction: a,
            };
            for q in [0.0, 1e-30, 1e-3, 1.0, 1e10, f32::INFINITY] {
                let w = 1.0 / m.density(q);
                assert!((0.0..=1.0 / a + 1e-6).contains(&w), "a {a} q {q}: {w}");
            }
        }
    }

    #[test]
    fn without_a_guide_nothing_is_divided() {
        let m = Mixture {
            uniform_fraction: 0.1,
        };
        let f = Rgb::new(1.0, 2.0, 3.0);
        let (estimate, weight) = m.divide([(f, 1.0), (f, 1.0)]);
        assert!((estimate - f * 2.0).length() < 1e-5);
        assert_eq!(weight, 1.0);
    }

    #[test]
    fn squares_are_the_same_integral_by_uniform_and_by_guided_paths() {
        // q = 2 on half of the cube, 0 on the rest, f = 3 on the first: ∫f²/m = ½ · 9/m.
        let m = Mixture {
            uniform_fraction: 0.2,
        };
        let f = Rgb::splat(3.0);
        let uniform = 0.5 * m.square([(f, 2.0), (Rgb::ZERO, 2.0)], false);
        let guided = m.square([(f, 2.0), (Rgb::ZERO, 2.0)], true);
        assert!((uniform - guided).abs() < 1e-9, "{uniform} {guided}");
        assert!((uniform - 4.5 / 1.8).abs() < 1e-6);
        assert_eq!(m.square([(Rgb::ZERO, 0.0), (Rgb::ZERO, 0.0)], true), 0.0);
    }

    #[test]
    fn rarity_is_the_weight_of_the_light() {
        // All light where q = 0: it is drawn a times as often as by uniform numbers.
        let m = Mixture {
            uniform_fraction: 0.25,
        };
        let (estimate, _) = m.divide([(Rgb::ONE, 0.0), (Rgb::ONE, 0.0)]);
        let rarity = m.rarity([(Rgb::ONE, 0.0), (Rgb::ONE, 0.0)]);
        assert!((rarity / f64::from(luminance(estimate)) - 4.0).abs() < 1e-6);
        assert_eq!(m.rarity([(Rgb::ZERO, 0.0), (Rgb::ZERO, 0.0)]), 0.0);
    }

    #[test]
    fn a_dark_term_has_no_weight() {
        let m = Mixture {
            uniform_fraction: 0.0,
        };
        let (estimate, weight) = m.divide([(Rgb::ZERO, 0.0), (Rgb::ONE, 4.0)]);
        assert_eq!((estimate, weight), (Rgb::splat(0.25), 0.25));
        assert_eq!(
            m.divide([(Rgb::ZERO, 0.0), (Rgb::ZERO, 0.0)]),
            (Rgb::ZERO, 0.0)
        );
    }
}
