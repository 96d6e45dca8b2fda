//! The arrays that come with a scene's description, and the checks that every part of it needs.

use serde::Deserialize;

use crate::error::SceneError;

/// Index of an array in the list that comes with the description.
#[derive(Clone, Copy, Debug, Deserialize)]
pub(crate) struct ArrayRef(usize);

/// An array from Python, C-contiguous.
#[derive(Clone, Debug, PartialEq)]
pub enum Array {
    /// 32-bit floats.
    F32 {
        /// Shape, outermost first.
        shape: Vec<usize>,
        /// Elements.
        data: Vec<f32>,
    },
    /// Bytes of images.
    U8 {
        /// Shape, outermost first.
        shape: Vec<usize>,
        /// Elements.
        data: Vec<u8>,
    },
    /// 32-bit indices.
    U32 {
        /// Shape, outermost first.
        shape: Vec<usize>,
        /// Elements.
        data: Vec<u32>,
    },
}

impl Array {
    /// The error of a type that is not `expected`.
    pub(crate) fn of_another_type(
        &self,
        owner: &str,
        name: &'static str,
        expected: &str,
    ) -> SceneError {
        let found = match self {
            Self::F32 { .. } => "float32",
            Self::U8 { .. } => "uint8",
            Self::U32 { .. } => "uint32",
        };
        SceneError::Array {
            owner: owner.to_owned(),
            name,
            found: format!("type {found}"),
            expected: expected.to_owned(),
        }
    }
}

/// The arrays, each taken out (not copied) by the part that owns it.
#[derive(Debug)]
pub(crate) struct Arrays(Vec<Option<Array>>);

impl Arrays {
    /// Wraps the list.
    pub(crate) fn new(arrays: Vec<Array>) -> Self {
        Self(arrays.into_iter().map(Some).collect())
    }

    /// Takes a float array of shape (rows, columns) and checks that every element is finite.
    ///
    /// # Errors
    /// [`SceneError::Reference`], [`SceneError::Array`] or [`SceneError::Value`] naming `owner`.
    pub(crate) fn take_f32(
        &mut self,
        reference: ArrayRef,
        owner: &str,
        name: &'static str,
        columns: usize,
    ) -> Result<Vec<f32>, SceneError> {
        let (shape, data) = self.take_any_f32(reference, owner, name)?;
        if shape.len() != 2
            || shape[1] != columns
            || shape[0].checked_mul(columns) != Some(data.len())
        {
            return Err(SceneError::Array {
                owner: owner.to_owned(),
                name,
                found: format!("shape {shape:?}"),
                expected: format!("(n, {columns})"),
            });
        }
        check_finite(&data, columns, owner, name)?;
        Ok(data)
    }

    /// Takes a float array of any shape.
    pub(crate) fn take_any_f32(
        &mut self,
        reference: ArrayRef,
        owner: &str,
        name: &'static str,
    ) -> Result<(Vec<usize>, Vec<f32>), SceneError> {
        match self.take(reference, owner, name)? {
            Array::F32 { shape, data } => Ok((shape, data)),
            other => Err(other.of_another_type(owner, name, "float32")),
        }
    }

    /// Takes an index array of shape (rows, columns).
    ///
    /// # Errors
    /// [`SceneError::Reference`] or [`SceneError::Array`] naming `owner`.
    pub(crate) fn take_u32(
        &mut self,
        reference: ArrayRef,
        owner: &str,
        name: &'static str,
        columns: usize,
    ) -> Result<Vec<u32>, SceneError> {
        match self.take(reference, owner, name)? {
            Array::U32 { shape, data }
                if shape.len() == 2
                    && shape[1] == columns
                    && shape[0].checked_mul(columns) == Some(data.len()) =>
            {
                Ok(data)
            }
            Array::U32 { shape, .. } => Err(SceneError::Array {
                owner: owner.to_owned(),
                name,
                found: format!("shape {shape:?}"),
                expected: format!("(n, {columns})"),
            }),
            other => Err(other.of_another_type(owner, name, "uint32")),
        }
    }

    /// Takes an array of any type and shape.
    pub(crate) fn take(
        &mut self,
        reference: ArrayRef,
        owner: &str,
        name: &'static str,
    ) -> Result<Array, SceneError> {
        check_index(reference.0, self.0.len(), owner, "array")?;
        self.0[reference.0].take().ok_or_else(|| SceneError::Array {
            owner: owner.to_owned(),
            name,
            found: format!("array {}, which another part took before", reference.0),
            expected: "one of its own".to_owned(),
        })
    }
}

/// Errors with the first element that is NaN or infinite.
pub(crate) fn check_finite(
    data: &[f32],
    columns: usize,
    owner: &str,
    name: &'static str,
) -> Result<(), SceneError> {
    match data.iter().position(|x| !x.is_finite()) {
        None => Ok(()),
        Some(i) => Err(SceneError::Value {
            owner: owner.to_owned(),
            name,
            place: format!("[{}, {}]", i / columns, i % columns),
            value: f64::from(data[i]),
            rule: "finite",
        }),
    }
}

/// Errors unless `value` satisfies `ok`.
pub(crate) fn check(
    ok: bool,
    owner: &str,
    name: &'static str,
    value: f32,
    rule: &'static str,
) -> Result<(), SceneError> {
    if ok {
        Ok(())
    } else {
        Err(SceneError::Value {
            owner: owner.to_owned(),
            name,
            place: String::new(),
            value: f64::from(value),
            rule,
        })
    }
}

/// Errors unless all of `values` are finite.
pub(crate) fn check_all_finite(
    values: &[f32],
    owner: &str,
    name: &'static str,
) -> Result<(), SceneError> {
    check_finite(values, values.len().max(1), owner, name)
}

/// Errors unless `index` lies below `count`.
pub(crate) fn check_index(
    index: usize,
    count: usize,
    owner: &str,
    what: &'static str,
) -> Result<(), SceneError> {
    if index < count {
        Ok(())
    } else {
        Err(SceneError::Reference {
            owner: owner.to_owned(),
            what,
            index,
            count,
        })
    }
}
