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
            let tensors = split(&mut contents.tensors, &prefix);
            let words = split(&mut contents.words, &prefix);
            let spec = registry::find(name).map_err(|e| e.to_string())?;
            factors.push((spec.restore)(Contents {
                guide: name.to_owned(),
                config,
                tensors,
                words,
            })?);
        }
        let reals = contents.tensors.first().map(|(name, ..)| name);
        match reals.or(contents.words.first().map(|(name, ..)| name)) {
            Some(name) => Err(format!("tensor {name:?} belongs to no factor")),
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

    fn cell(&self, decision: Decision, context: &Context) -> Option<usize> {
        self.factor(decision)?.cell(decision, context)
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
        let memory: u64 = factors.iter().filter_map(|f| f["memory"].as_u64()).sum();
        json!({
            "name": self.name,
            "models": self.models,
            "dims": self.dims,
            "parameters": self.parameters(),
            "memory": memory,
            "factors": factors,
        })
    }

    fn contents(&self) -> Option<Contents> {
        let (mut configs, mut tensors, mut words) = (Vec::new(), Vec::new(), Vec::new());
        for (i, factor) in self.factors.iter().enumerate() {
            let own = factor.contents()?;
            configs.push(own.config);
            tensors.extend(own.tensors.into_iter().map(|t| numbered(i, t)));
            words.extend(own.words.into_iter().map(|t| numbered(i, t)));
        }
        Some(Contents {
            guide: self.name.clone(),
            config: json!({ "dims": self.dims, "factors": Value::Array(configs) }),
            tensors,
            words,
        })
    }
}

type Tensor<T> = (String, Vec<usize>, Vec<T>);

/// Factor `i`'s tensor among those of the composite.
fn numbered<T>(i: usize, (name, shape, values): Tensor<T>) -> Tensor<T> {
    (format!("{i}.{name}"), shape, values)
}

/// Takes out the tensors whose names begin with `prefix`, without it.
fn split<T>(tensors: &mut Vec<Tensor<T>>, prefix: &str) -> Vec<Tensor<T>> {
    let (own, rest) = std::mem::take(tensors)
        .into_iter()
        .partition(|t| t.0.starts_with(prefix));
    *tensors = rest;
    let own: Vec<Tensor<T>> = own;
    let strip = |(name, shape, values): Tensor<T>| (name[prefix.len()..].to_owned(), shape, values);
    own.into_iter().map(strip).collect()
}
