//! Embree against the brute-force oracle, on random scenes and random rays.
#![allow(clippy::unwrap_used)]

mod common;

use common::{Random, Twin, device, everything};
use embree4::{Hit, Quadric, Ray, Scene, brute};

/// How far apart two hits are, relative to their size: the largest of t, u, v, the normal's
/// direction, and on triangles its length.
fn distance(a: &Hit, b: &Hit) -> f32 {
    let norm = |v: [f32; 3]| v.iter().map(|x| x * x).sum::<f32>().sqrt();
    let (la, lb) = (norm(a.ng), norm(b.ng));
    let normals = (0..3)
        .map(|i| (a.ng[i] / la - b.ng[i] / lb).abs())
        .fold(0.0, f32::max);
    let t = (a.t - b.t).abs() / (1.0 + a.t.abs());
    let lengths = if (a.u, a.v) == (0.0, 0.0) {
        0.0
    } else {
        (la / lb - 1.0).abs()
    };
    [(a.u - b.u).abs(), (a.v - b.v).abs(), normals, lengths]
        .into_iter()
        .fold(t, f32::max)
}

/// Compares `n` rays. Rays that graze a rim or an edge may go either way in single precision, so a small
/// share may differ in *what* is hit (the nearest on the other side is then far off); where both agree on
/// that, the numbers must agree to `tolerance`.
fn compare(name: &str, scenes: &(Scene, brute::Scene), n: usize, tolerance: f32) {
    let mut random = Random(7);
    let (mut hits, mut grazing) = (0, 0);
    for i in 0..n {
        let mut ray = random.ray();
        if i % 4 == 3 {
            // Segments that begin and end within the scene.
            ray.tnear = random.signed();
            ray.tfar = 1.0 + random.signed();
        }
        let (embree, oracle) = (scenes.0.intersect(&ray), scenes.1.intersect(&ray));
        assert_eq!(embree.is_some(), scenes.0.occluded(&ray), "{name}: {ray:?}");
        match (embree, oracle) {
            (None, None) => {}
            (Some(a), Some(b)) if (a.geom, a.prim, a.inst) == (b.geom, b.prim, b.inst) => {
                hits += 1;
                // Near the silhouette the hit point itself is ill-conditioned: its error grows as 1/cos.
                let dot: f32 = (0..3).map(|i| b.ng[i] * ray.dir[i]).sum();
                let norms: f32 = [b.ng, ray.dir]
                    .iter()
                    .map(|v| v.iter().map(|x| x * x).sum::<f32>().sqrt())
                    .product();
                let error = distance(&a, &b) * (dot / norms).abs();
                assert!(error < tolerance, "{name}: {ray:?}\n{a:?}\n{b:?}");
            }
            _ => grazing += 1,
        }
    }
    assert!(
        hits > n / 50,
        "{name}: only {hits} of {n} rays hit, so little was compared"
    );
    assert!(
        grazing <= n / 2000,
        "{name}: {grazing} of {n} rays disagree on what is hit"
    );
}

#[test]
fn triangles() {
    let device = device();
    let mut random = Random(1);
    for robust in [false, true] {
        let mut twin = Twin::new(&device);
        twin.builder.robust(robust);
        twin.mesh(&random.mesh(60)).mesh(&random.mesh(1));
        compare("triangles", &twin.commit(), 20_000, 1e-4);
    }
}

#[test]
fn spheres() {
    let device = device();
    let mut random = Random(2);
    let mut twin = Twin::new(&device);
    for radius in [0.05, 0.3, 1.0, 3.5] {
        twin.quadric(Quadric::Sphere {
            center: random.vector(1.0),
            radius,
        });
    }
    compare("spheres", &twin.commit(), 20_000, 2e-6);
}

#[test]
fn disks_scaled_sheared_and_reflected() {
    let device = device();
    let mut random = Random(3);
    let mut twin = Twin::new(&device);
    for _ in 0..12 {
        twin.quadric(Quadric::Disk {
            to_world: random.transform(),
        });
    }
    compare("disks", &twin.commit(), 20_000, 2e-6);
}

#[test]
fn cylinders_scaled_sheared_and_reflected() {
    let device = device();
    let mut random = Random(4);
    let mut twin = Twin::new(&device);
    for _ in 0..6 {
        twin.quadric(Quadric::Cylinder {
            to_world: random.transform(),
        });
    }
    compare("cylinders", &twin.commit(), 20_000, 2e-6);
}

#[test]
fn instances_of_everything() {
    let device = device();
    for seed in 5..8 {
        compare(
            "instances",
            &everything(&device, &mut Random(seed)),
            10_000,
            1e-4,
        );
    }
}

#[test]
fn known_answers() {
    let device = device();
    let mut twin = Twin::new(&device);
    // A cylinder of radius 2 along z from z = 0 to 3, a disk of radii 2 and 1 at z = 5, a sphere around it all.
    let cylinder = [2.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 3.0, 0.0];
    let disk = [2.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 5.0];
    twin.quadric(Quadric::Cylinder { to_world: cylinder });
    twin.quadric(Quadric::Disk { to_world: disk });
    twin.quadric(Quadric::Sphere {
        center: [0.0; 3],
        radius: 10.0,
    });
    let (scene, oracle) = twin.commit();
    let cases = [
        // From outside onto the wall, then from the axis onto it: same normal, pointing away from the axis.
        (
            Ray::new([5.0, 0.0, 1.0], [-1.0, 0.0, 0.0]),
            3.0,
            0,
            [1.0, 0.0, 0.0],
        ),
        (
            Ray::new([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]),
            2.0,
            0,
            [1.0, 0.0, 0.0],
        ),
        // Through the open end onto the inside of the far wall: the near root lies above the rim.
        (
            Ray::new([4.0, 0.0, 5.0], [-2.0, 0.0, -1.0]),
            3.0,
            0,
            [-1.0, 0.0, 0.0],
        ),
        // Along the axis the wall is never met; the disk is, from behind too, with its own normal.
        (
            Ray::new([0.0, 0.5, 0.0], [0.0, 0.0, 1.0]),
            5.0,
            1,
            [0.0, 0.0, 1.0],
        ),
        (
            Ray::new([1.9, 0.0, 6.0], [0.0, 0.0, -2.0]),
            0.5,
            1,
            [0.0, 0.0, 1.0],
        ),
        // Past the disk's short radius, onto the sphere from inside; a direction of length 2 halves t.
        (
            Ray::new([0.0, 1.1, 0.0], [0.0, 0.0, 2.0]),
            (100.0f32 - 1.21).sqrt() / 2.0,
            2,
            [0.0, 0.11, 0.994],
        ),
    ];
    for (ray, t, geom, normal) in cases {
        for hit in [
            scene.intersect(&ray).unwrap(),
            oracle.intersect(&ray).unwrap(),
        ] {
            assert_eq!(hit.geom, geom, "{ray:?}");
            assert!((hit.t - t).abs() < 1e-5, "{ray:?}: {hit:?}");
            let norm = hit.ng.iter().map(|x| x * x).sum::<f32>().sqrt();
            assert!(
                (0..3).all(|i| (hit.ng[i] / norm - normal[i]).abs() < 1e-3),
                "{ray:?}: {hit:?}"
            );
            assert_eq!((hit.u, hit.v, hit.prim, hit.inst), (0.0, 0.0, 0, None));
        }
    }
    // Both ends of a segment count; beyond them nothing does.
    let ray = Ray::new([5.0, 0.0, 1.0], [-1.0, 0.0, 0.0]);
    assert!(scene.occluded(&ray.until(3.001)) && !scene.occluded(&ray.until(2.999)));
    assert_eq!(
        scene.intersect(&Ray { tnear: 3.5, ..ray }).map(|hit| hit.t),
        Some(7.0)
    );
}

#[test]
fn a_far_small_sphere_keeps_its_rim() {
    // In single precision a ball of radius 1 seen from 10⁴ loses its outer parts; in double it does not.
    let device = device();
    let mut twin = Twin::new(&device);
    twin.quadric(Quadric::Sphere {
        center: [0.0, 0.0, 1e4],
        radius: 1.0,
    });
    let (scene, _) = twin.commit();
    for (y, hit) in [
        (0.0, true),
        (0.999, true),
        (0.9999, true),
        (1.0001, false),
        (1.001, false),
    ] {
        assert_eq!(
            scene.occluded(&Ray::new([0.0, y, 0.0], [0.0, 0.0, 1.0])),
            hit,
            "y = {y}"
        );
    }
}

#[test]
fn normals_of_mirrored_instances_stay_on_the_mirrored_side() {
    let device = device();
    let mut inner = Twin::new(&device);
    inner.mesh(&(
        vec![0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        vec![0, 1, 2],
    ));
    let inner = inner.commit();
    let mut outer = Twin::new(&device);
    // z → −2z: the normal +z must become −z.
    outer.instance(
        &inner,
        &[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -2.0, 0.0],
    );
    let (scene, oracle) = outer.commit();
    let ray = Ray::new([0.25, 0.25, -1.0], [0.0, 0.0, 1.0]);
    for hit in [
        scene.intersect(&ray).unwrap(),
        oracle.intersect(&ray).unwrap(),
    ] {
        let off = [hit.t - 1.0, hit.u - 0.25, hit.v - 0.25];
        assert!(
            hit.inst == Some(0) && off.iter().all(|x| x.abs() < 1e-6),
            "{hit:?}"
        );
        assert!(hit.ng[2] < 0.0 && hit.ng[0] == 0.0, "{hit:?}");
    }
}
