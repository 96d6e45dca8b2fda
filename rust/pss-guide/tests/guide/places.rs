//! Guides that look at where they are: what they gain, and what they survive.

use pss_guide::{Context, Guide, GuideError, fit};
use serde_json::Map;

use crate::common::{self, cases};
use crate::world::{Paths, World};

/// Guides of every decision: one for each that models directions by place.
pub(crate) const ALL: [&str; 3] = [
    "table",
    "mixture-net+emitter-table+light-table+ray-table",
    "spline-net+emitter-table+light-table+ray-table",
];

fn fitted(name: &str, paths: &Paths) -> Box<dyn Guide> {
    fit(name, &Map::new(), &paths.records(), 1, &mut |_| true)
        .unwrap()
        .guide
}

fn table(paths: &Paths) -> Box<dyn Guide> {
    fitted("table", paths)
}

fn variance(estimates: &[f64]) -> f64 {
    let (_, error) = common::mean(estimates.iter().copied());
    error * error * estimates.len() as f64
}

/// Claim, stated beforehand: from 100,000 paths of a scene whose f depends on place, normal and emitter, guides
/// reach a variance 8 times below random sampling's at a = .1, with the same mean.
#[test]
fn guides_gain_where_the_density_depends_on_the_place() {
    let world = World::DEFAULT;
    let paths = world.draw(100_000, None, 1);
    let random = world.estimates(200_000, None, 2);
    let (a, ea) = common::mean(random.iter().copied());
    for name in ALL {
        let guide = fitted(name, &paths);
        let guided = world.estimates(200_000, Some((&*guide, 0.1)), 3);
        let gain = variance(&random) / variance(&guided);
        assert!(gain > 8.0, "{name}: gain {gain:.2}");
        let (b, eb) = common::mean(guided.into_iter());
        assert!(
            (a - b).abs() < 5.0 * ea.hypot(eb),
            "{name}: {a} ± {ea}, {b} ± {eb}"
        );
    }
}

/// Each factor alone gains, and three bounces are no special case.
#[test]
fn each_guide_gains_alone_and_more_bounces_gain_more() {
    let world = World {
        k: 3,
        ..World::DEFAULT
    };
    let paths = world.draw(50_000, None, 1);
    let random = variance(&world.estimates(200_000, None, 2));
    for (name, least) in [
        ("direction-table", 2.0),
        ("mixture-net", 2.0),
        ("spline-net", 2.0),
        ("emitter-table", 1.15),
        ("light-table", 1.15),
        ("ray-table", 1.15),
        ("table", 5.0),
    ] {
        let guide = fit(name, &Map::new(), &paths.records(), 1, &mut |_| true)
            .unwrap()
            .guide;
        let gain = random / variance(&world.estimates(200_000, Some((&*guide, 0.1)), 3));
        assert!(gain > least, "{name}: gain {gain:.2}");
    }
}

#[test]
fn size_and_place_of_the_scene_do_not_matter() {
    let gain = |corner: [f32; 3], scale: f32, flat: [f32; 3]| {
        let size = [
            4.0 * scale * flat[0],
            2.0 * scale * flat[1],
            scale * flat[2],
        ];
        let world = World {
            corner,
            size,
            ..World::DEFAULT
        };
        let table = table(&world.draw(50_000, None, 1));
        let random = variance(&world.estimates(50_000, None, 2));
        random / variance(&world.estimates(50_000, Some((&*table, 0.1)), 3))
    };
    let usual = gain([-1.0, 0.0, 5.0], 1.0, [1.0; 3]);
    for (corner, scale) in [([0.0; 3], 1e-4), ([-4e5; 3], 1e6), ([1e3, -1e3, 1e3], 1.0)] {
        let other = gain(corner, scale, [1.0; 3]);
        assert!(
            (other / usual - 1.0).abs() < 0.25,
            "{corner:?} {scale}: {other:.2}, usual {usual:.2}"
        );
    }
    // All sheets in one plane: the normals still tell them apart.
    let flat = gain([-1.0, 0.0, 5.0], 1.0, [1.0, 1.0, 0.0]);
    assert!(
        (flat / usual - 1.0).abs() < 0.25,
        "{flat:.2}, usual {usual:.2}"
    );
}

#[test]
fn few_paths_and_poor_ones_make_a_sound_guide() {
    let world = World::DEFAULT;
    let all = world.draw(8, None, 1);
    for n in [1, 2, 8] {
        let cut = Paths {
            dims: 5,
            u: all.u[..n * 5].to_vec(),
            f: all.f[..n].to_vec(),
            f_bsdf: all.f_bsdf[..n].to_vec(),
            ray: all.ray[..n].to_vec(),
            g: all.g[..n].to_vec(),
            g_bsdf: all.g_bsdf[..n].to_vec(),
            g_both: all.g_both[..n].to_vec(),
            contexts: all.contexts[..n * 2].to_vec(),
            pixel: all.pixel[..n].to_vec(),
            zeros: 100,
        };
        for name in ALL {
            let fitted = fit(name, &Map::new(), &cut.records(), 1, &mut |_| true);
            if n == 1 {
                assert!(matches!(
                    fitted,
                    Err(GuideError::TooFewPaths { usable: 1, .. })
                ));
                continue;
            }
            sound(&*fitted.unwrap().guide, "few");
        }
    }

    // Not a number here and there, all in one place, one path that outshines the rest.
    let mut poor = world.draw(1000, None, 1);
    (
        poor.f[1],
        poor.g[2],
        poor.f_bsdf[3],
        poor.g_bsdf[4],
        poor.u[25],
    ) = (f32::NAN, 0.0, f32::INFINITY, f32::NAN, 1.0);
    (poor.g_both[6], poor.ray[7]) = (0.0, [0.5, f32::NAN]);
    poor.contexts[20].position = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    poor.contexts[22].normal = [f32::NAN; 3];
    (poor.f[50], poor.f[51]) = (f32::MAX, 1e-38);
    let check = |paths: &Paths, what: &str| {
        for name in ALL {
            sound(&*fitted(name, paths), &format!("{name}, {what}"));
        }
    };
    check(&poor, "poor");

    let mut one = world.draw(1000, None, 1);
    let first = one.contexts[0];
    one.contexts.fill(Context { bounce: 1, ..first });
    check(&one, "one place");
    one.contexts.clear();
    check(&one, "no places");
    one.f_bsdf.clone_from(&one.f);
    check(&one, "no light from emitters that are chosen");
    one.ray.clear();
    check(&one, "no BSDF-sampled ray");
}

/// Whether densities at several places integrate to one, and samples stay in the cube.
pub(crate) fn sound(guide: &dyn Guide, what: &str) {
    for case in cases(guide) {
        let (mut u, mut q) = (common::uniform(2000, case.width, 8), vec![0.0; 2000]);
        case.density(guide, &u, &mut q);
        let (mean, error) = common::mean(q.iter().map(|&q| f64::from(q)));
        assert!(
            (mean - 1.0).abs() <= 5.0 * error + 1e-6,
            "{what}, {case:?}: ∫q = {mean} ± {error}"
        );
        case.sample(guide, &mut u, &mut q);
        assert!(
            q.iter().all(|&q| q.is_finite() && q > 0.0),
            "{what}, {case:?}"
        );
        assert!(u.iter().all(|u| (0.0..1.0).contains(u)), "{what}, {case:?}");
    }
}
