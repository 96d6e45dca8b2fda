//! Functions in f32, branch-free, so that loops over rows vectorise. Each states its error, with and without FMA.

use pulp::Simd;

/// 1/√π.
pub(crate) const FRAC_1_SQRT_PI: f32 = 0.564_189_6;

/// Cut to [−1, 1]; what is not a number becomes −1, as every other number would do.
#[inline(always)]
pub(crate) fn inside(x: f32) -> f32 {
    // In this order they drop NaN, which `clamp` would keep.
    #[allow(clippy::manual_clamp, reason = "a number comes out whatever goes in")]
    x.max(-1.0).min(1.0)
}

/// Functions that a loop compiled for some instructions may call.
pub(crate) trait Functions: Simd {
    /// a · b + c, rounded once where that is one instruction: elsewhere `f32::mul_add` calls the system's library.
    #[inline(always)]
    fn fma(self, a: f32, b: f32, c: f32) -> f32 {
        if Self::F32_LANES >= 8 || cfg!(target_arch = "aarch64") {
            a.mul_add(b, c)
        } else {
            a * b + c
        }
    }

    /// A polynomial, coefficients from the highest power down.
    #[inline(always)]
    fn polynomial<const N: usize>(self, x: f32, coefficients: [f32; N]) -> f32 {
        let mut sum = coefficients[0];
        for &c in &coefficients[1..] {
            sum = self.fma(sum, x, c);
        }
        sum
    }

    /// exp, relative error below 3e-7, argument clamped to ±87.
    #[inline(always)]
    fn exp(self, x: f32) -> f32 {
        // Adding 1.5·2²³ rounds to an integer that then sits in the low bits of the sum.
        const MAGIC: f32 = 12_582_912.0;
        let x = x.clamp(-87.0, 87.0);
        let k = self.fma(x, std::f32::consts::LOG2_E, MAGIC);
        let n = k - MAGIC;
        // ln 2 in two parts, the first with few enough bits that n · it is exact.
        let r = self.fma(n, 2.121_944_4e-4, self.fma(n, -0.693_359_4, x));
        let taylor = [
            1.0 / 5040.0,
            1.0 / 720.0,
            1.0 / 120.0,
            1.0 / 24.0,
            1.0 / 6.0,
            0.5,
            1.0,
            1.0,
        ];
        let p = self.polynomial(r, taylor);
        p * f32::from_bits((k.to_bits() << 23).wrapping_add(0x3f80_0000))
    }

    /// tanh, absolute error below 3e-7.
    #[inline(always)]
    fn tanh(self, x: f32) -> f32 {
        1.0 - 2.0 / (1.0 + self.exp(2.0 * x))
    }

    /// erfc for x ≥ 0, relative error below 6e-7 + 2e-7·x², the latter from f32's square (Press et al. 1992, *Numerical
    /// Recipes*, §6.2).
    #[inline(always)]
    fn erfc(self, x: f32) -> f32 {
        let t = 1.0 / (1.0 + 0.5 * x);
        let coefficients = [
            0.170_872_77,
            -0.822_152_23,
            1.488_515_9,
            -1.135_204,
            0.278_868_07,
            -0.186_288_06,
            0.096_784_18,
            0.374_091_96,
            1.000_023_7,
            -1.265_512_2,
        ];
        let p = self.polynomial(t, coefficients);
        t * self.exp(self.fma(-x, x, p))
    }

    /// ln for normal x > 0, absolute error below 3e-7 + 1e-7·|ln x| (polynomial of the Cephes library's `logf`).
    #[inline(always)]
    fn ln(self, x: f32) -> f32 {
        // √½ in bits: the mantissa lands in [√½, √2).
        let bits = x.to_bits() as i32;
        let e = (bits - 0x3f35_04f3) >> 23;
        let f = f32::from_bits((bits - (e << 23)) as u32) - 1.0;
        let e = e as f32;
        let z = f * f;
        let coefficients = [
            0.070_376_836,
            -0.115_146_1,
            0.116_769_99,
            -0.124_201_41,
            0.142_493_23,
            -0.166_680_58,
            0.200_007_15,
            -0.249_999_94,
            0.333_333_3,
        ];
        let p = self.polynomial(f, coefficients);
        let y = self.fma(f * z, p, self.fma(e, -2.121_944_4e-4, -0.5 * z));
        self.fma(e, 0.693_359_4, f + y)
    }

    /// The y ≥ 0 with erfc(y) = c, for c in (0, 1]; relative error below 2e-6 for c ≥ 1e-7 (Giles 2012, *GPU Computing
    /// Gems*, ch. 10).
    #[inline(always)]
    fn inverse_erfc(self, c: f32) -> f32 {
        let x = 1.0 - c;
        let w = -self.ln((c * (2.0 - c)).max(4e-8));
        let coefficients = [
            2.810_226_4e-8,
            3.432_739_4e-7,
            -3.523_387_7e-6,
            -4.391_506_5e-6,
            0.000_218_580_87,
            -0.001_253_725,
            -0.004_177_681_7,
            0.246_640_73,
            1.501_409_4,
        ];
        let centre = self.polynomial(w - 2.5, coefficients);
        let coefficients = [
            -0.000_200_214_26,
            0.000_100_950_56,
            0.001_349_343_2,
            -0.003_673_428_5,
            0.005_739_508,
            -0.007_622_461_3,
            0.009_438_870_5,
            1.001_674,
            2.832_976_8,
        ];
        let tail = self.polynomial(w.max(0.0).sqrt() - 3.0, coefficients);
        x * if w < 5.0 { centre } else { tail }
    }
}

impl<S: Simd> Functions for S {}

#[cfg(test)]
mod tests {
    use pulp::WithSimd;

    use super::*;
    use crate::kernel::Isa;

    /// erfc by its continued fraction beyond 2, by its series below.
    fn exact(x: f64) -> f64 {
        let gauss = (-x * x).exp() / std::f64::consts::PI.sqrt();
        if x > 2.0 {
            let f = (1..=200).rev().fold(x, |f, k| x + 0.5 * f64::from(k) / f);
            return gauss / f;
        }
        let (mut term, mut sum) = (x, x);
        for n in 1..100 {
            term *= 2.0 * x * x / f64::from(2 * n + 1);
            sum += term;
        }
        1.0 - 2.0 * gauss * sum
    }

    struct Check;

    impl WithSimd for Check {
        type Output = ();

        fn with_simd<S: Simd>(self, simd: S) {
            for i in -870_000..=870_000 {
                let x = i as f32 * 1e-4;
                let (e, want) = (simd.exp(x), f64::from(x).exp());
                let error = (f64::from(e) / want - 1.0).abs();
                assert!(error < 3e-7, "exp({x}) = {e}");
                let (t, want) = (simd.tanh(x), f64::from(x).tanh());
                assert!((f64::from(t) - want).abs() < 3e-7, "tanh({x}) = {t}");
            }
            assert!(simd.exp(1e9).is_finite() && simd.exp(-1e9) > 0.0);
            assert_eq!((simd.tanh(1e9), simd.tanh(-1e9)), (1.0, -1.0));
            for i in 0..=90_000 {
                let x = i as f32 * 1e-4;
                let want = exact(f64::from(x));
                let error = (f64::from(simd.erfc(x)) / want - 1.0).abs();
                assert!(error < 6e-7 + 2e-7 * f64::from(x * x), "erfc({x}): {error}");
            }
            for i in -1200..=1200 {
                let x = (f64::from(i) * 0.07).exp() as f32;
                let want = f64::from(x).ln();
                let error = (f64::from(simd.ln(x)) - want).abs();
                assert!(error < 3e-7 + 1e-7 * want.abs(), "ln({x}): {error}");
            }
            for i in 0..=1600 {
                let c = (-f64::from(i) * 0.01).exp() as f32;
                let y = f64::from(simd.inverse_erfc(c));
                // Newton's correction, taken relative to y.
                let slope = 2.0 * (-y * y).exp() / std::f64::consts::PI.sqrt();
                let error = (exact(y) - f64::from(c)) / slope;
                assert!(
                    error.abs() < 2e-6 * y + 1e-7,
                    "inverse_erfc({c}) = {y}: {error}"
                );
            }
            assert!(simd.erfc(1e4) >= 0.0 && simd.inverse_erfc(1.0) == 0.0);
            assert!(simd.inverse_erfc(0.0).is_finite());
        }
    }

    #[test]
    fn functions_keep_their_stated_errors_on_every_instruction_set() {
        for isa in Isa::supported() {
            isa.run(Check);
        }
    }
}
