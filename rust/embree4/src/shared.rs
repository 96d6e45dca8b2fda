//! Arrays that Embree reads in place.

use std::ops::Deref;
use std::sync::Arc;

/// Numbers behind the last one, so that a 16-byte load of it stays inside the allocation.
const PADDING: usize = 4;

/// An array that this program and Embree hold together, without a copy. Cloning is cheap and shares it. It derefs to
/// the numbers that it was made of; nobody can change them.
#[derive(Clone, Debug)]
pub struct Shared<T>(Arc<Vec<T>>);

impl<T: Default + Clone> From<Vec<T>> for Shared<T> {
    /// Takes the array over; it is moved only if it has no room for four numbers more.
    fn from(mut data: Vec<T>) -> Self {
        data.resize(data.len() + PADDING, T::default());
        Self(Arc::new(data))
    }
}

impl<T> Deref for Shared<T> {
    type Target = [T];

    #[inline]
    fn deref(&self) -> &[T] {
        &self.0[..self.0.len() - PADDING]
    }
}
