//! The extension module pssflow._core.
