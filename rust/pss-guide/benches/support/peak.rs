//! The most multiplications and additions that a core does: registers alone, no memory.

use pulp::{Simd, WithSimd};

/// Sums that are under way at once; enough for two units of latency four, and for sixteen registers.
const SUMS: usize = 12;

/// Rounds of one call: about a millisecond.
const ROUNDS: usize = 60_000;

struct Sums;

impl WithSimd for Sums {
    /// Multiplications done, each with an addition.
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> usize {
        let [a, b] = std::hint::black_box([0.999, 0.001]).map(|x| simd.splat_f32s(x));
        let mut sums = [simd.splat_f32s(1.0); SUMS];
        for _ in 0..ROUNDS {
            for sum in &mut sums {
                *sum = simd.mul_add_e_f32s(*sum, a, b);
            }
        }
        std::hint::black_box(sums.map(|sum| simd.reduce_sum_f32s(sum)));
        SUMS * ROUNDS * S::F32_LANES
    }
}

/// Runs once, on the instructions that kernels use; returns the multiplications done, each with an addition.
pub(crate) fn run() -> usize {
    #[cfg(target_arch = "x86_64")]
    {
        if let ("avx512", Some(simd)) = (pss_guide::isa(), pulp::x86::V4::try_new()) {
            return Simd::vectorize(simd, Sums);
        }
        if let ("avx2", Some(simd)) = (pss_guide::isa(), pulp::x86::V3::try_new()) {
            return Simd::vectorize(simd, Sums);
        }
        Simd::vectorize(pulp::Scalar, Sums)
    }
    #[cfg(not(target_arch = "x86_64"))]
    pulp::Arch::new().dispatch(Sums)
}
