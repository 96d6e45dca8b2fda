//! Choice among a finite number of things in proportion to weights.

/// A discrete distribution, inverted through its cumulative sum: monotone in the number, so that what a
/// guide learns about the number stays learnt. A guide table (Chen and Asau 1974, *AIIE Transactions* 6, 163) says where
/// to look, so that a choice among ten thousand costs what one among ten does.
#[derive(Clone, Debug)]
pub struct Discrete {
    /// Cumulative probabilities, the last one 1; `cdf[i]` is the upper end of item i.
    cdf: Vec<f32>,
    /// How many items end at or below j ÷ 2ⁿ, for each j in 0 ..= 2ⁿ: a power of two at least as large as the number of items,
    /// so that a number's place in the table is exact.
    starts: Vec<u32>,
}

impl Discrete {
    /// From weights; negative and non-finite ones count as 0. Without any weight all items are equal.
    pub fn new(weights: impl Iterator<Item = f32> + Clone) -> Self {
        let clean = |w: f32| {
            if w.is_finite() && w > 0.0 {
                f64::from(w)
            } else {
                0.0
            }
        };
        let total: f64 = weights.clone().map(clean).sum();
        let mut sum = 0.0;
        let mut cdf: Vec<f32> = weights
            .map(|w| {
                sum += if total > 0.0 { clean(w) / total } else { 1.0 };
                sum as f32
            })
            .collect();
        if total <= 0.0 {
            let n = cdf.len() as f32;
            cdf.iter_mut().for_each(|c| *c /= n);
        }
        // Rounding must not leave a number without an item, nor an item of no weight with one.
        if let Some(&last) = cdf.last() {
            let start = cdf.partition_point(|&c| c < last);
            cdf[start..].fill(1.0);
        }
        let steps = cdf.len().next_power_of_two();
        let (mut ended, width) = (0, 1.0 / steps as f32);
        let starts = (0..=steps)
            .map(|j| {
                let below = cdf[ended..].iter().take_while(|&&c| c <= j as f32 * width);
                ended += below.count();
                ended as u32
            })
            .collect();
        Self { cdf, starts }
    }

    /// Number of items.
    pub fn len(&self) -> usize {
        self.cdf.len()
    }

    /// Whether there is nothing to choose.
    pub fn is_empty(&self) -> bool {
        self.cdf.is_empty()
    }

    /// Upper ends of the items' intervals of [0, 1), the last one 1.
    pub fn bounds(&self) -> &[f32] {
        &self.cdf
    }

    /// Probability of item `i`.
    #[inline]
    pub fn probability(&self, i: usize) -> f32 {
        self.cdf[i] - if i > 0 { self.cdf[i - 1] } else { 0.0 }
    }

    /// The item that `u` falls on; none at 1 and above.
    #[inline]
    fn item(&self, u: f32) -> usize {
        // NaN and negative numbers become 0.
        let step = (u * (self.starts.len() - 1) as f32) as usize;
        match self.starts.get(step..step + 2) {
            Some(&[low, high]) => {
                let (low, high) = (low as usize, high as usize);
                low + self.cdf[low..high].partition_point(|&c| c <= u)
            }
            _ => self.cdf.len(),
        }
    }

    /// The item that `u` in [0, 1) falls on, its probability, and `u` rescaled to [0, 1) within it.
    #[inline]
    pub fn sample_reuse(&self, u: f32) -> Option<(usize, f32, f32)> {
        let i = self.item(u);
        let &end = self.cdf.get(i)?;
        let start = if i > 0 { self.cdf[i - 1] } else { 0.0 };
        let p = end - start;
        Some((i, p, ((u - start) / p).clamp(0.0, 1.0 - f32::EPSILON / 2.0)))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn items_of_no_weight_are_never_chosen() {
        let d = Discrete::new([0.0, 1.0, 0.0, 3.0, 0.0].into_iter());
        for i in 0..1000 {
            let (item, p, _) = d.sample_reuse(i as f32 / 1000.0).unwrap();
            assert!(
                (item == 1 && p == 0.25) || (item == 3 && p == 0.75),
                "{item} {p}"
            );
        }
        assert_eq!(d.sample_reuse(1.0 - f32::EPSILON / 2.0).unwrap().0, 3);
    }

    #[test]
    fn the_guide_table_finds_what_a_search_finds() {
        for n in [1_u32, 2, 3, 7, 64, 1000, 4097] {
            // Weights over six orders of magnitude, every fifth one 0.
            let weight = |i: u32| {
                let x = (f64::from(i) * 0.618_034).fract() as f32;
                if i % 5 == 4 { 0.0 } else { x.powi(12) }
            };
            let d = Discrete::new((0..n).map(weight));
            let borders = d
                .bounds()
                .iter()
                .flat_map(|&c| [c.next_down(), c, c.next_up()]);
            let even = (0..4096).map(|i| i as f32 / 4096.0);
            for u in borders.chain(even).filter(|u| (0.0..1.0).contains(u)) {
                let want = d.cdf.partition_point(|&c| c <= u);
                assert_eq!(d.item(u), want, "{n} items, u = {u}");
            }
            assert!(d.sample_reuse(1.0).is_none());
        }
    }

    #[test]
    fn reuse_is_the_inverse_within_an_item() {
        let d = Discrete::new([1.0, 1.0].into_iter());
        assert_eq!(d.sample_reuse(0.75), Some((1, 0.5, 0.5)));
    }

    #[test]
    fn without_weights_all_are_equal() {
        let d = Discrete::new([0.0; 4].into_iter());
        assert_eq!(d.sample_reuse(0.6).unwrap().0, 2);
        assert!(
            Discrete::new(std::iter::empty())
                .sample_reuse(0.5)
                .is_none()
        );
    }
}
