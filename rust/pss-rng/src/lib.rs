//! The one generator of random numbers: counter-based, so that a number depends on its name alone.
//!
//! Philox4x32-10 (Salmon et al. 2011, *Parallel random numbers: as easy as 1, 2, 3*): a block of four
//! 32-bit words is a bijection of a 128-bit counter under a 64-bit key. The key is the seed, the counter
//! says who asks (purpose, pixel, sample, group of columns). No state is kept, so the same seed gives
//! the same image for any number of threads and any order of work.

/// What a number is used for; streams of different purposes never overlap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Purpose {
    /// Primary numbers of rendered paths, film position and coin included.
    Path = 1,
    /// Initial weights of networks.
    Weights = 2,
    /// Resampling and shuffling of training data.
    Training = 3,
    /// Base samples of a guide that is asked outside of a render.
    Guide = 4,
    /// Anything that tests draw.
    Test = 5,
}

/// Numbers of one seed and purpose, addressed by three counters.
#[derive(Clone, Copy, Debug)]
pub struct Stream {
    key: [u32; 2],
    purpose: u32,
}

const ROUND_0: u32 = 0xD251_1F53;
const ROUND_1: u32 = 0xCD9E_8D57;
const WEYL_0: u32 = 0x9E37_79B9;
const WEYL_1: u32 = 0xBB67_AE85;

impl Stream {
    /// The stream of `purpose` under `seed`.
    pub const fn new(seed: u64, purpose: Purpose) -> Self {
        Self {
            key: [seed as u32, (seed >> 32) as u32],
            purpose: purpose as u32,
        }
    }

    /// The four words at counter (`a`, `b`, `c`); a path uses (pixel, sample, group of columns).
    #[inline]
    pub const fn block(&self, a: u32, b: u32, c: u32) -> [u32; 4] {
        let mut ctr = [a, b, c, self.purpose];
        let mut key = self.key;
        let mut round = 0;
        while round < 10 {
            let p0 = ROUND_0 as u64 * ctr[0] as u64;
            let p1 = ROUND_1 as u64 * ctr[2] as u64;
            ctr = [
                (p1 >> 32) as u32 ^ ctr[1] ^ key[0],
                p1 as u32,
                (p0 >> 32) as u32 ^ ctr[3] ^ key[1],
                p0 as u32,
            ];
            key = [key[0].wrapping_add(WEYL_0), key[1].wrapping_add(WEYL_1)];
            round += 1;
        }
        ctr
    }

    /// The numbers of (`a`, `b`) one after another.
    pub const fn sequence(self, a: u32, b: u32) -> Sequence {
        Sequence {
            stream: self,
            a,
            b,
            next: 0,
            words: [0; 4],
        }
    }
}

/// Maps a word to [0, 1): the 24 high bits, so the largest value is 1 − 2⁻²⁴.
#[inline]
pub const fn to_unit(word: u32) -> f32 {
    (word >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// A sequential view of a [`Stream`], for shuffles and initial weights.
#[derive(Clone, Debug)]
pub struct Sequence {
    stream: Stream,
    a: u32,
    b: u32,
    next: u64,
    words: [u32; 4],
}

impl Sequence {
    /// The next 32 bits.
    pub fn next_u32(&mut self) -> u32 {
        let lane = (self.next % 4) as usize;
        if lane == 0 {
            // More than 2³⁴ numbers of one (a, b) would repeat; the low word of `b` is far from that.
            let block = self.next / 4;
            self.words = self.stream.block(
                self.a,
                self.b.wrapping_add((block >> 32) as u32),
                block as u32,
            );
        }
        self.next += 1;
        self.words[lane]
    }

    /// A number in [0, 1).
    pub fn next_f32(&mut self) -> f32 {
        to_unit(self.next_u32())
    }

    /// A number in [0, 1) with 53 random bits.
    pub fn next_f64(&mut self) -> f64 {
        let high = u64::from(self.next_u32());
        let low = u64::from(self.next_u32());
        ((high << 21) ^ (low >> 11)) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// A standard normal number (Box and Muller 1958).
    pub fn next_normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.next_f64()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.next_f64()).cos()
    }

    /// An index below `n` (Lemire's multiplication; its bias is n·2⁻³², below any use made of it here).
    ///
    /// Returns 0 for `n = 0`.
    pub fn below(&mut self, n: u32) -> u32 {
        ((u64::from(self.next_u32()) * u64::from(n)) >> 32) as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn philox_gives_the_published_words() {
        // Known answers of the Random123 distribution (kat_vectors, philox4x32 10).
        let zero = Stream {
            key: [0, 0],
            purpose: 0,
        };
        assert_eq!(
            zero.block(0, 0, 0),
            [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]
        );
        let ones = Stream {
            key: [!0, !0],
            purpose: !0,
        };
        assert_eq!(
            ones.block(!0, !0, !0),
            [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]
        );
    }

    #[test]
    fn unit_numbers_stay_below_one() {
        assert_eq!(to_unit(0), 0.0);
        assert_eq!(to_unit(!0), 1.0 - f32::EPSILON / 2.0);
    }

    #[test]
    fn normal_numbers_have_unit_variance() {
        let mut s = Stream::new(1, Purpose::Test).sequence(0, 0);
        let n = 100_000;
        let (mut sum, mut square) = (0.0, 0.0);
        for _ in 0..n {
            let x = s.next_normal();
            sum += x;
            square += x * x;
        }
        let (mean, var) = (sum / n as f64, square / n as f64);
        // Five standard errors: 1/√n for the mean, √(2/n) for the variance.
        assert!(mean.abs() < 5.0 / (n as f64).sqrt(), "mean {mean}");
        assert!(
            (var - 1.0).abs() < 5.0 * (2.0 / n as f64).sqrt(),
            "variance {var}"
        );
    }

    #[test]
    fn below_covers_its_range_evenly() {
        let mut s = Stream::new(7, Purpose::Test).sequence(0, 0);
        let mut counts = [0u32; 5];
        for _ in 0..50_000 {
            counts[s.below(5) as usize] += 1;
        }
        // 10,000 ± 5·√8,000.
        assert!(
            counts.iter().all(|&c| c.abs_diff(10_000) < 447),
            "{counts:?}"
        );
    }
}
