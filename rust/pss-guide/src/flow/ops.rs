//! The flow's own operations in candle's graph, each with its derivative.
//!
//! The state of a batch is one tensor X (n, d + c + 1): the d numbers of a row, the c known beside them (the film
//! position, or none), then ln |∂z/∂x| so far. A coupling is `Condition` → `Linear` per layer → `Affine`;
//! `NegLogLikelihood` ends the graph. So fused, a step is about sixty nodes; in candle's elementwise operations it would be
//! a thousand small tensors.

use candle_core::{
    CpuStorage, CustomOp1, CustomOp2, CustomOp3, Error, Layout, Result, Shape, Storage, Tensor,
};

use super::options::Prior;
use super::weights::kept;
use crate::kernel::layer::SLOPE;
use crate::kernel::product::{Strided, multiply};

/// ln q given to a row outside the hypercube prior's support, where q = 0: about ln of the smallest f32.
pub(super) const LN_ZERO: f64 = -87.0;

fn floats<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let (start, end) = layout
        .contiguous_offsets()
        .ok_or_else(|| Error::Msg("not contiguous".into()))?;
    Ok(&storage.as_slice::<f32>()?[start..end])
}

/// Runs `f` on the values of contiguous CPU tensors.
pub(super) fn with<const N: usize, R>(
    tensors: [&Tensor; N],
    f: impl FnOnce([&[f32]; N]) -> R,
) -> Result<R> {
    let tensors = tensors.map(|t| t.contiguous());
    let mut owned = Vec::with_capacity(N);
    for t in tensors {
        owned.push(t?);
    }
    let guards: Vec<_> = owned.iter().map(|t| t.storage_and_layout()).collect();
    let mut slices = [&[] as &[f32]; N];
    for (slice, (storage, layout)) in slices.iter_mut().zip(&guards) {
        let Storage::Cpu(cpu) = &**storage else {
            return Err(Error::Msg("training runs on the CPU only".into()));
        };
        *slice = floats(cpu, layout)?;
    }
    Ok(f(slices))
}

fn tensor(values: Vec<f32>, like: &Tensor) -> Result<Option<Tensor>> {
    Tensor::from_vec(values, like.shape(), like.device()).map(Some)
}

/// X → (2, n, d + c): what the networks of s and t see, masked columns 0.
pub(crate) struct Condition {
    pub(crate) coupling: usize,
    pub(crate) dims: usize,
}

impl Condition {
    fn seen(&self, column: usize) -> bool {
        column >= self.dims || kept(self.coupling, column)
    }
}

impl CustomOp1 for Condition {
    fn name(&self) -> &'static str {
        "condition"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (n, w) = layout.shape().dims2()?;
        let x = floats(storage, layout)?;
        let d = w - 1;
        let mut out = Vec::with_capacity(2 * n * d);
        for row in x.chunks_exact(w) {
            out.extend(
                row[..d]
                    .iter()
                    .enumerate()
                    .map(|(i, &x)| if self.seen(i) { x } else { 0.0 }),
            );
        }
        out.extend_from_within(..);
        Ok((CpuStorage::F32(out), (2, n, d).into()))
    }

    fn bwd(&self, x: &Tensor, _res: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (n, w) = x.dims2()?;
        let d = w - 1;
        let out = with([grad], |[g]| {
            let (s, t) = g.split_at(n * d);
            let mut out = vec![0.0; n * w];
            for ((out, s), t) in out
                .chunks_exact_mut(w)
                .zip(s.chunks_exact(d))
                .zip(t.chunks_exact(d))
            {
                for i in (0..d).filter(|&i| self.seen(i)) {
                    out[i] = s[i] + t[i];
                }
            }
            out
        })?;
        tensor(out, x)
    }
}

/// y = φ(x · w + b) with x (2, n, i), w (2, i, o), b (2, 1, o); φ is LeakyReLU, or the identity if not
/// `leaky`.
pub(crate) struct Linear {
    pub(crate) leaky: bool,
}

impl Linear {
    fn slope(&self) -> f32 {
        if self.leaky { SLOPE } else { 1.0 }
    }
}

impl CustomOp3 for Linear {
    fn name(&self) -> &'static str {
        "linear-leaky-relu"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (_, n, i) = l1.shape().dims3()?;
        let (_, _, o) = l2.shape().dims3()?;
        let (x, w, b) = (floats(s1, l1)?, floats(s2, l2)?, floats(s3, l3)?);
        let slope = self.slope();
        let mut y = vec![0.0; 2 * n * o];
        for net in 0..2 {
            let y = &mut y[net * n * o..][..n * o];
            let x = Strided::rows(&x[net * n * i..][..n * i], i);
            multiply(
                y,
                [n, i, o],
                x,
                Strided::rows(&w[net * i * o..][..i * o], o),
            );
            let b = &b[net * o..][..o];
            for y in y.chunks_exact_mut(o) {
                for (y, &b) in y.iter_mut().zip(b) {
                    *y += b;
                    *y = if *y > 0.0 { *y } else { slope * *y };
                }
            }
        }
        Ok((CpuStorage::F32(y), (2, n, o).into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        b: &Tensor,
        y: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (_, n, i) = x.dims3()?;
        let (_, _, o) = w.dims3()?;
        let slope = self.slope();
        let (gx, gw, gb) = with([x, w, y, grad], |[x, w, y, grad]| {
            let (mut gx, mut gw, mut gb) =
                (vec![0.0; 2 * n * i], vec![0.0; 2 * i * o], vec![0.0; 2 * o]);
            // φ keeps the sign, so the result says on which side the argument was.
            let inner: Vec<f32> = y
                .iter()
                .zip(grad)
                .map(|(&y, &g)| if y > 0.0 { g } else { slope * g })
                .collect();
            for net in 0..2 {
                let g = &inner[net * n * o..][..n * o];
                let x = Strided::transposed(&x[net * n * i..][..n * i], i);
                let w = Strided::transposed(&w[net * i * o..][..i * o], o);
                multiply(
                    &mut gw[net * i * o..][..i * o],
                    [i, n, o],
                    x,
                    Strided::rows(g, o),
                );
                multiply(
                    &mut gx[net * n * i..][..n * i],
                    [n, o, i],
                    Strided::rows(g, o),
                    w,
                );
                let gb = &mut gb[net * o..][..o];
                for g in g.chunks_exact(o) {
                    gb.iter_mut().zip(g).for_each(|(sum, g)| *sum += g);
                }
            }
            (gx, gw, gb)
        })?;
        Ok((tensor(gx, x)?, tensor(gw, w)?, tensor(gb, b)?))
    }
}

/// One coupling x → z on the changed columns: z = (x − t) · exp(−s), ln |∂z/∂x| −= s, with
/// s = s_max · tanh(raw / s_max) and (raw, t) = the second argument (2, n, d).
pub(crate) struct Affine {
    pub(crate) coupling: usize,
    pub(crate) s_max: f32,
}

impl CustomOp2 for Affine {
    fn name(&self) -> &'static str {
        "affine-coupling"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (n, w) = l1.shape().dims2()?;
        let (_, _, d) = l2.shape().dims3()?;
        let mut out = floats(s1, l1)?.to_vec();
        let (raw, t) = floats(s2, l2)?.split_at(n * d);
        for ((x, raw), t) in out
            .chunks_exact_mut(w)
            .zip(raw.chunks_exact(d))
            .zip(t.chunks_exact(d))
        {
            for i in (0..d).filter(|&i| !kept(self.coupling, i)) {
                let s = self.s_max * (raw[i] / self.s_max).tanh();
                x[i] = (x[i] - t[i]) * (-s).exp();
                x[w - 1] -= s;
            }
        }
        Ok((CpuStorage::F32(out), l1.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        st: &Tensor,
        z: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (n, w) = x.dims2()?;
        let (_, _, d) = st.dims3()?;
        let (gx, gst) = with([st, z, grad], |[st, z, g]| {
            let mut gx = g.to_vec();
            let mut gst = vec![0.0; 2 * n * d];
            for row in 0..n {
                let (z, g, gx) = (
                    &z[row * w..][..w],
                    &g[row * w..][..w],
                    &mut gx[row * w..][..w],
                );
                for i in (0..d).filter(|&i| !kept(self.coupling, i)) {
                    let tanh = (st[row * d + i] / self.s_max).tanh();
                    gx[i] = g[i] * (-self.s_max * tanh).exp();
                    gst[row * d + i] = -(g[i] * z[i] + g[w - 1]) * (1.0 - tanh * tanh);
                    gst[(n + row) * d + i] = -gx[i];
                }
            }
            (gx, gst)
        })?;
        Ok((tensor(gx, x)?, tensor(gst, st)?))
    }
}

/// X of all z → mean over the rows of −ln q = −ln prior(z) − ln |∂z/∂x|, a scalar.
pub(crate) struct NegLogLikelihood {
    pub(crate) prior: Prior,
    pub(crate) dims: usize,
}

impl NegLogLikelihood {
    fn inside(&self, z: &[f32]) -> bool {
        self.prior == Prior::Gaussian || z.iter().all(|z| (0.0..=1.0).contains(z))
    }
}

impl CustomOp1 for NegLogLikelihood {
    fn name(&self) -> &'static str {
        "negative-log-likelihood"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (n, w) = layout.shape().dims2()?;
        let mut sum = 0.0;
        for row in floats(storage, layout)?.chunks_exact(w) {
            let (z, log_det) = (&row[..self.dims], f64::from(row[w - 1]));
            sum -= if self.inside(z) {
                log_det + super::log_prior(self.prior, z)
            } else {
                LN_ZERO
            };
        }
        Ok((
            CpuStorage::F32(vec![(sum / n as f64) as f32]),
            Shape::from(()),
        ))
    }

    fn bwd(&self, z: &Tensor, _res: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (n, w) = z.dims2()?;
        let out = with([z, grad], |[z, g]| {
            let g = g[0] / n as f32;
            let mut out = vec![0.0; z.len()];
            for (out, z) in out.chunks_exact_mut(w).zip(z.chunks_exact(w)) {
                if self.inside(&z[..self.dims]) {
                    if self.prior == Prior::Gaussian {
                        for (out, &z) in out.iter_mut().zip(&z[..self.dims]) {
                            *out = g * z;
                        }
                    }
                    out[w - 1] = -g;
                }
            }
            out
        })?;
        tensor(out, z)
    }
}
