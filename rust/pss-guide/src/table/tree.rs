//! Fits one distribution per cell, from the coarsest to the finest, each shrunk towards its parent's.
//!
//! Rows are sorted by the key of their finest cell, so that the rows of every cell of every level are one
//! range. Cells that few paths met get no table: what they look up is their parent's, towards which their own
//! would have been shrunk.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::cells::{CellMap, Grid};

/// Cells with fewer rows have no table of their own.
const FEWEST_ROWS: usize = 4;

/// Levels that are fitted one cell after the other, before the rest is shared among threads.
const TRUNK: usize = 4;

/// Part of the fit's progress that sorting takes.
const SORTED: f32 = 0.3;

/// One decision of one path.
#[derive(Clone, Copy, Debug)]
pub(super) struct Row {
    /// Finest cell.
    pub(super) key: u64,
    /// Leaf that its numbers fall into.
    pub(super) bin: u32,
    /// Estimate of ∫f² that it stands for, in (0, 1].
    pub(super) weight: f32,
}

/// A distribution over leaves, and how it is fitted and tabulated.
pub(super) trait Leaves: Sync {
    /// Shares of ∫f² per leaf; they sum to one.
    type Shares: Send + Sync;
    /// Tables of some cells, in order.
    type Tables: Default + Send;

    /// What is assumed where nothing was seen.
    fn prior(&self) -> Self::Shares;

    /// The rows' shares, shrunk towards the parent cell's.
    fn update(&self, parent: &Self::Shares, rows: &[Row]) -> Self::Shares;

    /// Writes the table of sampling probabilities behind `tables`.
    fn tabulate(&self, shares: &Self::Shares, tables: &mut Self::Tables);

    /// Joins `more` to the end of `tables`.
    fn append(&self, tables: &mut Self::Tables, more: Self::Tables);

    /// Bytes of a table, at most.
    fn bytes(&self) -> usize;
}

/// Cells and their tables.
#[derive(Debug, Default)]
pub(super) struct Fitted<T> {
    /// Levelled keys, see [`Grid::ancestor`].
    pub(super) keys: Vec<u64>,
    pub(super) tables: T,
    /// Rows that a cell must have for a table of its own; more than [`FEWEST_ROWS`] where memory is short.
    pub(super) fewest_rows: usize,
}

/// Cells whose rows are one range, still to be fitted.
struct Task<S> {
    rows: Range<usize>,
    level: usize,
    parent: Arc<S>,
    parent_rows: usize,
}

/// What stays the same during a fit.
struct Fitter<'a, L> {
    leaves: &'a L,
    grid: &'a Grid,
    rows: &'a [Row],
    fewest_rows: usize,
    /// Level of the first tables.
    first: usize,
}

/// Fits tables to `rows`, within `memory` bytes. With `pooled`, groups are shrunk towards all groups together;
/// otherwise each stands alone and an unknown group has no table. `None` if `progress` cancelled.
pub(super) fn fit<L: Leaves>(
    leaves: &L,
    grid: &Grid,
    pooled: bool,
    rows: &mut [Row],
    memory: usize,
    progress: &mut dyn FnMut(f32) -> bool,
) -> Option<Fitted<L::Tables>> {
    // Stable: sums are then taken in the same order on any number of threads.
    rows.par_sort_by_key(|row| row.key);
    progress(SORTED).then_some(())?;

    let first = usize::from(!pooled);
    let most = memory / (leaves.bytes() + CellMap::BYTES);
    let fitter = Fitter {
        leaves,
        grid,
        rows,
        fewest_rows: fewest_rows(grid, first, rows, most),
        first,
    };
    let mut fitted = Fitted {
        fewest_rows: fitter.fewest_rows,
        ..Fitted::default()
    };
    let root = Task {
        rows: 0..rows.len(),
        level: 0,
        parent: Arc::new(leaves.prior()),
        parent_rows: usize::MAX,
    };
    let mut tasks = Vec::new();
    fitter.grow(root, TRUNK, &mut fitted, &mut tasks);
    let count = tasks.len();
    let mut done = 0;
    while !tasks.is_empty() {
        let chunk: Vec<_> = tasks.drain(..tasks.len().min(count.div_ceil(8))).collect();
        done += chunk.len();
        let grow = |task| {
            let mut part = Fitted::default();
            fitter.grow(task, usize::MAX, &mut part, &mut Vec::new());
            part
        };
        let parts: Vec<Fitted<L::Tables>> = chunk.into_par_iter().map(grow).collect();
        for part in parts {
            fitted.keys.extend(part.keys);
            leaves.append(&mut fitted.tables, part.tables);
        }
        progress(SORTED + (0.99 - SORTED) * done as f32 / count as f32).then_some(())?;
    }
    Some(fitted)
}

impl<L: Leaves> Fitter<'_, L> {
    /// Fits the task's cell and those in it; cells of level `stop` become tasks of their own.
    fn grow(
        &self,
        task: Task<L::Shares>,
        stop: usize,
        fitted: &mut Fitted<L::Tables>,
        later: &mut Vec<Task<L::Shares>>,
    ) {
        let rows = &self.rows[task.rows.clone()];
        if rows.len() < self.fewest_rows {
            return;
        }
        if task.level == stop {
            return later.push(task);
        }
        // A cell that holds all of its parent's rows would count them twice.
        let shares = if task.level < self.first || rows.len() == task.parent_rows {
            task.parent
        } else {
            let shares = self.leaves.update(&task.parent, rows);
            fitted
                .keys
                .push(self.grid.ancestor(rows[0].key, task.level));
            self.leaves.tabulate(&shares, &mut fitted.tables);
            Arc::new(shares)
        };
        let level = task.level + 1;
        if level == self.grid.levels() {
            return;
        }
        let own_rows = if task.level < self.first {
            usize::MAX
        } else {
            rows.len()
        };
        let mut start = task.rows.start;
        while start < task.rows.end {
            let cell = self.grid.ancestor(self.rows[start].key, level);
            let rest = &self.rows[start..task.rows.end];
            let end = start + rest.partition_point(|r| self.grid.ancestor(r.key, level) == cell);
            let child = Task {
                rows: start..end,
                level,
                parent: shares.clone(),
                parent_rows: own_rows,
            };
            self.grow(child, stop, fitted, later);
            start = end;
        }
    }
}

/// The least number of rows, at least [`FEWEST_ROWS`], that lets at most `most` cells have a table.
fn fewest_rows(grid: &Grid, first: usize, rows: &[Row], most: usize) -> usize {
    let mut counts: Vec<u32> = Vec::new();
    for level in first..grid.levels() {
        let same = |a: &Row, b: &Row| grid.ancestor(a.key, level) == grid.ancestor(b.key, level);
        let cells = rows.chunk_by(same).map(<[Row]>::len);
        counts.extend(
            cells
                .filter(|&n| n >= FEWEST_ROWS)
                .map(|n| u32::try_from(n).unwrap_or(u32::MAX)),
        );
    }
    if counts.len() <= most {
        return FEWEST_ROWS;
    }
    let (_, &mut count, _) = counts.select_nth_unstable_by(most, |a, b| b.cmp(a));
    count as usize + 1
}
