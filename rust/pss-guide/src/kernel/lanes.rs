//! A value of each row of a block. The heads' loops run over copies on the stack, which cannot overlap: with as many slices
//! the compiler would have to prove or to check that, and gives up on vectors.

use std::ops::{Index, IndexMut};

use pulp::Simd;

use super::ROWS;
use super::math::Functions;

/// Half a step of a 24-bit uniform number.
pub(crate) const HALF_STEP: f32 = 1.0 / 33_554_432.0;

/// Largest number below 1 that a 24-bit uniform number takes.
pub(crate) const BELOW_ONE: f32 = 1.0 - f32::EPSILON / 2.0;

/// A value of each row; no vector of it crosses a line of the cache.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub(crate) struct Lanes(pub(crate) [f32; ROWS]);

/// Rows that are meant: all bits set, or none.
pub(crate) type Mask = [u32; ROWS];

impl Default for Lanes {
    #[inline(always)]
    fn default() -> Self {
        Self::all(0.0)
    }
}

impl Index<usize> for Lanes {
    type Output = f32;

    #[inline(always)]
    fn index(&self, row: usize) -> &f32 {
        &self.0[row]
    }
}

impl IndexMut<usize> for Lanes {
    #[inline(always)]
    fn index_mut(&mut self, row: usize) -> &mut f32 {
        &mut self.0[row]
    }
}

impl Lanes {
    #[inline(always)]
    pub(crate) const fn all(x: f32) -> Self {
        Self([x; ROWS])
    }

    /// As vectors, which are V.
    #[inline(always)]
    pub(crate) fn vectors<S: Simd, const V: usize>(&self) -> &[S::f32s; V] {
        &pulp::as_arrays::<V, _>(S::as_simd_f32s(&self.0).0).0[0]
    }

    #[inline(always)]
    pub(crate) fn vectors_mut<S: Simd, const V: usize>(&mut self) -> &mut [S::f32s; V] {
        &mut pulp::as_arrays_mut::<V, _>(S::as_mut_simd_f32s(&mut self.0).0).0[0]
    }
}

/// All bits of the rows in which `a` is at least `b`.
#[inline(always)]
pub(crate) fn at_least(a: &Lanes, b: &Lanes) -> Mask {
    let mut mask = [0; ROWS];
    for r in 0..ROWS {
        mask[r] = if a[r] >= b[r] { u32::MAX } else { 0 };
    }
    mask
}

/// `new` in the rows of the mask, `old` in the others. Bit by bit: of a plain choice the compiler makes a conditional store,
/// which it cannot turn into vectors.
#[inline(always)]
pub(crate) fn choose(mask: &Mask, new: &Lanes, old: &Lanes) -> Lanes {
    let mut lanes = *old;
    for r in 0..ROWS {
        lanes[r] = f32::from_bits((new[r].to_bits() & mask[r]) | (old[r].to_bits() & !mask[r]));
    }
    lanes
}

/// Softmax over the values of each row.
#[inline(always)]
pub(crate) fn softmax<S: Simd>(simd: S, logits: &[Lanes], shares: &mut [Lanes]) {
    let mut most = Lanes::all(f32::NEG_INFINITY);
    for logit in logits {
        for r in 0..ROWS {
            most[r] = most[r].max(logit[r]);
        }
    }
    let mut sum = Lanes::default();
    for (share, logit) in shares.iter_mut().zip(logits) {
        let mut own = *logit;
        for r in 0..ROWS {
            own[r] = simd.exp(own[r] - most[r]);
            sum[r] += own[r];
        }
        *share = own;
    }
    let inverse = sum.0.map(|sum| 1.0 / sum);
    for share in shares.iter_mut().take(logits.len()) {
        for r in 0..ROWS {
            share[r] *= inverse[r];
        }
    }
}
