//! A product of guides that model different decisions: q = Π q_d.

use serde_json::{Value, json};

use crate::file::Contents;
use crate::{Context, Decision, Guide, registry};

/// Factors, none of which models a decision of another.
#[derive(Debug)]
pub(crate) struct Composite {
    name: String,
    factors: Vec<Box<dyn Guide>>,
    models: Vec<Decision>,
    dims: usize,
}

impl Composite {
    pub(crate) fn new(factors: Vec<Box<dyn Guide>>, dims: usize) -> Self {
        let names: Vec<&str> = factors.iter().map(|f| f.name()).collect();
        Self {
            name: names.join("+"),
            models: factors.iter().flat_map(|f| f.models()).copied().collect(),
            factors,
            dims,
        }
    }

    /// Rebuilds a composite from a file: the factors' configurations in a list, their tensors numbered.
    pub(crate) fn restore(mut contents: Contents) -> Result<Box<dyn Guide>, String> {
        let dims = contents.config["dims"]
            .as_u64()
            .and_then(|d| usize::try_from(d).ok());
        let dims = dims.ok_or("its configuration has no `dims`")?;
        let mut factors = Vec::new();
        for (i, name) in contents.guide.split('+').enumerate() {
            let config = contents.config["factors"][i].take();
            let prefix = format!("{i}.");
            let mut tensors = Vec::new();
            contents.tensors.retain_mut(|(name, shape, values)| {
                let Some(own) = name.strip_prefix(&prefix) else {
                    return true;
                };
                tensors.push((
                    own.to_owned(),
                    std::mem::take(shape),
                    std::mem::take(values),
                ));
                false
            });
            let spec = registry::find(name).map_err(|e| e.to_string())?;
            factors.push((spec.restore)(Contents {
                guide: name.to_owned(),
                config,
                tensors,
            })?);
        }
        match contents.tensors.first() {
            Some((name, ..)) => Err(format!("tensor {name:?} belongs to no factor")),
            None => Ok(Box::new(Self::new(factors, dims))),
        }
    }

    fn factor(&self, decision: Decision) -> Option<&dyn Guide> {
        let mut factors = self.factors.iter().map(|f| &**f);
        factors.find(|f| f.models().contains(&decision))
    }
}

impl Guide for Composite {
    fn name(&self) -> &str {
        &self.name
    }

    fn models(&self) -> &[Decision] {
        &self.models
    }

    fn dims(&self) -> usize {
        self.dims
    }

    fn looks_at_contexts(&self, decision: Decision) -> bool {
        self.factor(decision)
            .is_some_and(|f| f.looks_at_contexts(decision))
    }

    fn sample(&self, decision: Decision, contexts: &[Context], u: &mut [f32], q: &mut [f32]) {
        match self.factor(decision) {
            Some(factor) => factor.sample(decision, contexts, u, q),
            None => q.fill(1.0),
        }
    }

    fn density(&self, decision: Decision, contexts: &[Context], u: &[f32], q: &mut [f32]) {
        match self.factor(decision) {
            Some(factor) => factor.density(decision, contexts, u, q),
            None => q.fill(1.0),
        }
    }

    fn mass_outside(&self) -> f64 {
        self.factors
            .iter()
            .map(|f| f.mass_outside())
            .fold(0.0, f64::max)
    }

    fn parameters(&self) -> usize {
        self.factors.iter().map(|f| f.parameters()).sum()
    }

    fn describe(&self) -> serde_json::Value {
        let factors: Vec<_> = self.factors.iter().map(|f| f.describe()).collect();
        json!({ "name": self.name, "factors": factors })
    }

    fn contents(&self) -> Option<Contents> {
        let (mut configs, mut tensors) = (Vec::new(), Vec::new());
        for (i, factor) in self.factors.iter().enumerate() {
            let own = factor.contents()?;
            configs.push(own.config);
            let numbered = |(name, shape, values)| (format!("{i}.{name}"), shape, values);
            tensors.extend(own.tensors.into_iter().map(numbered));
        }
        Some(Contents {
            guide: self.name.clone(),
            config: json!({ "dims": self.dims, "factors": Value::Array(configs) }),
            tensors,
        })
    }
}
