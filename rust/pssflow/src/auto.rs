//! Recipes of the registry as learners, and `auto`, which picks one of them.

use std::sync::Arc;

use pss_guide::{Fit, GuideError, Recipe, Records, Remaining};

use crate::choice::{Chooser, Chosen, Learner, Left};

/// A recipe, and the name that records give it.
#[derive(Debug)]
pub struct Named {
    recipe: Recipe,
    label: String,
}

impl Named {
    /// A recipe by its name, as the user gave it.
    pub fn new(recipe: Recipe) -> Self {
        Self {
            label: recipe.name().to_owned(),
            recipe,
        }
    }

    /// A recipe by its label, which tells its options.
    fn labelled(recipe: Recipe) -> Self {
        Self {
            label: recipe.label(),
            recipe,
        }
    }
}

impl Learner for Named {
    fn name(&self) -> &str {
        &self.label
    }

    fn seconds_per_path(&self, dims: usize) -> f64 {
        self.recipe.seconds_per_path(dims)
    }

    fn looks_at_contexts(&self) -> bool {
        self.recipe.looks_at_contexts()
    }

    fn refines(&self) -> bool {
        self.recipe.refines()
    }

    fn uniform_fraction(&self) -> f32 {
        self.recipe.uniform_fraction()
    }

    fn fit(
        &self,
        records: &Records<'_>,
        seed: u64,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Fit, GuideError> {
        self.recipe.fit(records, seed, progress)
    }
}

/// Picks the smallest model that pays; see [`pss_guide::select`].
#[derive(Debug)]
pub struct Auto {
    candidates: Vec<Recipe>,
}

impl Auto {
    /// With the registry's candidates.
    ///
    /// # Errors
    /// [`GuideError`] where the registry lacks one.
    pub fn new() -> Result<Self, GuideError> {
        Ok(Self {
            candidates: pss_guide::candidates()?,
        })
    }
}

impl Chooser for Auto {
    fn choose(
        &self,
        records: &Records<'_>,
        left: &Left,
        seed: u64,
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Result<Chosen, GuideError> {
        let remaining = Remaining {
            paths: left.paths,
            seconds_per_path: left.seconds_per_path,
            threads: left.threads,
            found: left.found,
        };
        let selection = pss_guide::select(records, &self.candidates, &remaining, seed, progress)?;
        let learner = selection.recipe.map(Named::labelled);
        Ok(Chosen {
            learner: learner.map(|l| Arc::new(l) as Arc<dyn Learner>),
            uniform_fraction: selection.uniform_fraction,
            fit: selection.fit,
            candidates: serde_json::json!(selection.candidates),
        })
    }

    fn recall(&self, name: &str) -> Option<Arc<dyn Learner>> {
        let recipe = pss_guide::recall(name)?;
        Some(Arc::new(Named::labelled(recipe)))
    }
}
