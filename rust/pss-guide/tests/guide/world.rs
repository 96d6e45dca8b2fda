//! A made-up scene: paths whose best density depends on where they are, how that is oriented, and which emitter
//! they end on.

use pss_guide::{Context, Decision, Emitter, Guide, Records};
use pss_rng::{Purpose, Stream};

/// Emitters: unequal, one that is never chosen, and an environment at the end.
pub(crate) const EMITTERS: [Emitter; 5] = [
    emitter(0.2, false),
    emitter(0.5, false),
    emitter(0.5, false),
    emitter(0.8, false),
    emitter(1.0, true),
];

const fn emitter(cdf: f32, environment: bool) -> Emitter {
    Emitter { cdf, environment }
}

/// Lower corner and size of where vertices are.
#[derive(Clone, Copy, Debug)]
pub(crate) struct World {
    /// Bounces.
    pub(crate) k: usize,
    pub(crate) corner: [f32; 3],
    pub(crate) size: [f32; 3],
    /// Whether f depends on anything.
    pub(crate) flat: bool,
}

/// Paths and all that records hold of them.
#[derive(Clone, Debug, Default)]
pub(crate) struct Paths {
    pub(crate) dims: usize,
    pub(crate) u: Vec<f32>,
    pub(crate) f: Vec<f32>,
    pub(crate) f_bsdf: Vec<f32>,
    pub(crate) ray: Vec<[f32; 2]>,
    pub(crate) g: Vec<f32>,
    pub(crate) g_bsdf: Vec<f32>,
    pub(crate) g_both: Vec<f32>,
    pub(crate) contexts: Vec<Context>,
    pub(crate) pixel: Vec<[f32; 2]>,
    pub(crate) zeros: u64,
}

impl Paths {
    pub(crate) fn records(&self) -> Records<'_> {
        Records {
            dims: self.dims,
            u: &self.u,
            f: &self.f,
            f_bsdf: &self.f_bsdf,
            f_max: &self.f,
            g: &self.g,
            ray: &self.ray,
            g_bsdf: &self.g_bsdf,
            g_both: &self.g_both,
            contexts: &self.contexts,
            pixel: &self.pixel,
            emitters: &EMITTERS,
            zeros: self.zeros,
        }
    }
}

impl World {
    pub(crate) const DEFAULT: Self = Self {
        k: 2,
        corner: [-1.0, 0.0, 5.0],
        size: [4.0, 2.0, 1.0],
        flat: false,
    };

    /// A vertex from four numbers: on one of six sheets, one a normal.
    pub(crate) fn context(&self, bounce: usize, numbers: [f32; 4]) -> Context {
        let side = ((numbers[0] * 6.0) as usize).min(5);
        let sign = if side.is_multiple_of(2) { 1.0 } else { -1.0 };
        let mut normal = [0.1, -0.1, 0.05];
        normal[side / 2] = sign * 0.98;
        let at = [numbers[1], numbers[2], side as f32 / 5.0];
        Context {
            position: std::array::from_fn(|i| self.corner[i] + self.size[i] * at[i]),
            normal,
            outgoing: [0.0, 0.6, 0.8],
            pixel: [numbers[1], numbers[3]],
            emitter: 0,
            bounce: bounce as u32,
        }
    }

    /// Both terms of f.
    fn terms(&self, u: &[f32], ray: [f32; 2], contexts: &[Context]) -> (f32, f32) {
        if self.flat {
            return (1.0, 0.2);
        }
        let bump = |x: f32, c: f32| (-((x - c) / 0.12).powi(2) / 2.0).exp() + 0.02;
        let place = |c: &Context| -> [f32; 2] {
            std::array::from_fn(|i| (c.position[i] - self.corner[i]) / self.size[i])
        };
        let side = |c: &Context| {
            let axis = (0..3)
                .max_by(|&a, &b| c.normal[a].abs().total_cmp(&c.normal[b].abs()))
                .unwrap_or(0);
            2.0 * axis as f32 + f32::from(u8::from(c.normal[axis] < 0.0))
        };
        let (last, before) = contexts.split_last().unwrap();
        let mut directions = 1.0;
        for (b, c) in before.iter().enumerate() {
            directions *= bump(u[2 * b], 0.2 + 0.6 * place(c)[0]);
            directions *= bump(u[2 * b + 1], (side(c) + 0.5) / 6.0);
        }
        let e = last.emitter as f32;
        let near = (-((place(last)[1] * 4.0 - e) / 0.7).powi(2) / 2.0).exp() + 0.02;
        let tilt = if last.emitter == 4 {
            side(last) / 10.0
        } else {
            0.0
        };
        let light = &u[2 * self.k - 1..];
        let on_light = bump(light[0], 0.2 + 0.15 * e) * bump(light[1], 0.2 + tilt);
        let meets =
            bump(ray[0], 0.8 - 0.6 * place(last)[1]) * bump(ray[1], (side(last) + 0.5) / 6.0);
        (
            40.0 * directions * near * on_light,
            20.0 * directions * meets,
        )
    }

    /// `n` paths from m = a + (1 − a) q, or uniform ones.
    pub(crate) fn draw(&self, n: usize, guide: Option<(&dyn Guide, f32)>, stream: u32) -> Paths {
        let (k, dims) = (self.k, 2 * self.k + 1);
        let mut numbers = Stream::new(77, Purpose::Test).sequence(stream, k as u32);
        let mut u = vec![0.0f32; n * dims];
        let mut contexts = Vec::with_capacity(n * k);
        let (mut uniform, mut rays) = (Vec::with_capacity(n), Vec::with_capacity(2 * n));
        for row in u.chunks_exact_mut(dims) {
            for b in 1..=k {
                let four = std::array::from_fn(|_| numbers.next_f32());
                contexts.push(self.context(b, four));
            }
            row.fill_with(|| numbers.next_f32());
            uniform.push(numbers.next_f32());
            rays.extend([(); 2].map(|()| numbers.next_f32()));
        }
        let mut q = [(); 3].map(|()| vec![1.0f32; n]);
        let mut paths = Paths {
            dims,
            pixel: contexts.chunks_exact(k).map(|c| c[0].pixel).collect(),
            ..Paths::default()
        };
        for vertex in 0..k {
            let last = vertex + 1 == k;
            let at = 2 * vertex;
            let steps = if last {
                vec![
                    (Decision::Emitter, at, 1),
                    (Decision::Light, at + 1, 2),
                    (Decision::Ray, 0, 2),
                ]
            } else {
                vec![(Decision::Direction, at, 2)]
            };
            for (decision, at, width) in steps {
                if decision == Decision::Light {
                    for (u, c) in u.chunks_exact(dims).zip(contexts.chunks_exact_mut(k)) {
                        c[k - 1].emitter = EMITTERS.partition_point(|e| e.cdf <= u[at - 1]) as u32;
                    }
                }
                let Some((guide, a)) = guide else { continue };
                let here: Vec<Context> = contexts.chunks_exact(k).map(|c| c[vertex]).collect();
                let (of, stride) = match decision {
                    Decision::Ray => (&mut rays, 2),
                    _ => (&mut u, dims),
                };
                let own = of.chunks_exact(stride).flat_map(|u| &u[at..at + width]);
                let mut own: Vec<f32> = own.copied().collect();
                let (before, mut each) = (own.clone(), vec![1.0; n]);
                guide.sample(decision, &here, &mut own, &mut each);
                for (row, uniform) in uniform.iter().enumerate() {
                    if *uniform < a {
                        let at = row * width..(row + 1) * width;
                        own[at.clone()].copy_from_slice(&before[at]);
                    }
                }
                guide.density(decision, &here, &own, &mut each);
                for row in 0..n {
                    of[row * stride + at..][..width].copy_from_slice(&own[row * width..][..width]);
                    // f_nee's numbers, f_bsdf's, and all.
                    let uses = match decision {
                        Decision::Ray => [false, true, true],
                        Decision::Direction => [true; 3],
                        _ => [true, false, true],
                    };
                    for (q, _) in q.iter_mut().zip(uses).filter(|q| q.1) {
                        q[row] *= each[row];
                    }
                }
            }
        }
        let a = guide.map_or(1.0, |g| g.1);
        let mixed = |q: Vec<f32>| -> Vec<f32> { q.iter().map(|q| a + (1.0 - a) * q).collect() };
        [paths.g, paths.g_bsdf, paths.g_both] = q.map(mixed);
        paths.ray = rays.as_chunks().0.to_vec();
        let rows = u.chunks_exact(dims).zip(contexts.chunks_exact(k));
        for ((u, c), ray) in rows.zip(&paths.ray) {
            let (nee, bsdf) = self.terms(u, *ray, c);
            paths.f.push(nee + bsdf);
            paths.f_bsdf.push(bsdf);
        }
        (paths.u, paths.contexts) = (u, contexts);
        paths
    }

    /// Estimates f_nee/m + f_bsdf/m′ of `n` paths.
    pub(crate) fn estimates(
        &self,
        n: usize,
        guide: Option<(&dyn Guide, f32)>,
        stream: u32,
    ) -> Vec<f64> {
        let paths = self.draw(n, guide, stream);
        let estimate = |i: usize| {
            f64::from(paths.f[i] - paths.f_bsdf[i]) / f64::from(paths.g[i])
                + f64::from(paths.f_bsdf[i]) / f64::from(paths.g_bsdf[i])
        };
        (0..n).map(estimate).collect()
    }
}

/// Vertices of several cells, normals, bounces and emitters; some far outside of where paths were, some nowhere.
pub(crate) fn places(world: &World, decision: Decision) -> Vec<Context> {
    let mut list = Vec::new();
    for i in 0..5u32 {
        let x = i as f32 / 5.0;
        let mut c = world.context(1, [x, 0.9 - 0.7 * x, 0.1 + 0.8 * x, 0.5]);
        if decision != Decision::Direction {
            c.bounce = world.k as u32;
            c.emitter = i;
        }
        list.push(c);
    }
    let mut far = list[1];
    far.position = [1e9, -1e9, 0.0];
    let mut nowhere = Context {
        position: [f32::NAN; 3],
        normal: [f32::NAN; 3],
        ..list[3]
    };
    nowhere.emitter = if decision == Decision::Light { 999 } else { 0 };
    list.extend([far, nowhere, Context::default()]);
    list
}
