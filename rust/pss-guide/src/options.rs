//! Options of a guide: JSON in, a checked struct out, and errors that name what is known.

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use serde_json::{Map, Value};

use crate::GuideError;

/// Memory of a guide that bounds it, where nothing else is asked for.
pub(crate) const MEMORY_MIB: usize = 256;

/// What a whole-path guide looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Condition {
    /// Nothing: one density for the whole image.
    None,
    /// The film position.
    Pixel,
}

/// `defaults` with every entry of `given` written over it.
pub(crate) fn parse<T>(
    guide: &str,
    defaults: &T,
    given: &Map<String, Value>,
) -> Result<T, GuideError>
where
    T: Serialize + DeserializeOwned,
{
    let mut merged = to_map(defaults);
    for (option, value) in given {
        if !merged.contains_key(option) {
            return Err(GuideError::UnknownOption {
                guide: guide.to_owned(),
                option: option.clone(),
                known: merged.keys().cloned().collect::<Vec<_>>().join(", "),
            });
        }
        let previous = merged.insert(option.clone(), value.clone());
        // Each one is tried alone, so that the error can name the offender.
        if let Err(error) = serde_json::from_value::<T>(Value::Object(merged.clone())) {
            if let Some(previous) = previous {
                merged.insert(option.clone(), previous);
            }
            return Err(bad(guide, option, value, &error.to_string()));
        }
    }
    serde_json::from_value(Value::Object(merged))
        .map_err(|e| bad(guide, "", &Value::Null, &e.to_string()))
}

/// The options as a JSON object, in the order of the fields.
pub(crate) fn to_map<T: Serialize>(options: &T) -> Map<String, Value> {
    match serde_json::to_value(options) {
        Ok(Value::Object(map)) => map,
        _ => Map::new(),
    }
}

/// What a guide's options must keep to; the error names the option, its value and the rule.
pub(crate) struct Rules<'a> {
    guide: &'a str,
    values: Map<String, Value>,
}

impl<'a> Rules<'a> {
    pub(crate) fn new<T: Serialize>(guide: &'a str, options: &T) -> Self {
        Self {
            guide,
            values: to_map(options),
        }
    }

    /// An error unless `option` is accepted.
    pub(crate) fn check(&self, option: &str, accepted: bool, rule: &str) -> Result<(), GuideError> {
        if accepted {
            return Ok(());
        }
        let value = self.values.get(option).unwrap_or(&Value::Null);
        Err(bad(self.guide, option, value, rule))
    }
}

/// Whether `x` lies in (0, `most`].
pub(crate) fn positive(x: f64, most: f64) -> bool {
    x > 0.0 && x <= most
}

/// The error for `option`.
pub(crate) fn bad(guide: &str, option: &str, value: &Value, rule: &str) -> GuideError {
    GuideError::Option {
        guide: guide.to_owned(),
        option: option.to_owned(),
        value: value.to_string(),
        rule: rule.to_owned(),
    }
}
