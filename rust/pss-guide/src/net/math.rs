//! Functions of the heads in f32, branch-free, so that loops over rows vectorise.

pub(super) use crate::flow::kernel::{exp, tanh};

/// 1/√π.
pub(super) const FRAC_1_SQRT_PI: f32 = 0.564_189_6;

/// erfc for x ≥ 0, relative error below 6e-7 + 2e-7·x², the latter from f32's square (Press et al. 1992, *Numerical Recipes*, §6.2).
#[inline(always)]
pub(super) fn erfc(x: f32) -> f32 {
    let t = 1.0 / (1.0 + 0.5 * x);
    let p = 0.170_872_77;
    let p = p * t - 0.822_152_23;
    let p = p * t + 1.488_515_9;
    let p = p * t - 1.135_204;
    let p = p * t + 0.278_868_07;
    let p = p * t - 0.186_288_06;
    let p = p * t + 0.096_784_18;
    let p = p * t + 0.374_091_96;
    let p = p * t + 1.000_023_7;
    let p = p * t - 1.265_512_2;
    t * exp(p - x * x)
}

/// ln for normal x > 0, absolute error below 3e-7 + 1e-7·|ln x| (polynomial of the Cephes library's `logf`).
#[inline(always)]
pub(super) fn ln(x: f32) -> f32 {
    // √½ in bits: the mantissa lands in [√½, √2).
    let bits = x.to_bits() as i32;
    let e = (bits - 0x3f35_04f3) >> 23;
    let f = f32::from_bits((bits - (e << 23)) as u32) - 1.0;
    let e = e as f32;
    let z = f * f;
    let p = 0.070_376_836;
    let p = p * f - 0.115_146_1;
    let p = p * f + 0.116_769_99;
    let p = p * f - 0.124_201_41;
    let p = p * f + 0.142_493_23;
    let p = p * f - 0.166_680_58;
    let p = p * f + 0.200_007_15;
    let p = p * f - 0.249_999_94;
    let p = p * f + 0.333_333_3;
    let y = f * z * p + e * -2.121_944_4e-4 - 0.5 * z;
    (f + y) + e * 0.693_359_4
}

/// The y ≥ 0 with erfc(y) = c, for c in (0, 1]; relative error below 2e-6 for c ≥ 1e-7 (Giles 2012, *GPU Computing Gems*, ch. 10).
#[inline(always)]
pub(super) fn inverse_erfc(c: f32) -> f32 {
    let x = 1.0 - c;
    let w = -ln((c * (2.0 - c)).max(4e-8));
    let v = w - 2.5;
    let p = 2.810_226_4e-8;
    let p = p * v + 3.432_739_4e-7;
    let p = p * v - 3.523_387_7e-6;
    let p = p * v - 4.391_506_5e-6;
    let p = p * v + 0.000_218_580_87;
    let p = p * v - 0.001_253_725;
    let p = p * v - 0.004_177_681_7;
    let p = p * v + 0.246_640_73;
    let centre = p * v + 1.501_409_4;
    let v = w.max(0.0).sqrt() - 3.0;
    let p = -0.000_200_214_26;
    let p = p * v + 0.000_100_950_56;
    let p = p * v + 0.001_349_343_2;
    let p = p * v - 0.003_673_428_5;
    let p = p * v + 0.005_739_508;
    let p = p * v - 0.007_622_461_3;
    let p = p * v + 0.009_438_870_5;
    let p = p * v + 1.001_674;
    let tail = p * v + 2.832_976_8;
    x * if w < 5.0 { centre } else { tail }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    fn functions_keep_their_stated_errors() {
        for i in 0..=90_000 {
            let x = i as f32 * 1e-4;
            let want = exact(f64::from(x));
            let error = (f64::from(erfc(x)) / want - 1.0).abs();
            assert!(error < 6e-7 + 2e-7 * f64::from(x * x), "erfc({x}): {error}");
        }
        for i in -1200..=1200 {
            let x = (f64::from(i) * 0.07).exp() as f32;
            let want = f64::from(x).ln();
            let error = (f64::from(ln(x)) - want).abs();
            assert!(error < 3e-7 + 1e-7 * want.abs(), "ln({x}): {error}");
        }
        for i in 0..=1600 {
            let c = (-f64::from(i) * 0.01).exp() as f32;
            let y = f64::from(inverse_erfc(c));
            // Newton's correction, taken relative to y.
            let slope = 2.0 * (-y * y).exp() / std::f64::consts::PI.sqrt();
            let error = (exact(y) - f64::from(c)) / slope;
            assert!(
                error.abs() < 2e-6 * y + 1e-7,
                "inverse_erfc({c}) = {y}: {error}"
            );
        }
        assert!(erfc(1e4) >= 0.0 && inverse_erfc(1.0) == 0.0 && inverse_erfc(0.0).is_finite());
    }
}
