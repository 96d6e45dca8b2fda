//! Where a vertex is: keys of hierarchical cells, and the map from keys to tables.
//!
//! A key's bits are, from the top, group (a bounce or an emitter), dominant normal, and the Morton code of
//! the position on the finest grid. Every coarser cell is then a prefix, and sorted keys keep each cell's
//! rows together at every level:
//!
//! ```text
//! level   0      1        2          3 …           2 + depth
//! cell    all    group    + normal   + grid of 2³  … + grid of 2^depth per axis
//! ```

/// Finest grid: 64 cells per axis.
pub(super) const MOST_DEPTH: usize = 6;

/// Levels above the first grid.
pub(super) const ABOVE_GRID: usize = 3;

/// Positions looked at to find the box.
const BOX_SAMPLE: usize = 65_536;

/// An axis that is thinner than this share of the widest one is not divided: rounding would divide it.
const THIN: f32 = 1e-4;

/// The box that holds 99 % of the vertices along each axis, and its division into 2^depth steps per axis.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Grid {
    /// Lower corner.
    pub(crate) origin: [f32; 3],
    /// Finest steps per unit of length; 0 along an axis that is not divided.
    pub(crate) scale: [f32; 3],
    /// Levels of division.
    pub(super) depth: usize,
}

impl Grid {
    /// Of `n` positions, one in so many tells where the box is.
    pub(super) fn stride(n: usize) -> usize {
        n.div_ceil(BOX_SAMPLE).max(1)
    }

    /// Fits the box; positions that are not finite are passed over. Far outliers would else make the cells of
    /// everything else too large, hence the quantiles.
    pub(crate) fn around(positions: &[[f32; 3]], depth: usize) -> Self {
        let stride = Self::stride(positions.len());
        let (mut origin, mut extent) = ([0.0; 3], [0.0f32; 3]);
        for axis in 0..3 {
            let mut values: Vec<f32> = positions
                .iter()
                .step_by(stride)
                .map(|p| p[axis])
                .filter(|x| x.is_finite())
                .collect();
            if values.is_empty() {
                continue;
            }
            values.sort_unstable_by(f32::total_cmp);
            let at = |p: f64| values[(p * (values.len() - 1) as f64).round() as usize];
            let (low, high) = (at(0.005), at(0.995));
            let size = high - low;
            // Borders are kept off round fractions of the box, where walls like to stand.
            origin[axis] = low - 0.013 * size;
            extent[axis] = 1.02 * size;
        }
        let widest = extent.into_iter().fold(0.0, f32::max);
        let steps = (1u32 << depth) as f32;
        let scale = extent.map(|e| {
            let scale = steps / e;
            if e > THIN * widest && scale.is_finite() {
                scale
            } else {
                0.0
            }
        });
        Self {
            origin,
            scale,
            depth,
        }
    }

    /// Morton code of the finest cell. What lies outside the box, or nowhere, belongs to the nearest one.
    #[inline]
    fn code(&self, position: &[f32; 3]) -> u64 {
        // Three bits apart.
        const SPREAD: [u32; 64] = {
            let mut table = [0; 64];
            let mut i = 0;
            while i < 64 {
                let mut bit = 0;
                while bit < 6 {
                    table[i] |= ((i as u32 >> bit) & 1) << (3 * bit);
                    bit += 1;
                }
                i += 1;
            }
            table
        };
        let last = (1u32 << self.depth) - 1;
        let step = |axis: usize| {
            // `as` saturates and turns NaN into 0.
            let x = (position[axis] - self.origin[axis]) * self.scale[axis];
            SPREAD[(x as u32).min(last) as usize & 63]
        };
        u64::from(step(0) | step(1) << 1 | step(2) << 2)
    }

    /// Bits by which a key is shifted to get the cell of `level`.
    #[inline]
    fn shift(&self, level: usize) -> u32 {
        let depth = self.depth as u32;
        match level {
            0 => 63,
            1 => 3 * depth + 3,
            _ => 3 * (depth + 2 - level as u32),
        }
    }

    /// Number of levels.
    #[inline]
    pub(super) fn levels(&self) -> usize {
        ABOVE_GRID + self.depth
    }

    /// The finest cell's key.
    #[inline]
    pub(super) fn key(
        &self,
        group: u32,
        oriented: bool,
        position: &[f32; 3],
        normal: &[f32; 3],
    ) -> u64 {
        let normal = if oriented { dominant(normal) } else { 0 };
        let cell = normal << (3 * self.depth) | self.code(position);
        u64::from(group) << (3 * self.depth + 3) | cell
    }

    /// The key of the cell of `level` that holds the finest cell `key`, its level in the top byte.
    #[inline]
    pub(super) fn ancestor(&self, key: u64, level: usize) -> u64 {
        (level as u64) << 56 | key >> self.shift(level)
    }
}

/// Which of ±x, ±y, ±z a normal is closest to, 0 … 5.
#[inline]
fn dominant(normal: &[f32; 3]) -> u64 {
    let [x, y, z] = normal.map(f32::abs);
    let axis = if x >= y && x >= z {
        0
    } else if y >= z {
        1
    } else {
        2
    };
    2 * axis as u64 + u64::from(normal[axis] < 0.0)
}

/// Open addressing from keys to the numbers 0 … n − 1 of their tables.
#[derive(Clone, Debug, Default)]
pub(super) struct CellMap {
    slots: Vec<(u64, u32)>,
    shift: u32,
    len: usize,
}

/// No key: levels end far below 255.
const EMPTY: u64 = u64::MAX;

impl CellMap {
    /// Bytes per key, at most: its own, and up to three slots.
    pub(super) const BYTES: usize = size_of::<u64>() + 3 * size_of::<(u64, u32)>();

    /// Table i belongs to `keys[i]`.
    pub(super) fn new(keys: &[u64]) -> Self {
        if keys.is_empty() {
            return Self::default();
        }
        // At most two thirds full, and never quite.
        let capacity = (keys.len() + keys.len().div_ceil(2)).next_power_of_two();
        let mut map = Self {
            slots: vec![(EMPTY, 0); capacity],
            shift: 64 - capacity.trailing_zeros(),
            len: keys.len(),
        };
        for (i, &key) in keys.iter().enumerate() {
            let mut at = map.start(key);
            while map.slots[at].0 != EMPTY {
                at = (at + 1) & (capacity - 1);
            }
            map.slots[at] = (key, i as u32);
        }
        map
    }

    /// Fibonacci hashing (Knuth, vol. 3, §6.4).
    #[inline]
    fn start(&self, key: u64) -> usize {
        (key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> self.shift) as usize
    }

    #[inline]
    fn get(&self, key: u64) -> Option<u32> {
        let mut at = self.start(key);
        loop {
            match self.slots[at] {
                (found, i) if found == key => return Some(i),
                (EMPTY, _) => return None,
                _ => at = (at + 1) & (self.slots.len() - 1),
            }
        }
    }

    /// The table of the finest cell around `key` that has one.
    #[inline]
    pub(super) fn find(&self, grid: &Grid, key: u64) -> Option<usize> {
        if self.len == 0 {
            return None;
        }
        let mut levels = (0..grid.levels()).rev();
        levels.find_map(|level| Some(self.get(grid.ancestor(key, level))? as usize))
    }

    pub(super) fn bytes(&self) -> usize {
        self.slots.len() * size_of::<(u64, u32)>()
    }
}
