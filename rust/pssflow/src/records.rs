//! Paths that carry light, kept for guides to learn from.

use pss_guide::{Emitter, OwnedRecords, Records};
use pss_render::Paths;
use pss_render::math::luminance;

use crate::mixture::Mixture;
use crate::numbers::context;

/// Light-carrying paths of the passes so far; a path of the mixture counts with the density m that it was drawn from.
/// Layout as in [`Records`].
#[derive(Clone, Debug, Default)]
pub(crate) struct PathRecords {
    rows: OwnedRecords,
    /// Paths that these were taken from, with and without light.
    drawn: u64,
}

impl PathRecords {
    /// Paths kept.
    pub(crate) fn len(&self) -> usize {
        self.rows.f.len()
    }

    /// Counts paths that a pass drew, kept or not.
    pub(crate) fn count(&mut self, drawn: u64) {
        self.drawn += drawn;
    }

    /// Keeps path `i` of a traced block; a share `kept` of its like is.
    pub(crate) fn push(
        &mut self,
        paths: &Paths,
        i: usize,
        width: usize,
        learned: usize,
        (mixture, kept): (Mixture, f32),
        pixel: [f32; 2],
    ) {
        let f = paths.f(i);
        let (u, ray) = paths.u[i * width..][..width].split_at(learned);
        self.rows.u.extend_from_slice(u);
        self.rows.ray.extend(ray.as_chunks().0);
        self.rows.f.push(luminance(f));
        self.rows.f_bsdf.push(luminance(paths.f_bsdf[i]));
        self.rows.f_max.push(f.max_element());
        self.rows.g.push(mixture.density(paths.q_nee[i]) * kept);
        self.rows
            .g_bsdf
            .push(mixture.density(paths.q_bsdf[i]) * kept);
        let both = paths.q_nee[i] * paths.q_ray[i];
        self.rows.g_both.push(mixture.density(both) * kept);
        self.rows.pixel.push(pixel);
        if paths.record {
            let k = learned / 2;
            let vertices = paths.contexts[i * k..][..k].iter();
            self.rows.contexts.extend(vertices.map(context));
            if let Some(last) = self.rows.contexts.last_mut() {
                last.emitter = paths.emitter(i);
            }
        }
    }

    /// Makes room for so many paths in all, and says for how many there is. Growing step by step would copy them again and
    /// again, into fresh pages. Where memory does not suffice for all, half of what it holds is left to those who learn.
    pub(crate) fn reserve(&mut self, paths: usize, width: usize, contexts: bool) -> usize {
        let vertices = if contexts { width / 2 } else { 0 };
        let mut room = paths;
        while !self.try_reserve(room, width, vertices) {
            self.shrink();
            room /= 2;
        }
        if room < paths {
            self.shrink();
            room /= 2;
            // What fitted twice fits once; and if not, paths find their place as they come.
            self.try_reserve(room, width, vertices);
        }
        room
    }

    fn try_reserve(&mut self, paths: usize, width: usize, vertices: usize) -> bool {
        let more = paths.saturating_sub(self.len());
        let mut room = self.rows.u.try_reserve_exact(more * width).is_ok();
        for numbers in self.numbers() {
            room = room && numbers.try_reserve_exact(more).is_ok();
        }
        room && self
            .rows
            .contexts
            .try_reserve_exact(more * vertices)
            .is_ok()
            && self.rows.ray.try_reserve_exact(more).is_ok()
            && self.rows.pixel.try_reserve_exact(more).is_ok()
    }

    /// Gives back what no path fills.
    fn shrink(&mut self) {
        self.rows.u.shrink_to_fit();
        self.numbers().into_iter().for_each(Vec::shrink_to_fit);
        self.rows.contexts.shrink_to_fit();
        self.rows.ray.shrink_to_fit();
        self.rows.pixel.shrink_to_fit();
    }

    /// Keeps, evenly from first to last, `most[0]` of the first `older` paths and `most[1]` of those behind them; each
    /// then stands for as many more.
    pub(crate) fn thin(&mut self, older: usize, most: [usize; 2]) {
        let all = self.len();
        let parts = [0..older, older..all];
        let sizes = parts.each_ref().map(|part| part.len() as u64);
        let kept = [0, 1].map(|i| sizes[i].min(most[i] as u64));
        if kept == sizes {
            return;
        }
        let stays = |row: usize| {
            let i = usize::from(row >= older);
            let at = (row - parts[i].start) as u64;
            (at + 1) * kept[i] / sizes[i] > at * kept[i] / sizes[i]
        };
        for density in [
            &mut self.rows.g,
            &mut self.rows.g_bsdf,
            &mut self.rows.g_both,
        ] {
            for (part, (kept, size)) in parts.iter().zip(kept.iter().zip(sizes)) {
                let share = *kept as f32 / size as f32;
                density[part.clone()].iter_mut().for_each(|g| *g *= share);
            }
        }
        for numbers in self.numbers() {
            keep(numbers, all, stays);
        }
        keep(&mut self.rows.u, all, stays);
        keep(&mut self.rows.ray, all, stays);
        keep(&mut self.rows.contexts, all, stays);
        keep(&mut self.rows.pixel, all, stays);
    }

    fn numbers(&mut self) -> [&mut Vec<f32>; 6] {
        [
            &mut self.rows.f,
            &mut self.rows.f_bsdf,
            &mut self.rows.f_max,
            &mut self.rows.g,
            &mut self.rows.g_bsdf,
            &mut self.rows.g_both,
        ]
    }

    /// Makes room for so many more, and says whether there was any: a plain vector would end the process.
    fn has_room_for(&mut self, other: &Self) -> bool {
        let more = other.len();
        let mut room = self.rows.u.try_reserve(other.rows.u.len()).is_ok();
        for numbers in self.numbers() {
            room = room && numbers.try_reserve(more).is_ok();
        }
        room && self
            .rows
            .contexts
            .try_reserve(other.rows.contexts.len())
            .is_ok()
            && self.rows.ray.try_reserve(other.rows.ray.len()).is_ok()
            && self.rows.pixel.try_reserve(more).is_ok()
    }

    /// Takes over the paths of `other`, of which the first `older` of all came before this pass. Where memory does not
    /// suffice, half of the paths so far give way, and `false` comes back: fewer should be kept from here on.
    pub(crate) fn append(&mut self, other: &mut Self, older: &mut usize) -> bool {
        let mut enough = true;
        while !self.has_room_for(other) {
            enough = false;
            let kept = [*older / 2, (self.len() - *older) / 2];
            self.thin(*older, kept);
            *older = kept[0];
            if self.len() == 0 {
                // Not even these few fit; without records there is nothing to learn, and the image goes on.
                other.clear();
            }
        }
        self.take(other);
        enough
    }

    fn clear(&mut self) {
        *self = Self {
            drawn: self.drawn,
            ..Self::default()
        };
    }

    fn take(&mut self, other: &mut Self) {
        self.rows.u.append(&mut other.rows.u);
        self.rows.f.append(&mut other.rows.f);
        self.rows.f_bsdf.append(&mut other.rows.f_bsdf);
        self.rows.f_max.append(&mut other.rows.f_max);
        self.rows.g.append(&mut other.rows.g);
        self.rows.ray.append(&mut other.rows.ray);
        self.rows.g_bsdf.append(&mut other.rows.g_bsdf);
        self.rows.g_both.append(&mut other.rows.g_both);
        self.rows.contexts.append(&mut other.rows.contexts);
        self.rows.pixel.append(&mut other.rows.pixel);
        self.drawn += other.drawn;
    }

    /// What a guide learns from.
    pub(crate) fn view<'a>(&'a self, dims: usize, emitters: &'a [Emitter]) -> Records<'a> {
        let zeros = self.drawn.saturating_sub(self.len() as u64);
        self.rows.view(dims, emitters, zeros)
    }
}

/// Keeps the values of those of `rows` rows that stay.
fn keep<T: Copy>(values: &mut Vec<T>, rows: usize, stays: impl Fn(usize) -> bool) {
    let width = values.len() / rows;
    let mut end = 0;
    for row in (0..rows).filter(|&row| stays(row)) {
        values.copy_within(row * width..(row + 1) * width, end);
        end += width;
    }
    values.truncate(end);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinned_records_stand_for_all() {
        let paths = 1000u16;
        let values = || (0..paths).map(f32::from);
        let mut records = PathRecords {
            rows: OwnedRecords {
                u: values().flat_map(|x| [x, -x]).collect(),
                f: values().collect(),
                f_bsdf: values().collect(),
                f_max: values().collect(),
                g: vec![1.0; paths.into()],
                ray: values().map(|x| [x, -x]).collect(),
                g_bsdf: vec![2.0; paths.into()],
                g_both: vec![4.0; paths.into()],
                contexts: Vec::new(),
                pixel: values().map(|x| [x, x]).collect(),
            },
            drawn: 4000,
        };
        let sum = |r: &PathRecords| {
            r.rows
                .f
                .iter()
                .zip(&r.rows.g)
                .map(|(f, g)| f / g)
                .sum::<f32>()
        };
        let before = sum(&records);
        records.thin(400, [400, 600]);
        assert_eq!(records.len(), 1000);
        records.thin(400, [50, 250]);
        assert_eq!(records.len(), 300);
        assert!(records.rows.f[49] < 400.0 && records.rows.f[50] >= 400.0);
        for (i, &x) in records.rows.f.iter().enumerate() {
            assert_eq!(records.rows.g_bsdf[i], 2.0 * records.rows.g[i]);
            assert_eq!(records.rows.g_both[i], 4.0 * records.rows.g[i]);
            assert_eq!(records.rows.ray[i], [x, -x]);
            assert_eq!(records.rows.u[2 * i..2 * i + 2], [x, -x]);
            assert_eq!(records.rows.pixel[i], [x, x]);
        }
        assert!((sum(&records) / before - 1.0).abs() < 0.02);
        records.thin(50, [0, 0]);
        assert!(records.rows.u.is_empty() && records.rows.pixel.is_empty());
    }

    #[test]
    fn room_that_no_memory_holds_is_halved_until_it_does() {
        let mut records = PathRecords::default();
        assert_eq!(records.reserve(1000, 5, true), 1000);
        // No address space has room for so many; half of what there is room for stays free.
        let wanted = usize::MAX / 4096;
        let room = records.reserve(wanted, 5, true);
        assert!(room < wanted / 2, "{room}");
        assert!(records.rows.u.capacity() < wanted);
        // Paths that are there stay.
        records.rows.f = vec![1.0; 3];
        records.reserve(wanted, 5, false);
        assert_eq!(records.len(), 3);
    }
}
