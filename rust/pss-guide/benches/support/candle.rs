//! RealNVP in candle's own operations, from a saved guide: the reference of the fused kernel, in value and in speed.

use candle_core::{D, Device, Error, Result, Tensor};
use pss_guide::{Guide, Header};

/// Slope of LeakyReLU below zero.
const SLOPE: f64 = 0.01;

/// A coupling: whether each number is changed (1) or kept (0), and weight and bias of each layer, (s, t) leading.
struct Coupling {
    changed: Tensor,
    layers: Vec<[Tensor; 2]>,
}

/// A flow whose numbers are those of the base, before a logit.
pub(crate) struct Flow {
    couplings: Vec<Coupling>,
    s_max: f64,
}

impl Flow {
    /// Reads the weights of a guide by way of a file.
    pub(crate) fn of(guide: &dyn Guide) -> Result<Self> {
        let file = tempfile::NamedTempFile::new()?;
        let header = Header {
            columns_hash: String::new(),
            scene_hash: String::new(),
        };
        guide.save(file.path(), &header).map_err(Error::wrap)?;
        let tensors = candle_core::safetensors::load(file.path(), &Device::Cpu)?;
        let told = guide.describe();
        let option = |name: &str| told["options"][name].as_f64().unwrap_or(0.0);
        let dims = guide.dims();
        let coupling = |c: usize| {
            let changed: Vec<f32> = (0..dims).map(|i| f32::from(i % 2 != c % 2)).collect();
            let layer = |l: usize| {
                let named = |what: &str| {
                    let name = format!("coupling.{c}.linear.{l}.{what}");
                    let missing = || Error::Msg(format!("no tensor {name}"));
                    tensors.get(&name).cloned().ok_or_else(missing)
                };
                Ok([named("weight")?, named("bias")?])
            };
            let layers = (0..=option("layers") as usize).map(layer);
            Ok(Coupling {
                changed: Tensor::from_vec(changed, (1, dims), &Device::Cpu)?,
                layers: layers.collect::<Result<_>>()?,
            })
        };
        let couplings = (0..option("couplings") as usize).map(coupling);
        Ok(Self {
            couplings: couplings.collect::<Result<_>>()?,
            s_max: option("s_max"),
        })
    }

    /// z → x (`generate`) or x → z, and Σ s of each row.
    pub(crate) fn run(&self, x: &Tensor, generate: bool) -> Result<(Tensor, Tensor)> {
        let (mut x, mut log_det) = (x.clone(), Tensor::zeros(x.dim(0)?, x.dtype(), x.device())?);
        for i in 0..self.couplings.len() {
            let at = if generate {
                i
            } else {
                self.couplings.len() - 1 - i
            };
            let (s, t) = self.networks(&self.couplings[at], &x)?;
            x = if generate {
                ((&x * s.exp()?)? + t)?
            } else {
                ((&x - t)? * s.neg()?.exp()?)?
            };
            log_det = (log_det + s.sum(D::Minus1)?)?;
        }
        Ok((x, log_det))
    }

    /// s and t of each row, 0 where a number is kept.
    fn networks(&self, coupling: &Coupling, x: &Tensor) -> Result<(Tensor, Tensor)> {
        let kept = (1.0 - &coupling.changed)?;
        let seen = x.broadcast_mul(&kept)?.unsqueeze(0)?;
        let mut y = Tensor::cat(&[&seen, &seen], 0)?;
        for (l, [weight, bias]) in coupling.layers.iter().enumerate() {
            y = y.matmul(weight)?.broadcast_add(bias)?;
            if l + 1 < coupling.layers.len() {
                y = y.maximum(&(&y * SLOPE)?)?;
            }
        }
        let out = |which| y.get(which)?.broadcast_mul(&coupling.changed);
        let s = ((out(0)? / self.s_max)?.tanh()? * self.s_max)?;
        Ok((s, out(1)?))
    }
}

/// A matrix with `columns` columns.
pub(crate) fn matrix(values: &[f32], columns: usize) -> Result<Tensor> {
    Tensor::from_slice(values, (values.len() / columns, columns), &Device::Cpu)
}
