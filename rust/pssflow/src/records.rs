//! Paths that carry light, kept for guides to learn from.

use pss_guide::{Context, Emitter, Records};
use pss_render::Paths;
use pss_render::math::luminance;

use crate::mixture::Mixture;
use crate::numbers::context;

/// Light-carrying paths of the passes so far; a path of the mixture counts with the density m that it was drawn from.
/// Layout as in [`Records`].
#[derive(Clone, Debug, Default)]
pub(crate) struct PathRecords {
    u: Vec<f32>,
    f: Vec<f32>,
    f_bsdf: Vec<f32>,
    f_max: Vec<f32>,
    g: Vec<f32>,
    g_bsdf: Vec<f32>,
    contexts: Vec<Context>,
    pixel: Vec<[f32; 2]>,
    /// Paths that these were taken from, with and without light.
    drawn: u64,
}

impl PathRecords {
    /// Paths kept.
    pub(crate) fn len(&self) -> usize {
        self.f.len()
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
        self.u.extend_from_slice(&paths.u[i * width..][..learned]);
        self.f.push(luminance(f));
        self.f_bsdf.push(luminance(paths.f_bsdf[i]));
        self.f_max.push(f.max_element());
        self.g.push(mixture.density(paths.q_nee[i]) * kept);
        self.g_bsdf.push(mixture.density(paths.q_bsdf[i]) * kept);
        self.pixel.push(pixel);
        if paths.record {
            let k = learned / 2;
            let vertices = paths.contexts[i * k..][..k].iter();
            self.contexts.extend(vertices.map(context));
            if let Some(last) = self.contexts.last_mut() {
                last.emitter = paths.emitter(i);
            }
        }
    }

    pub(crate) fn append(&mut self, other: &mut Self) {
        self.u.append(&mut other.u);
        self.f.append(&mut other.f);
        self.f_bsdf.append(&mut other.f_bsdf);
        self.f_max.append(&mut other.f_max);
        self.g.append(&mut other.g);
        self.g_bsdf.append(&mut other.g_bsdf);
        self.contexts.append(&mut other.contexts);
        self.pixel.append(&mut other.pixel);
        self.drawn += other.drawn;
    }

    /// What a guide learns from.
    pub(crate) fn view<'a>(&'a self, dims: usize, emitters: &'a [Emitter]) -> Records<'a> {
        Records {
            dims,
            u: &self.u,
            f: &self.f,
            f_bsdf: &self.f_bsdf,
            f_max: &self.f_max,
            g: &self.g,
            g_bsdf: &self.g_bsdf,
            contexts: &self.contexts,
            pixel: &self.pixel,
            emitters,
            zeros: self.drawn.saturating_sub(self.f.len() as u64),
        }
    }
}
