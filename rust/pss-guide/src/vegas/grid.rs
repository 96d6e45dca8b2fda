//! The density itself: bins for each number, and for each tile how likely they are.

/// Narrowest bin: some 160 numbers of 24 bits.
pub(super) const NARROWEST: f32 = 1e-5;

/// Of a tile's probability, this share is spread evenly over the bins, so that none is impossible.
pub(super) const FLOOR: f64 = 0.01;

/// Bins shared by all tiles, and their probabilities in each.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Grid {
    pub(super) dims: usize,
    pub(super) bins: usize,
    /// Tiles along each side of the image.
    pub(super) side: usize,
    /// Borders of the bins, `(dims, bins + 1)`, from 0 to 1.
    pub(super) edges: Vec<f32>,
    /// Sums of the probabilities of the bins before each border, `(side², dims, bins + 1)`, from 0 to 1.
    pub(super) sums: Vec<f32>,
}

impl Grid {
    /// Equal bins, equally likely.
    pub(super) fn uniform(dims: usize, bins: usize, side: usize) -> Self {
        let even: Vec<f32> = (0..=bins).map(|i| i as f32 / bins as f32).collect();
        Self {
            dims,
            bins,
            side,
            edges: even.repeat(dims),
            sums: even.repeat(side * side * dims),
        }
    }

    /// The tile of a film position; positions that are nowhere belong to the first.
    #[inline]
    pub(super) fn tile(&self, pixel: &[f32; 2]) -> usize {
        // `as` saturates and turns NaN into 0.
        let [x, y] = pixel.map(|p| ((p * self.side as f32) as usize).min(self.side - 1));
        y * self.side + x
    }

    /// The borders of a number's bins.
    #[inline]
    pub(super) fn edges(&self, column: usize) -> &[f32] {
        &self.edges[column * (self.bins + 1)..][..=self.bins]
    }

    /// What of a tile's probability lies below each border.
    #[inline]
    pub(super) fn sums(&self, tile: usize, column: usize) -> &[f32] {
        &self.sums[(tile * self.dims + column) * (self.bins + 1)..][..=self.bins]
    }

    /// The bin that holds `u` ∈ [0, 1).
    #[inline]
    pub(super) fn bin(&self, column: usize, u: f32) -> usize {
        between(self.edges(column), u)
    }

    /// The density of any number in a bin.
    #[inline]
    pub(super) fn height(&self, tile: usize, column: usize, bin: usize) -> f32 {
        let (edges, sums) = (self.edges(column), self.sums(tile, column));
        (sums[bin + 1] - sums[bin]) / (edges[bin + 1] - edges[bin])
    }

    /// Turns a row of uniform numbers into one of the tile; its density.
    #[inline]
    pub(super) fn sample(&self, tile: usize, u: &mut [f32]) -> f32 {
        let mut q = 1.0;
        for (column, u) in u.iter_mut().enumerate() {
            let (edges, sums) = (self.edges(column), self.sums(tile, column));
            let bin = between(sums, *u);
            let share = (*u - sums[bin]) / (sums[bin + 1] - sums[bin]);
            let (from, to) = (edges[bin], edges[bin + 1]);
            // Rounding must not carry a number into the next bin, whose density is another.
            *u = (from + share * (to - from)).clamp(from, to.next_down());
            q *= self.height(tile, column, bin);
        }
        q
    }

    /// The density of a row; 0 outside the cube.
    #[inline]
    pub(super) fn density(&self, tile: usize, u: &[f32]) -> f32 {
        let mut q = 1.0;
        for (column, &u) in u.iter().enumerate() {
            if !(0.0..1.0).contains(&u) {
                return 0.0;
            }
            q *= self.height(tile, column, self.bin(column, u));
        }
        q
    }

    /// What is wrong with a grid that was read from a file.
    pub(super) fn check(&self) -> Result<(), String> {
        let lines = self
            .edges
            .chunks_exact(self.bins + 1)
            .chain(self.sums.chunks_exact(self.bins + 1));
        for line in lines {
            // Comparisons with NaN are false.
            let rises = line.is_sorted_by(|a, b| a < b);
            if !rises || line[0] != 0.0 || line[self.bins] != 1.0 {
                return Err("its bins do not rise from 0 to 1".to_owned());
            }
        }
        Ok(())
    }
}

/// i with `borders[i] ≤ x < borders[i + 1]`.
#[inline]
fn between(borders: &[f32], x: f32) -> usize {
    let inner = &borders[1..borders.len() - 1];
    inner.partition_point(|&border| border <= x)
}
