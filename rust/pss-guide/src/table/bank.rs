//! Tables and where they apply: fitted, looked up, stored.

use std::ops::Range;

use rayon::prelude::*;

use super::cells::{CellMap, Grid, MOST_DEPTH};
use super::line::{Line, Lines};
use super::square::{self, STAGE, Square};
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
    /// First entry: the tables begin where a cache line does, so that none of their rows lies in two.
    start: usize,
}

impl Squares {
    /// Tables one behind the other.
    fn new(bins: usize, tables: &[u16]) -> Self {
        let mut entries = vec![0; tables.len() + CACHE_LINE / size_of::<u16>()];
        let start = entries.as_ptr().align_offset(CACHE_LINE);
        // The offset may be unknown, by its definition; then nothing is aligned.
        let start = start.min(entries.len() - tables.len());
        entries[start..start + tables.len()].copy_from_slice(tables);
        entries.truncate(start + tables.len());
        Self {
            bins,
            entries,
            start,
        }
    }

    fn entries(&self) -> &[u16] {
        &self.entries[self.start..]
    }

    /// Table number `i`.
    #[inline]
    fn table(&self, i: usize) -> Option<&[u16]> {
        let size = Square::entries(self.bins);
        self.entries().get(i * size..(i + 1) * size)
    }
}

/// Bytes.
const CACHE_LINE: usize = 64;

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

    /// Calls `work` for a few rows at a time with their cells; `group` says which group's serves a context, and is `None`
    /// where none of this bank does. Rows are looked up together, so that the processor waits for their memory at once.
    #[inline]
    fn each_cell(
        &self,
        contexts: &[Context],
        rows: usize,
        group: impl Fn(&Context) -> Option<u32>,
        mut work: impl FnMut(Range<usize>, &[Option<usize>]),
    ) {
        let nowhere = Context::default();
        for start in (0..rows).step_by(STAGE) {
            let here = start..rows.min(start + STAGE);
            let mut cells = [None; STAGE];
            for (cell, row) in cells.iter_mut().zip(here.clone()) {
                let context = contexts.get(row).unwrap_or(&nowhere);
                *cell = group(context).and_then(|group| self.find(group, context));
            }
            let count = here.len();
            work(here, &cells[..count]);
        }
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
        let tables = Squares::new(leaves.bins, &bank.tables);
        Some(Self::new(
            bank.grid,
            bank.oriented,
            bank.keys,
            bank.fewest_rows,
            tables,
        ))
    }

    /// Calls `work` for a few rows at a time with their tables.
    #[inline]
    fn each(
        &self,
        contexts: &[Context],
        rows: usize,
        group: impl Fn(&Context) -> Option<u32>,
        mut work: impl FnMut(Range<usize>, &[Option<&[u16]>]),
    ) {
        self.each_cell(contexts, rows, group, |here, cells| {
            let mut tables = [None; STAGE];
            for (table, cell) in tables.iter_mut().zip(cells) {
                *table = cell.and_then(|cell| self.tables.table(cell));
            }
            work(here, &tables[..cells.len()]);
        });
    }

    /// Turns uniform pairs into guided ones, with their densities; where no table serves a row it stays as it is.
    pub(super) fn sample(
        &self,
        contexts: &[Context],
        u: &mut [[f32; 2]],
        q: &mut [f32],
        group: impl Fn(&Context) -> Option<u32>,
    ) {
        let sample = match self.tables.bins {
            4 => square::sample::<4>,
            8 => square::sample::<8>,
            16 => square::sample::<16>,
            _ => square::sample::<32>,
        };
        self.each(contexts, q.len(), group, |rows, tables| {
            sample(tables, &mut u[rows.clone()], &mut q[rows]);
        });
    }

    /// Densities of pairs; where no table serves a row that of the row stays.
    pub(super) fn density(
        &self,
        contexts: &[Context],
        u: &[[f32; 2]],
        q: &mut [f32],
        group: impl Fn(&Context) -> Option<u32>,
    ) {
        let density = match self.tables.bins {
            4 => square::density::<4>,
            8 => square::density::<8>,
            16 => square::density::<16>,
            _ => square::density::<32>,
        };
        self.each(contexts, q.len(), group, |rows, tables| {
            density(tables, &u[rows.clone()], &mut q[rows]);
        });
    }

    pub(super) fn entries(&self) -> usize {
        self.tables.entries().len()
    }

    pub(super) fn bytes(&self) -> usize {
        self.places() + self.entries() * size_of::<u16>()
    }

    pub(super) fn put(&self, prefix: &str, contents: &mut Contents) {
        self.store(prefix, contents);
        let (pairs, _) = self.tables.entries().as_chunks::<2>();
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
        let tables = Squares::new(bins, &entries);
        let bank = Bank::restore_with(prefix, contents, tables)?;
        if bank.keys.len() * size != bank.tables.entries().len() {
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

    /// Turns uniform numbers into guided ones, with their densities; where no table serves a row it stays as it is.
    pub(super) fn sample(&self, contexts: &[Context], u: &mut [f32], q: &mut [f32]) {
        self.each_cell(
            contexts,
            q.len(),
            |_| Some(0),
            |rows, cells| {
                for ((u, q), cell) in u[rows.clone()].iter_mut().zip(&mut q[rows]).zip(cells) {
                    if let Some(cell) = cell {
                        *q = self.tables.sample(*cell, u);
                    }
                }
            },
        );
    }

    /// Densities of numbers; where no table serves a row that of the row stays.
    pub(super) fn density(&self, contexts: &[Context], u: &[f32], q: &mut [f32]) {
        self.each_cell(
            contexts,
            q.len(),
            |_| Some(0),
            |rows, cells| {
                for ((u, q), cell) in u[rows.clone()].iter().zip(&mut q[rows]).zip(cells) {
                    if let Some(cell) = cell {
                        *q = self.tables.density(*cell, *u);
                    }
                }
            },
        );
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
