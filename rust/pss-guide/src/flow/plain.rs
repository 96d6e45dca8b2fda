//! The loss in candle's own operations: what a device that the fused operations of `ops` have no code for trains with, and
//! what the tests compare these with.

use candle_core::{D, Device, Result as TensorResult, Tensor};

use super::ops::LN_ZERO;
use super::options::{Prior, RealNvpOptions};
use super::weights::{Shape, kept};
use crate::kernel::layer::SLOPE;
use crate::normal::LN_SQRT_TAU;

/// Mean −ln q of rows (n, dims + known), given the tensors of [`super::weights::Weights`].
pub(super) fn loss(
    options: &RealNvpOptions,
    shape: Shape,
    tensors: &[Tensor],
    rows: &Tensor,
) -> TensorResult<Tensor> {
    let device = rows.device();
    let mut x = rows.narrow(1, 0, shape.dims)?;
    let known = rows.narrow(1, shape.dims, shape.known)?;
    let mut log_det = Tensor::zeros(x.dim(0)?, x.dtype(), device)?;
    for coupling in (0..shape.couplings).rev() {
        let mask = changed(coupling, shape.dims, device)?;
        let seen = x.broadcast_mul(&(1.0 - &mask)?)?;
        let seen = Tensor::cat(&[&seen, &known], 1)?.unsqueeze(0)?;
        let mut y = Tensor::cat(&[&seen, &seen], 0)?;
        for layer in 0..shape.linear() {
            let at = (coupling * shape.linear() + layer) * 2;
            y = y.matmul(&tensors[at])?.broadcast_add(&tensors[at + 1])?;
            if layer < shape.layers {
                y = y.maximum(&(&y * f64::from(SLOPE))?)?;
            }
        }
        let s = ((y.get(0)? / options.s_max)?.tanh()? * options.s_max)?;
        let (s, t) = (s.broadcast_mul(&mask)?, y.get(1)?.broadcast_mul(&mask)?);
        x = ((x - t)? * s.neg()?.exp()?)?;
        log_det = (log_det - s.sum(D::Minus1)?)?;
    }
    let log_q = match options.prior {
        Prior::Gaussian => {
            let prior = (x.sqr()?.sum(D::Minus1)? * -0.5)?;
            (prior - shape.dims as f64 * LN_SQRT_TAU)? + log_det
        }
        Prior::Hypercube => {
            let inside = (x.ge(0.0)? * x.le(1.0)?)?.min(D::Minus1)?;
            let nothing = (log_det.zeros_like()? + LN_ZERO)?;
            inside.where_cond(&log_det, &nothing)
        }
    }?;
    log_q.mean_all()?.neg()
}

/// 1 for columns that a coupling changes, 0 for those that it keeps: (1, dims).
fn changed(coupling: usize, dims: usize, device: &Device) -> TensorResult<Tensor> {
    let mask: Vec<f32> = (0..dims).map(|i| f32::from(!kept(coupling, i))).collect();
    Tensor::from_vec(mask, (1, dims), device)
}
