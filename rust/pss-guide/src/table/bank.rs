//! Tables and where they apply: fitted, looked up, stored.

use rayon::prelude::*;

use super::cells::{CellMap, Grid, MOST_DEPTH};
use super::line::{Line, Lines};
use super::square::{self, Square};
use super::tree::{self, Row};
use crate::Context;
use crate::file::Contents;

/// A decision to learn from: where it was taken, what it fell on, what it is worth.
#[derive(Clone, Copy, Debug)]
pub(super) struct Example {
    pub(super) group: u32,
    pub(super) position: [f32; 3],
    pub(super) normal: [f32; 3],
    pub(super) leaf: u32,
    /// In (0, 1].
    pub(super) weight: f32,
}

/// How a bank is to be fitted.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plan {
    pub(super) depth: usize,
    /// Whether the dominant normal tells cells apart.
    pub(super) oriented: bool,
    /// Whether groups are shrunk towards what all have in common.
    pub(super) pooled: bool,
    /// Bytes.
    pub(super) memory: usize,
}

/// Cells with a table each.
#[derive(Debug)]
pub(super) struct Bank<T> {
    grid: Grid,
    oriented: bool,
    keys: Vec<u64>,
    map: CellMap,
    /// Rows that a cell needed for a table of its own.
    fewest_rows: usize,
    pub(super) tables: T,
}

/// Tables over pairs.
#[derive(Debug)]
pub(super) struct Squares {
    pub(super) bins: usize,
    entries: Vec<u16>,
}

impl Squares {
    /// Gives back what the entries have room for beyond their number.
    fn new(bins: usize, mut entries: Vec<u16>) -> Self {
        entries.shrink_to_fit();
        Self { bins, entries }
    }
}

impl<T> Bank<T> {
    fn new(grid: Grid, oriented: bool, mut keys: Vec<u64>, fewest_rows: usize, tables: T) -> Self {
        keys.shrink_to_fit();
        Self {
            map: CellMap::new(&keys),
            grid,
            oriented,
            keys,
            fewest_rows,
            tables,
        }
    }

    /// The table that serves a vertex.
    #[inline]
    pub(super) fn find(&self, group: u32, context: &Context) -> Option<usize> {
        let key = self
            .grid
            .key(group, self.oriented, &context.position, &context.normal);
        self.map.find(&self.grid, key)
    }

    /// Cells, what the finest grid has per axis, and rows that a cell needed.
    pub(super) fn facts(&self) -> (usize, usize, usize) {
        (self.keys.len(), 1 << self.grid.depth, self.fewest_rows)
    }

    /// Bytes of the keys and of the map from them.
    fn places(&self) -> usize {
        self.map.bytes() + self.keys.len() * size_of::<u64>()
    }

    fn fit_with<L: tree::Leaves<Tables = T>>(
        leaves: &L,
        plan: Plan,
        examples: &[Example],
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Option<Self>
    where
        T: Default,
    {
        let some = examples.iter().step_by(Grid::stride(examples.len()));
        let positions: Vec<[f32; 3]> = some.map(|e| e.position).collect();
        let grid = Grid::around(&positions, plan.depth);
        let row = |e: &Example| Row {
            key: grid.key(e.group, plan.oriented, &e.position, &e.normal),
            bin: e.leaf,
            weight: e.weight,
        };
        let mut rows: Vec<Row> = examples.par_iter().map(row).collect();
        let fitted = tree::fit(leaves, &grid, plan.pooled, &mut rows, plan.memory, progress)?;
        Some(Self::new(
            grid,
            plan.oriented,
            fitted.keys,
            fitted.fewest_rows,
            fitted.tables,
        ))
    }

    fn store(&self, prefix: &str, contents: &mut Contents) {
        let grid = self.grid.origin.iter().chain(&self.grid.scale).copied();
        contents
            .tensors
            .push((format!("{prefix}grid"), vec![6], grid.collect()));
        let halves = |key: &u64| [*key as u32, (key >> 32) as u32];
        let shape = vec![self.keys.len(), 2];
        let keys = self.keys.iter().flat_map(halves).collect();
        contents.words.push((format!("{prefix}keys"), shape, keys));
        let layout = [
            self.grid.depth as u32,
            u32::from(self.oriented),
            u32::try_from(self.fewest_rows).unwrap_or(u32::MAX),
        ];
        contents
            .words
            .push((format!("{prefix}layout"), vec![3], layout.to_vec()));
    }

    fn restore_with(prefix: &str, contents: &mut Contents, tables: T) -> Result<Self, String> {
        let grid = take(&mut contents.tensors, prefix, "grid")?;
        let layout = take(&mut contents.words, prefix, "layout")?;
        let halves = take(&mut contents.words, prefix, "keys")?;
        let ([depth, oriented, fewest], [ox, oy, oz, sx, sy, sz]) = (&layout[..], &grid[..]) else {
            return Err(format!(
                "tensors {prefix}grid and {prefix}layout have wrong sizes"
            ));
        };
        if grid.iter().any(|x| !x.is_finite()) || *depth as usize > MOST_DEPTH {
            return Err(format!("tensor {prefix}grid is no grid"));
        }
        let grid = Grid {
            origin: [*ox, *oy, *oz],
            scale: [*sx, *sy, *sz],
            depth: *depth as usize,
        };
        let keys: Vec<u64> = halves
            .chunks_exact(2)
            .map(|k| u64::from(k[0]) | u64::from(k[1]) << 32)
            .collect();
        if keys.iter().any(|k| (k >> 56) as usize >= grid.levels()) {
            return Err(format!("tensor {prefix}keys holds a key of no level"));
        }
        Ok(Self::new(
            grid,
            *oriented != 0,
            keys,
            *fewest as usize,
            tables,
        ))
    }
}

impl Bank<Squares> {
    pub(super) fn fit(
        leaves: Square,
        plan: Plan,
        examples: &[Example],
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Option<Self> {
        let bank = Bank::fit_with(&leaves, plan, examples, progress)?;
        let tables = Squares::new(leaves.bins, bank.tables);
        Some(Self::new(
            bank.grid,
            bank.oriented,
            bank.keys,
            bank.fewest_rows,
            tables,
        ))
    }

    #[inline]
    fn table(&self, group: u32, context: &Context) -> Option<&[u16]> {
        let size = Square::entries(self.tables.bins);
        let at = self.find(group, context)? * size;
        self.tables.entries.get(at..at + size)
    }

    /// Turns a uniform pair into a guided one; its density.
    #[inline]
    pub(super) fn sample(&self, group: u32, context: &Context, u: &mut [f32; 2]) -> f32 {
        let Some(table) = self.table(group, context) else {
            return 1.0;
        };
        match self.tables.bins {
            4 => square::sample::<4>(table, u),
            8 => square::sample::<8>(table, u),
            16 => square::sample::<16>(table, u),
            _ => square::sample::<32>(table, u),
        }
    }

    /// Density of a pair.
    #[inline]
    pub(super) fn density(&self, group: u32, context: &Context, u: &[f32; 2]) -> f32 {
        let Some(table) = self.table(group, context) else {
            return 1.0;
        };
        match self.tables.bins {
            4 => square::density::<4>(table, u),
            8 => square::density::<8>(table, u),
            16 => square::density::<16>(table, u),
            _ => square::density::<32>(table, u),
        }
    }

    pub(super) fn entries(&self) -> usize {
        self.tables.entries.len()
    }

    pub(super) fn bytes(&self) -> usize {
        self.places() + self.entries() * size_of::<u16>()
    }

    pub(super) fn put(&self, prefix: &str, contents: &mut Contents) {
        self.store(prefix, contents);
        let (pairs, _) = self.tables.entries.as_chunks::<2>();
        let packed = pairs
            .iter()
            .map(|p| u32::from(p[0]) | u32::from(p[1]) << 16);
        let shape = vec![self.keys.len(), Square::entries(self.tables.bins) / 2];
        contents
            .words
            .push((format!("{prefix}tables"), shape, packed.collect()));
    }

    pub(super) fn restore(
        prefix: &str,
        bins: usize,
        contents: &mut Contents,
    ) -> Result<Self, String> {
        if !Square::BINS.contains(&bins) {
            return Err(format!("its configuration asks for {bins} bins"));
        }
        let packed = take(&mut contents.words, prefix, "tables")?;
        let entries: Vec<u16> = packed
            .iter()
            .flat_map(|&w| [w as u16, (w >> 16) as u16])
            .collect();
        let size = Square::entries(bins);
        if !entries
            .chunks(size)
            .all(|t| t.chunks(bins).all(square::is_sound))
        {
            return Err(format!(
                "tensor {prefix}tables holds an interval that is empty"
            ));
        }
        let tables = Squares::new(bins, entries);
        let bank = Bank::restore_with(prefix, contents, tables)?;
        if bank.keys.len() * size != bank.tables.entries.len() {
            return Err(format!(
                "tensors {prefix}keys and {prefix}tables disagree in length"
            ));
        }
        Ok(bank)
    }
}

impl Bank<Lines> {
    pub(super) fn fit(
        leaves: &Line,
        plan: Plan,
        examples: &[Example],
        progress: &mut dyn FnMut(f32) -> bool,
    ) -> Option<Self> {
        let mut bank = Bank::fit_with(leaves, plan, examples, progress)?;
        bank.tables.shrink_to_fit();
        Some(bank)
    }

    pub(super) fn entries(&self) -> usize {
        self.tables.guided.len()
    }

    pub(super) fn bytes(&self) -> usize {
        let entry = size_of::<u16>() + size_of::<f32>();
        self.places() + self.entries() * entry + self.tables.starts.len() * size_of::<u32>()
    }

    pub(super) fn put(&self, prefix: &str, contents: &mut Contents) {
        self.store(prefix, contents);
        let lines = &self.tables;
        contents.tensors.push((
            format!("{prefix}ends"),
            vec![lines.ends.len()],
            lines.ends.clone(),
        ));
        let guided = lines.guided.iter().map(|&g| u32::from(g)).collect();
        for (name, values) in [("guided", guided), ("starts", lines.starts.clone())] {
            contents
                .words
                .push((format!("{prefix}{name}"), vec![values.len()], values));
        }
    }

    pub(super) fn restore(prefix: &str, contents: &mut Contents) -> Result<Self, String> {
        let ends = take(&mut contents.tensors, prefix, "ends")?;
        let guided = take(&mut contents.words, prefix, "guided")?;
        let starts = take(&mut contents.words, prefix, "starts")?;
        let mut lines = Lines {
            starts,
            ends,
            guided: guided.iter().map(|&g| g as u16).collect(),
        };
        lines.shrink_to_fit();
        if !lines.is_sound() {
            return Err(format!(
                "tensors {prefix}ends and {prefix}guided are no intervals"
            ));
        }
        let bank = Bank::restore_with(prefix, contents, lines)?;
        if bank.keys.len() != bank.tables.starts.len().saturating_sub(1) {
            return Err(format!(
                "tensors {prefix}keys and {prefix}starts disagree in length"
            ));
        }
        Ok(bank)
    }
}

/// Takes a tensor out of a file's list.
fn take<T>(
    tensors: &mut Vec<(String, Vec<usize>, Vec<T>)>,
    prefix: &str,
    name: &str,
) -> Result<Vec<T>, String> {
    let name = format!("{prefix}{name}");
    let at = tensors
        .iter()
        .position(|t| t.0 == name)
        .ok_or_else(|| format!("tensor {name:?} is missing"))?;
    Ok(tensors.swap_remove(at).2)
}
