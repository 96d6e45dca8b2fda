//! What flows and nets compute with: the instruction set, a layer of a network, blocks of rows, functions in f32.
//!
//! Networks are evaluated by own code on packed weights, because the graph of a tensor library costs more than the
//! arithmetic of layers of 40 units. A block of [`ROWS`] rows goes through all layers before the next block starts, so that
//! activations stay in the first-level cache. Rows never mix, and every row sees the same operations in the same order:
//! results do not depend on the batch, and AVX2 and AVX-512 give the same bits.

pub(crate) mod lanes;
pub(crate) mod layer;
pub(crate) mod math;
pub(crate) mod product;

use std::sync::OnceLock;

use pulp::{Simd, WithSimd};

/// Rows of a block: a vector of AVX-512, two of AVX2.
pub(crate) const ROWS: usize = 16;

/// Instructions that kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Isa {
    /// The target's own: NEON where that is the target's, plain code on x86.
    Portable,
    /// AVX2 and FMA.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// AVX-512 F, BW, CD, DQ, VL.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Isa {
    /// All that this program has code for and this processor runs, the best last.
    pub(crate) fn supported() -> Vec<Self> {
        let mut all = vec![Self::Portable];
        #[cfg(target_arch = "x86_64")]
        {
            if pulp::x86::V3::try_new().is_some() {
                all.push(Self::Avx2);
            }
            if pulp::x86::V4::try_new().is_some() {
                all.push(Self::Avx512);
            }
        }
        all
    }

    /// The name in `PSSFLOW_ISA`.
    fn name(self) -> &'static str {
        match self {
            Self::Portable => "sse4.2",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => "avx512",
        }
    }

    /// The best that is supported, or what `PSSFLOW_ISA` names. It is read once. A name that is unknown or not supported
    /// changes nothing here: Embree's device refuses it with a message.
    fn chosen() -> Self {
        static CHOSEN: OnceLock<Isa> = OnceLock::new();
        *CHOSEN.get_or_init(|| Self::named(&std::env::var("PSSFLOW_ISA").unwrap_or_default()))
    }

    /// What has this name, else the best that is supported.
    fn named(name: &str) -> Self {
        let supported = Self::supported();
        let named = supported.iter().find(|isa| isa.name() == name);
        *named.or(supported.last()).unwrap_or(&Self::Portable)
    }

    /// Runs `op` compiled for these instructions; portable code where the processor lacks them.
    pub(crate) fn run<O: WithSimd>(self, op: O) -> O::Output {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                if let Some(simd) = pulp::x86::V4::try_new() {
                    return Simd::vectorize(simd, op);
                }
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => {
                if let Some(simd) = pulp::x86::V3::try_new() {
                    return Simd::vectorize(simd, op);
                }
            }
            Self::Portable => {}
        }
        #[cfg(target_arch = "x86_64")]
        return Simd::vectorize(pulp::Scalar, op);
        #[cfg(not(target_arch = "x86_64"))]
        pulp::Arch::new().dispatch(op)
    }
}

/// Runs `op` on the chosen instructions.
pub(crate) fn dispatch<O: WithSimd>(op: O) -> O::Output {
    Isa::chosen().run(op)
}

/// Instructions that guides are evaluated with, by the names of `PSSFLOW_ISA`: `avx512`, `avx2`, or `sse4.2` for code
/// without vectors of its own.
pub fn isa() -> &'static str {
    Isa::chosen().name()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_chooses_its_instructions_and_any_other_the_best() {
        let supported = Isa::supported();
        for &isa in &supported {
            assert_eq!(Isa::named(isa.name()), isa);
        }
        for name in ["", "avx3"] {
            assert_eq!(Some(&Isa::named(name)), supported.last());
        }
        assert!(supported.iter().any(|isa| isa.name() == self::isa()));
    }
}
