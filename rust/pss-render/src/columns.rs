//! The columns of u: what each primary number decides. The only place that knows.
//!
//! For k bounces: two numbers for the direction at each of x₁ … x_{k−1}, one for the emitter, two for
//! the point on it; with the strategy `mis` two more for the BSDF-sampled ray at x_k. The camera's
//! numbers (film position) and the mixture's coin are not among them: they are never learned.

use std::ops::Range;

use serde::{Deserialize, Serialize};

/// How the light is joined at x_k.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EmitterStrategy {
    /// Next-event estimation and a BSDF-sampled ray, weighted by the balance heuristic.
    #[default]
    Mis,
    /// Next-event estimation alone, as in the thesis; blind where x_k is a mirror.
    Nee,
}

impl EmitterStrategy {
    /// The name used in options and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mis => "mis",
            Self::Nee => "nee",
        }
    }
}

/// What a group of columns decides, and when the tracer asks for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Everything at once, before the path is traced: columns 0 … 2k.
    Path,
    /// The direction at x_b, b counted from 1.
    Direction(usize),
    /// Which emitter x_k is joined to.
    Emitter,
    /// Where on that emitter.
    Light,
    /// The BSDF-sampled ray at x_k.
    BsdfRay,
}

/// The table of columns for `k` bounces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Columns {
    k: usize,
    strategy: EmitterStrategy,
}

impl Columns {
    /// The table for `k` bounces. With none there is nothing to decide: emitters that the camera sees.
    pub fn new(k: usize, strategy: EmitterStrategy) -> Self {
        Self { k, strategy }
    }

    /// Number of bounces.
    pub fn k(&self) -> usize {
        self.k
    }

    /// The strategy that this table is for.
    pub fn strategy(&self) -> EmitterStrategy {
        self.strategy
    }

    /// Columns that a guide of the whole path learns: 2k + 1, or none where nothing is reflected. The two of the BSDF ray,
    /// where there is one, are a decision of their own.
    pub fn learned(&self) -> usize {
        if self.k == 0 { 0 } else { 2 * self.k + 1 }
    }

    /// All columns: 2k + 1, and two more with `mis`.
    pub fn width(&self) -> usize {
        self.learned()
            + if self.k > 0 && self.strategy == EmitterStrategy::Mis {
                2
            } else {
                0
            }
    }

    /// The columns of a decision.
    pub fn range(&self, decision: Decision) -> Range<usize> {
        let k = self.k;
        match decision {
            Decision::Path => 0..2 * k + 1,
            Decision::Direction(b) => 2 * b - 2..2 * b,
            Decision::Emitter => 2 * k - 2..2 * k - 1,
            Decision::Light => 2 * k - 1..2 * k + 1,
            Decision::BsdfRay => 2 * k + 1..2 * k + 3,
        }
    }

    /// One name a column, in order.
    pub fn names(&self) -> Vec<String> {
        let mut names = Vec::with_capacity(self.width());
        if self.k == 0 {
            return names;
        }
        for b in 1..self.k {
            names.push(format!("x{b}.direction.0"));
            names.push(format!("x{b}.direction.1"));
        }
        names.push("emitter".to_owned());
        names.push("light.0".to_owned());
        names.push("light.1".to_owned());
        if self.strategy == EmitterStrategy::Mis {
            names.push(format!("x{}.bsdf_ray.0", self.k));
            names.push(format!("x{}.bsdf_ray.1", self.k));
        }
        names
    }

    /// Hash of the learned columns' meaning (hex), stored in every saved guide.
    ///
    /// The strategy is not part of it: what is learned of the BSDF ray is not asked for where there is none, and its two
    /// numbers mean the same everywhere. The parametrisation is, since it changes what a direction's numbers mean.
    pub fn hash(&self, parametrisation: &str) -> String {
        let mut hasher = blake3::Hasher::new();
        hasher.update(b"pssflow columns 1\n");
        hasher.update(parametrisation.as_bytes());
        for name in &self.names()[..self.learned()] {
            hasher.update(b"\n");
            hasher.update(name.as_bytes());
        }
        hasher.finalize().to_hex()[..32].to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_decisions_tile_the_columns() {
        for k in 1..=6 {
            for strategy in [EmitterStrategy::Mis, EmitterStrategy::Nee] {
                let columns = Columns::new(k, strategy);
                let mut next = 0;
                let mut decisions: Vec<_> = (1..k).map(Decision::Direction).collect();
                decisions.extend([Decision::Emitter, Decision::Light]);
                if strategy == EmitterStrategy::Mis {
                    decisions.push(Decision::BsdfRay);
                }
                for d in decisions {
                    assert_eq!(columns.range(d).start, next);
                    next = columns.range(d).end;
                }
                assert_eq!(next, columns.width());
                assert_eq!(columns.names().len(), columns.width());
            }
        }
    }

    #[test]
    fn without_bounces_nothing_is_decided() {
        let columns = Columns::new(0, EmitterStrategy::Mis);
        assert_eq!((columns.learned(), columns.width()), (0, 0));
        assert!(columns.names().is_empty());
    }

    #[test]
    fn hashes_differ_where_the_meaning_does() {
        let h = |k, p| Columns::new(k, EmitterStrategy::Mis).hash(p);
        assert_ne!(h(2, "bsdf"), h(3, "bsdf"));
        assert_ne!(h(2, "bsdf"), h(2, "cosine"));
        assert_eq!(
            h(2, "bsdf"),
            Columns::new(2, EmitterStrategy::Nee).hash("bsdf")
        );
    }
}
