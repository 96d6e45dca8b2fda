//! The largest contributions of a render, and how heavy the tail is that they are drawn from.
//!
//! A variance is only worth as much as the tail lets it be: where contributions fall off as a Pareto distribution of shape
//! k ≥ ½ they have no variance, and what the samples say of it grows with their number. k is estimated as in Pareto-smoothed
//! importance sampling (Vehtari, Simpson, Gelman, Yao & Gabry 2024, JMLR 25): a generalised Pareto distribution is fitted
//! to the largest values (Zhang & Stephens 2009, Technometrics 51(3)), and above .7 no practical number of samples helps.

/// Values that are kept: as many as the fit uses at 116,000 paths that carry light. More would make it steadier, not better.
const MOST: usize = 1024;

/// Fewer values than these make no fit.
const LEAST: usize = 20;

/// Shape that the fit is drawn towards, and how many values this counts as (Vehtari et al. 2024, appendix C).
const PRIOR: [f64; 2] = [0.5, 10.0];

/// The largest values of a set: the same whatever the order in which they come and sets are merged.
#[derive(Clone, Debug, Default)]
pub struct Tail {
    /// At most twice [`MOST`].
    kept: Vec<f32>,
    /// Values up to here are not among the largest.
    floor: f32,
}

impl Tail {
    /// Adds a positive value. One comparison for most of them.
    #[inline]
    pub fn add(&mut self, value: f32) {
        if value > self.floor {
            self.kept.push(value);
            if self.kept.len() == 2 * MOST {
                self.prune();
            }
        }
    }

    /// Adds another set.
    pub fn merge(&mut self, other: &Self) {
        for &value in &other.kept {
            self.add(value);
        }
    }

    fn prune(&mut self) {
        if self.kept.len() > MOST {
            let (_, least, _) = self
                .kept
                .select_nth_unstable_by(MOST - 1, |a, b| b.total_cmp(a));
            self.floor = *least;
            self.kept.truncate(MOST);
        }
    }

    /// The largest values, from the largest down.
    pub fn largest(&self) -> Vec<f32> {
        let mut values = self.kept.clone();
        values.sort_unstable_by(|a, b| b.total_cmp(a));
        values.truncate(MOST);
        values
    }

    /// The shape of the tail of `count` positive values, of which these are the largest, and how many of them it was
    /// fitted to. `None` where they are too few, or where the largest are all alike.
    pub fn pareto(&self, count: u64) -> Option<Pareto> {
        let count = count as f64;
        let wanted = (0.2 * count).min(3.0 * count.sqrt()) as usize;
        let largest = self.largest();
        // The value below the tail is where it begins.
        let n = wanted.min(largest.len().saturating_sub(1));
        let begin = f64::from(*largest.get(n)?);
        let mut above: Vec<f64> = largest[..n].iter().map(|&x| f64::from(x) - begin).collect();
        above.retain(|&x| x > 0.0);
        above.reverse();
        (above.len() >= LEAST).then_some(())?;
        let shape = generalised_pareto(&above);
        shape.is_finite().then_some(Pareto {
            shape,
            values: above.len(),
        })
    }
}

/// A generalised Pareto distribution fitted to a tail.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pareto {
    /// k̂: above ½ there is no variance, above 1 no mean; 0 is an exponential tail, below 0 one that ends.
    pub shape: f64,
    /// Values that it was fitted to.
    pub values: usize,
}

/// Shape of a generalised Pareto distribution by the quasi-Bayesian estimator of Zhang & Stephens (2009), of positive
/// values in increasing order; drawn to ½ by a weak prior.
fn generalised_pareto(values: &[f64]) -> f64 {
    let n = values.len() as f64;
    let largest = values[values.len() - 1];
    let quartile = values[(n / 4.0 + 0.5) as usize - 1];
    let candidates = 30 + n.sqrt() as usize;
    // In units of the largest value: the shape has no unit, and what is far below one does not vanish.
    let shape = |theta: f64| values.iter().map(|x| (-theta * x).ln_1p()).sum::<f64>() / n;
    let thetas: Vec<f64> = (1..=candidates)
        .map(|j| {
            let step = 1.0 - (candidates as f64 / (j as f64 - 0.5)).sqrt();
            1.0 / largest + step / (3.0 * quartile)
        })
        .collect();
    let likelihoods: Vec<f64> = thetas
        .iter()
        .map(|&theta| {
            let k = shape(theta);
            n * ((-theta / k).ln() - k - 1.0)
        })
        .collect();
    let best = likelihoods
        .iter()
        .copied()
        .fold(f64::NEG_INFINITY, f64::max);
    let (mut sum, mut total) = (0.0, 0.0);
    for (theta, likelihood) in thetas.iter().zip(&likelihoods) {
        let weight = (likelihood - best).exp();
        if weight.is_finite() {
            sum += theta * weight;
            total += weight;
        }
    }
    let [prior, strength] = PRIOR;
    (shape(sum / total) * n + prior * strength) / (n + strength)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use pss_rng::{Purpose, Stream, to_unit};

    /// Uniform numbers in (0, 1].
    fn numbers(n: usize, seed: u64) -> Vec<f64> {
        let stream = Stream::new(seed, Purpose::Path);
        (0..n as u32)
            .map(|i| 1.0 - f64::from(to_unit(stream.block(i, 0, 0)[0])))
            .collect()
    }

    fn tail_of(values: impl Iterator<Item = f32>) -> Tail {
        let mut tail = Tail::default();
        values.for_each(|x| tail.add(x));
        tail
    }

    #[test]
    fn known_tails_are_recovered() {
        // The estimator's own spread is about (1 + k) / √n, n = 1023 values of the tail.
        for k in [0.1, 0.3, 0.5, 0.7, 1.0, 1.5] {
            let tail = tail_of(numbers(200_000, 1).iter().map(|u| u.powf(-k) as f32));
            let found = tail.pareto(200_000).unwrap();
            assert_eq!(found.values, MOST - 1);
            assert!(
                (found.shape - k).abs() < 4.0 * (1.0 + k) / 32.0,
                "{k}: {found:?}"
            );
        }
    }

    #[test]
    fn light_tails_are_told_from_heavy_ones() {
        let exponential = tail_of(numbers(100_000, 2).iter().map(|u| -u.ln() as f32 + 1.0));
        assert!(exponential.pareto(100_000).unwrap().shape < 0.2);
        let bounded = tail_of(numbers(100_000, 3).iter().map(|&u| u as f32));
        assert!(bounded.pareto(100_000).unwrap().shape < 0.0);
        // Scale has no say.
        for scale in [1e-30, 1e30] {
            let tail = tail_of(numbers(100_000, 4).iter().map(|u| (scale / u) as f32));
            assert!(tail.pareto(100_000).unwrap().shape > 0.8);
        }
    }

    #[test]
    fn the_order_of_values_and_merges_is_irrelevant() {
        let values: Vec<f32> = numbers(30_000, 5)
            .iter()
            .map(|u| (1.0 / u) as f32)
            .collect();
        let whole = tail_of(values.iter().copied());
        let mut sorted = values.clone();
        sorted.sort_by(f32::total_cmp);
        assert_eq!(
            whole.largest(),
            sorted.iter().rev().take(MOST).copied().collect::<Vec<_>>()
        );
        for pieces in [1, 2, 3, 7, 100] {
            let tails = values.chunks(values.len().div_ceil(pieces));
            let tails: Vec<Tail> = tails.map(|c| tail_of(c.iter().copied())).collect();
            let (mut there, mut back) = (Tail::default(), Tail::default());
            tails.iter().for_each(|t| there.merge(t));
            tails.iter().rev().for_each(|t| back.merge(t));
            assert_eq!(there.largest(), whole.largest());
            assert_eq!(back.largest(), whole.largest());
            assert_eq!(there.pareto(30_000), whole.pareto(30_000));
        }
    }

    #[test]
    fn equal_values_or_too_few_are_no_tail() {
        assert_eq!(Tail::default().pareto(0), None);
        let equal = tail_of(std::iter::repeat_n(2.0, 100_000));
        assert_eq!(equal.pareto(100_000), None);
        let few = tail_of((1..50).map(|i| i as f32));
        assert_eq!(few.pareto(49), None);
        // Zeros are no contributions.
        assert!(tail_of([0.0; 100].into_iter()).largest().is_empty());
    }

    #[test]
    fn one_outlier_among_many_does_not_hide() {
        let values = numbers(1000, 6);
        let values = values.iter().map(|&u| u as f32).chain([1e9]);
        assert!(tail_of(values).pareto(1001).unwrap().shape > 0.1);
    }
}
