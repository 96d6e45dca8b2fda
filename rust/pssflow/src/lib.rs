//! The estimator: pilot, fit, render; joins the tracer and the guides.
