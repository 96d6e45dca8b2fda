//! Loops over the rows of a block. The heads' values lie as `[value][row]`, `rows` to a value; loops run over copies on
//! the stack, which cannot overlap: with as many slices the compiler would have to prove or to check that, and gives up on
//! vectors.

use super::math::exp;

/// Half a step of a 24-bit uniform number.
pub(super) const HALF_STEP: f32 = 1.0 / 33_554_432.0;

/// Largest number below 1 that a 24-bit uniform number takes.
pub(super) const BELOW_ONE: f32 = 1.0 - f32::EPSILON / 2.0;

/// Most rows of a block: two vectors of AVX.
pub(super) const LANES: usize = 16;

/// A value of each row.
pub(super) type Lanes = [f32; LANES];

/// Rows that are meant: all bits set, or none.
pub(super) type Mask = [u32; LANES];

#[inline(always)]
pub(super) fn load(from: &[f32], rows: usize) -> Lanes {
    let mut lanes = [0.0; LANES];
    lanes[..rows].copy_from_slice(&from[..rows]);
    lanes
}

/// The i-th values of all rows.
#[inline(always)]
pub(super) fn part(from: &[f32], i: usize, rows: usize) -> Lanes {
    load(&from[i * rows..], rows)
}

#[inline(always)]
pub(super) fn store(to: &mut [f32], i: usize, lanes: &Lanes, rows: usize) {
    to[i * rows..][..rows].copy_from_slice(&lanes[..rows]);
}

/// All bits of the rows in which `a` is at least `b`.
#[inline(always)]
pub(super) fn at_least(rows: usize, a: &Lanes, b: &Lanes) -> Mask {
    let mut mask = [0; LANES];
    for r in 0..rows {
        mask[r] = if a[r] >= b[r] { u32::MAX } else { 0 };
    }
    mask
}

/// `new` in the rows of the mask, `old` in the others. Bit by bit: of a plain choice the compiler makes a conditional store,
/// which it cannot turn into vectors.
#[inline(always)]
pub(super) fn choose(rows: usize, mask: &Mask, new: &Lanes, old: &Lanes) -> Lanes {
    let mut lanes = *old;
    for r in 0..rows {
        lanes[r] = f32::from_bits((new[r].to_bits() & mask[r]) | (old[r].to_bits() & !mask[r]));
    }
    lanes
}

/// Softmax over the first `n` values of each row.
#[inline(always)]
pub(super) fn softmax(n: usize, rows: usize, logits: &[f32], shares: &mut [f32]) {
    let mut most = [f32::NEG_INFINITY; LANES];
    for j in 0..n {
        let logit = part(logits, j, rows);
        for r in 0..rows {
            most[r] = most[r].max(logit[r]);
        }
    }
    let mut sum = [0.0; LANES];
    for j in 0..n {
        let mut share = part(logits, j, rows);
        for r in 0..rows {
            share[r] = exp(share[r] - most[r]);
            sum[r] += share[r];
        }
        store(shares, j, &share, rows);
    }
    let inverse = sum.map(|sum| 1.0 / sum);
    for shares in shares.chunks_exact_mut(rows).take(n) {
        for r in 0..rows {
            shares[r] *= inverse[r];
        }
    }
}
