//! Packets, threads, empty scenes, and everything that must be refused.
#![allow(clippy::unwrap_used)]

mod common;

use common::{Random, device, everything};
use embree4::{Device, EmbreeError, Hit, Quadric, Ray, Scene, SceneBuilder, Shared};

const fn is_send_sync_clone<T: Send + Sync + Clone>() {}
const _: () = is_send_sync_clone::<Scene>();
const _: () = is_send_sync_clone::<Device>();

/// Same surface, numbers equal but for the order of roundings in kernels of different width.
fn same(a: &Option<Hit>, b: &Option<Hit>) -> bool {
    match (a, b) {
        (Some(a), Some(b)) => {
            let close = |x: f32, y: f32| (x - y).abs() <= 1e-4 * (1.0 + x.abs());
            (a.geom, a.prim, a.inst) == (b.geom, b.prim, b.inst)
                && close(a.t, b.t)
                && close(a.u, b.u)
                && close(a.v, b.v)
                && (0..3).all(|i| close(a.ng[i], b.ng[i]))
        }
        (None, None) => true,
        _ => false,
    }
}

#[test]
fn packets_are_singles() {
    let device = device();
    let mut random = Random(11);
    let (scene, _) = everything(&device, &mut random);
    for coherent in [true, false] {
        // Full packets, partial ones, none at all.
        for count in [0, 1, 5, 15, 16, 17, 64, 999] {
            let rays: Vec<Ray> = (0..count)
                .map(|_| random.ray().until(1.0 + random.signed()))
                .collect();
            let mut hits = vec![None; count];
            let mut blocked = vec![false; count];
            scene.intersect_packet16(&rays, &mut hits, coherent);
            scene.occluded_packet16(&rays, &mut blocked, coherent);
            let mut differing = 0;
            for (i, ray) in rays.iter().enumerate() {
                differing += usize::from(!same(&hits[i], &scene.intersect(ray)));
                differing += usize::from(blocked[i] != scene.occluded(ray));
            }
            assert!(
                differing <= count / 300,
                "{differing} of {count} rays differ, coherent = {coherent}"
            );
        }
    }
}

#[test]
fn a_packet_overwrites_old_answers() {
    let device = device();
    let (scene, _) = everything(&device, &mut Random(12));
    let away = Ray::new([9.0, 9.0, 9.0], [1.0, 1.0, 1.0]);
    let stale = scene.intersect(&Ray::new([4.0, 0.0, 0.0], [-1.0, 0.0, 0.0]));
    let mut hits = [stale; 3];
    let mut blocked = [true; 3];
    scene.intersect_packet16(&[away; 3], &mut hits, true);
    scene.occluded_packet16(&[away; 3], &mut blocked, true);
    assert_eq!(hits, [None; 3]);
    assert_eq!(blocked, [false; 3]);
}

#[test]
fn many_threads_trace_one_scene() {
    let device = device();
    let (scene, _) = everything(&device, &mut Random(13));
    let trace = |scene: &Scene, seed: u64| -> Vec<Option<Hit>> {
        let mut random = Random(seed);
        (0..4000).map(|_| scene.intersect(&random.ray())).collect()
    };
    let alone: Vec<_> = (0..8).map(|seed| trace(&scene, seed)).collect();
    let together: Vec<_> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..8)
            .map(|seed| {
                let scene = scene.clone();
                scope.spawn(move || trace(&scene, seed))
            })
            .collect();
        workers
            .into_iter()
            .map(|worker| worker.join().unwrap())
            .collect()
    });
    assert!(alone == together, "hits depend on how many threads trace");
}

#[test]
fn many_threads_build_on_one_device() {
    let device = device();
    std::thread::scope(|scope| {
        for seed in 0..6 {
            let device = device.clone();
            scope.spawn(move || {
                for round in 0..5 {
                    let (scene, oracle) = everything(&device, &mut Random(100 * seed + round));
                    let ray = Ray::new([4.0, 0.1, 0.2], [-1.0, 0.0, 0.0]);
                    let surface = |hit: Option<Hit>| hit.map(|hit| (hit.geom, hit.prim, hit.inst));
                    assert_eq!(
                        surface(scene.intersect(&ray)),
                        surface(oracle.intersect(&ray))
                    );
                    // A refusal on one thread must not surface on another.
                    let mut builder = SceneBuilder::new(&device).unwrap();
                    assert!(builder.triangles([f32::NAN; 3], [0, 0, 0]).is_err());
                }
            });
        }
    });
}

#[test]
fn a_scene_outlives_its_device_builder_and_instanced_scene() {
    let ray = Ray::new([0.0, 0.0, -3.0], [0.0, 0.0, 1.0]);
    let scene = {
        let device = device();
        let mut inner = SceneBuilder::new(&device).unwrap();
        let radius = 1.0;
        inner
            .quadric(Quadric::Sphere {
                center: [0.0; 3],
                radius,
            })
            .unwrap();
        let inner = inner.commit().unwrap();
        let mut outer = SceneBuilder::new(&device).unwrap();
        let shifted = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0];
        outer.instance(&inner, &shifted).unwrap();
        outer.commit().unwrap()
    };
    assert_eq!(
        scene.intersect(&ray).map(|hit| (hit.t, hit.inst)),
        Some((3.0, Some(0)))
    );
    assert_eq!(scene.device().version().0, 4);
    let copy = scene.clone();
    drop(scene);
    assert!(copy.occluded(&ray));
}

#[test]
fn empty_scenes_and_empty_meshes_are_missed() {
    let device = device();
    let ray = Ray::new([0.0; 3], [0.0, 0.0, 1.0]);
    for with_mesh in [false, true] {
        let mut builder = SceneBuilder::new(&device).unwrap();
        if with_mesh {
            builder.triangles([], []).unwrap();
            builder.triangles([0.0; 9], []).unwrap();
        }
        let scene = builder.commit().unwrap();
        assert_eq!(scene.intersect(&ray), None);
        assert!(!scene.occluded(&ray));
        assert_eq!(scene.bounds(), None);
        assert_eq!(scene.is_empty(), !with_mesh);
        let mut hits = [None; 2];
        scene.intersect_packet16(&[ray; 2], &mut hits, true);
        assert_eq!(hits, [None; 2]);
    }
}

#[test]
fn triangles_without_area_are_missed() {
    let device = device();
    let mut builder = SceneBuilder::new(&device).unwrap();
    builder
        .triangles(
            [0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 2.0, 0.0, 1.0],
            [0, 1, 2, 0, 0, 0],
        )
        .unwrap();
    let scene = builder.commit().unwrap();
    assert_eq!(
        scene.intersect(&Ray::new([0.5, 0.0, 0.0], [0.0, 0.0, 1.0])),
        None
    );
}

#[test]
fn rays_that_make_no_sense_are_survived() {
    let device = device();
    let (scene, _) = everything(&device, &mut Random(14));
    let (nan, inf) = (f32::NAN, f32::INFINITY);
    let bad = [
        Ray::new([nan; 3], [1.0, 0.0, 0.0]),
        Ray::new([0.0; 3], [nan; 3]),
        Ray::new([0.0; 3], [0.0; 3]),
        Ray::new([inf; 3], [-1.0, 0.0, 0.0]),
        Ray::new([0.0; 3], [inf, 0.0, 0.0]),
        Ray::new([4.0, 0.0, 0.0], [-1.0, 0.0, 0.0]).until(nan),
        Ray::new([4.0, 0.0, 0.0], [-1.0, 0.0, 0.0]).until(-inf),
        Ray::new([4.0, 0.0, 0.0], [-1.0, 0.0, 0.0]).until(-1.0),
    ];
    let mut hits = [None; 8];
    let mut blocked = [false; 8];
    for ray in &bad {
        std::hint::black_box((scene.intersect(ray), scene.occluded(ray)));
    }
    scene.intersect_packet16(&bad, &mut hits, false);
    scene.occluded_packet16(&bad, &mut blocked, false);
    for i in [6, 7] {
        assert_eq!((hits[i], blocked[i]), (None, false), "{:?}", bad[i]);
        assert_eq!(
            (scene.intersect(&bad[i]), scene.occluded(&bad[i])),
            (None, false),
            "{:?}",
            bad[i]
        );
    }
}

#[test]
fn bounds_contain_the_scene_tightly() {
    let device = device();
    let mut builder = SceneBuilder::new(&device).unwrap();
    builder
        .triangles([-3.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0, 1, 2])
        .unwrap();
    // A disk of radius 2 that faces +x: flat in x.
    let disk = [0.0, 0.0, 1.0, 4.0, 0.0, 2.0, 0.0, 0.0, -2.0, 0.0, 0.0, 0.0];
    builder.quadric(Quadric::Disk { to_world: disk }).unwrap();
    let bounds = builder.commit().unwrap().bounds().unwrap();
    let (min, max) = ([-3.0f32, -2.0, -2.0], [4.0f32, 2.0, 2.0]);
    for i in 0..3 {
        assert!(
            bounds.min[i] <= min[i] && bounds.min[i] > min[i] - 1e-5,
            "{bounds:?}"
        );
        assert!(
            bounds.max[i] >= max[i] && bounds.max[i] < max[i] + 1e-5,
            "{bounds:?}"
        );
    }
}

#[test]
fn bad_geometry_is_refused_by_name() {
    let device = device();
    let mut builder = SceneBuilder::new(&device).unwrap();
    let corner = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let with = |value: f32| {
        let mut positions = corner;
        positions[4] = value;
        positions
    };
    let identity = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let mut flat = identity;
    flat[10] = 0.0;
    let mut endless = identity;
    endless[3] = f32::INFINITY;
    let sphere = |center, radius| Quadric::Sphere { center, radius };
    let cases: Vec<(Result<_, EmbreeError>, &str)> = vec![
        (
            builder.triangles([0.0; 10], [0, 1, 2]),
            "`positions` holds 10 numbers, but must hold a multiple of 3",
        ),
        (
            builder.triangles(corner, [0, 1]),
            "`faces` holds 2 numbers, but must hold a multiple of 3",
        ),
        (
            builder.triangles(corner, [0, 1, 2, 0, 1, 3]),
            "faces[1] names vertex 3, but the mesh has 3 vertices",
        ),
        (
            builder.triangles(corner, [0, u32::MAX, 2]),
            "faces[0] names vertex 4294967295",
        ),
        (
            builder.triangles([], [0, 1, 2]),
            "faces[0] names vertex 0, but the mesh has 0 vertices",
        ),
        (
            builder.triangles(with(f32::NAN), [0, 1, 2]),
            "positions[1] = [1.0, NaN, 0.0] must be finite",
        ),
        (
            builder.triangles(with(f32::INFINITY), [0, 1, 2]),
            "positions[1] = [1.0, inf, 0.0] must be finite",
        ),
        (builder.triangles(with(-1e19), [0, 1, 2]), "within ±1e18"),
        (builder.quadric(sphere([0.0; 3], 0.0)), "radius 0"),
        (builder.quadric(sphere([0.0; 3], -1.0)), "radius -1"),
        (builder.quadric(sphere([0.0; 3], f32::NAN)), "radius NaN"),
        (
            builder.quadric(sphere([f32::NAN; 3], 1.0)),
            "centre [NaN, NaN, NaN]",
        ),
        (
            builder.quadric(Quadric::Disk { to_world: flat }),
            "to_world of the disk",
        ),
        (
            builder.quadric(Quadric::Disk {
                to_world: [f32::NAN; 12],
            }),
            "to_world of the disk",
        ),
        (
            builder.quadric(Quadric::Cylinder { to_world: endless }),
            "to_world of the cylinder",
        ),
        (
            builder.quadric(Quadric::Cylinder {
                to_world: [0.0; 12],
            }),
            "to_world of the cylinder",
        ),
    ];
    for (result, expected) in cases {
        let text = result.unwrap_err().to_string();
        assert!(
            text.contains(expected),
            "{text:?} does not contain {expected:?}"
        );
        assert_eq!(text.lines().count(), 1, "{text}");
    }
    // Nothing of it has stuck: the next geometry is the first.
    assert_eq!(builder.triangles(corner, [0, 1, 2]).unwrap().0, 0);
}

#[test]
fn bad_instances_are_refused_by_name() {
    let (one, other) = (device(), device());
    let identity = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let leaf = SceneBuilder::new(&one).unwrap().commit().unwrap();
    let mut builder = SceneBuilder::new(&one).unwrap();
    builder.instance(&leaf, &identity).unwrap();
    let nested = builder.commit().unwrap();
    let foreign = SceneBuilder::new(&other).unwrap().commit().unwrap();
    let mut builder = SceneBuilder::new(&one).unwrap();
    assert_eq!(
        builder.instance(&nested, &identity),
        Err(EmbreeError::NestedInstance)
    );
    assert_eq!(
        builder.instance(&foreign, &identity),
        Err(EmbreeError::OtherDevice)
    );
    let flat = builder.instance(&leaf, &[0.0; 12]).unwrap_err().to_string();
    assert!(flat.starts_with("to_world of the instance"), "{flat}");
}

/// Meshes that Embree reads in place are hit as copied ones are, also when nobody else holds their arrays any longer,
/// and the device counts what it allocates itself.
#[test]
fn shared_meshes_are_read_in_place() {
    let device = Device::new().unwrap();
    // A strip of triangles, so that the last vertex lies at the end of its allocation.
    let n = 1000u32;
    let positions: Vec<f32> = (0..n)
        .flat_map(|i| [(i / 2) as f32 * 0.01, (i % 2) as f32, (i % 7) as f32 * 0.1])
        .collect();
    let faces: Vec<u32> = (0..n - 2).flat_map(|i| [i, i + 1, i + 2]).collect();
    let mut copied = SceneBuilder::new(&device).unwrap();
    copied.triangles(&positions, &faces).unwrap();
    let copied = copied.commit().unwrap();
    let before = device.memory();
    let shared = {
        let (positions, faces) = (Shared::from(positions), Shared::from(faces));
        assert_eq!(
            (positions.len(), faces.len()),
            (3 * n as usize, 3 * (n as usize - 2))
        );
        let mut builder = SceneBuilder::new(&device).unwrap();
        builder.shared_triangles(&positions, &faces).unwrap();
        builder.commit().unwrap()
    };
    assert!(device.memory() > before);
    let mut met = 0;
    for i in 0..500 {
        let x = i as f32 * 0.01;
        let ray = Ray::new([x, 0.37, 5.0], [0.01, 0.0, -1.0]);
        let (a, b) = (copied.intersect(&ray), shared.intersect(&ray));
        met += usize::from(a.is_some());
        assert_eq!(
            a.map(|h| (h.prim, h.t, h.u, h.v)),
            b.map(|h| (h.prim, h.t, h.u, h.v))
        );
    }
    assert!(met > 400);
    drop(shared);

    let mut builder = SceneBuilder::new(&device).unwrap();
    let corner = Shared::from(vec![0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
    let refused = builder.shared_triangles(&corner, &Shared::from(vec![0, 1, 3]));
    assert!(refused.unwrap_err().to_string().contains('3'));
    assert!(
        builder
            .shared_triangles(&corner, &Shared::from(Vec::new()))
            .is_ok()
    );
}
