//! Shape and values of a flow's networks.

use pss_rng::{Purpose, Stream};

use super::options::RealNvpOptions;

/// Sizes of a flow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Shape {
    pub(crate) dims: usize,
    /// Numbers that every network looks at beside those that its coupling keeps.
    pub(crate) known: usize,
    pub(crate) couplings: usize,
    pub(crate) hidden: usize,
    /// Hidden layers; a network has one linear layer more.
    pub(crate) layers: usize,
}

impl Shape {
    pub(crate) fn new(dims: usize, options: &RealNvpOptions) -> Self {
        Self {
            dims,
            known: options.known(),
            couplings: options.couplings,
            hidden: options.hidden,
            layers: options.layers,
        }
    }

    /// Numbers of a row in training, those known at its end.
    pub(crate) fn row(&self) -> usize {
        self.dims + self.known
    }

    /// Linear layers of a network.
    pub(crate) fn linear(&self) -> usize {
        self.layers + 1
    }

    /// Inputs and outputs of linear layer `layer`.
    pub(crate) fn widths(&self, layer: usize) -> (usize, usize) {
        let inputs = if layer == 0 { self.row() } else { self.hidden };
        let outputs = if layer == self.layers {
            self.dims
        } else {
            self.hidden
        };
        (inputs, outputs)
    }

    /// Every tensor's name and shape, in the order of [`Weights::tensors`]. The leading 2 is (s, t).
    pub(crate) fn tensors(&self) -> Vec<(String, Vec<usize>)> {
        let mut list = Vec::with_capacity(self.couplings * self.linear() * 2);
        for coupling in 0..self.couplings {
            for layer in 0..self.linear() {
                let (inputs, outputs) = self.widths(layer);
                let name = format!("coupling.{coupling}.linear.{layer}");
                list.push((format!("{name}.weight"), vec![2, inputs, outputs]));
                list.push((format!("{name}.bias"), vec![2, 1, outputs]));
            }
        }
        list
    }

    /// Number of parameters. The masked inputs and outputs are counted, as the thesis does.
    pub(crate) fn parameters(&self) -> usize {
        self.tensors()
            .iter()
            .map(|(_, shape)| shape.iter().product::<usize>())
            .sum()
    }
}

/// Is column `column` handed on unchanged by coupling `coupling`, and looked at by its networks?
#[inline]
pub(crate) fn kept(coupling: usize, column: usize) -> bool {
    column % 2 == coupling % 2
}

/// All parameters of a flow.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Weights {
    pub(crate) shape: Shape,
    /// Per coupling and linear layer: weight (2, in, out) row-major, then bias (2, 1, out).
    pub(crate) tensors: Vec<Vec<f32>>,
}

impl Weights {
    /// Weights and biases uniform in ±1/√(inputs), the usual start of a linear layer.
    pub(crate) fn random(shape: Shape, seed: u64) -> Self {
        let stream = Stream::new(seed, Purpose::Weights);
        let tensors = shape
            .tensors()
            .iter()
            .enumerate()
            .map(|(index, (_, size))| {
                let (inputs, _) = shape.widths(index / 2 % shape.linear());
                let bound = 1.0 / (inputs as f32).sqrt();
                let mut numbers = stream.sequence(index as u32, 0);
                (0..size.iter().product())
                    .map(|_| bound * (2.0 * numbers.next_f32() - 1.0))
                    .collect()
            })
            .collect();
        Self { shape, tensors }
    }

    /// Weight (2, in, out) and bias (2, 1, out) of a linear layer.
    pub(crate) fn linear(&self, coupling: usize, layer: usize) -> (&[f32], &[f32]) {
        let at = (coupling * self.shape.linear() + layer) * 2;
        (&self.tensors[at], &self.tensors[at + 1])
    }

    pub(crate) fn is_finite(&self) -> bool {
        self.tensors.iter().flatten().all(|w| w.is_finite())
    }
}
