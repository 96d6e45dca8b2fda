//! The library writes into structs of ours. Behind each of them stands a guard here, and after each kind of
//! call it must be untouched. This is the test that embree4-rs fails: see the README.
#![allow(clippy::unwrap_used)]

use crate::ffi::{self, RtcQueryArguments};
use crate::{Device, Quadric, Ray, Scene, SceneBuilder, query};

const PATTERN: u32 = 0xDEAD_10CC;

/// A value with 256 guard bytes right behind it.
#[repr(C)]
struct Guarded<T> {
    value: T,
    guard: [u32; 64],
}

impl<T> Guarded<T> {
    fn new(value: T) -> Self {
        // No padding may hide an overrun: the guard must begin where the value ends.
        assert_eq!(std::mem::offset_of!(Self, guard), size_of::<T>());
        Self {
            value,
            guard: [PATTERN; 64],
        }
    }

    /// Lets `call` fill the value, then looks at the guard. The pointer may reach the guard, so that the
    /// overrun we look for would be seen instead of being undefined.
    fn fill(mut self, call: impl FnOnce(*mut T)) -> T {
        call((&raw mut self).cast());
        let guard = std::hint::black_box(&self.guard);
        assert_eq!(
            *guard,
            [PATTERN; 64],
            "{} was overrun",
            std::any::type_name::<T>()
        );
        self.value
    }
}

fn device() -> Device {
    let venv = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../.venv/lib");
    let pythons = std::fs::read_dir(venv).into_iter().flatten().flatten();
    let dirs: Vec<_> = pythons
        .map(|entry| entry.path().join("site-packages"))
        .filter(|dir| dir.is_dir())
        .collect();
    Device::with_candidates(&dirs).unwrap()
}

/// A triangle at z = 1, a disk at z = 2, a ball at z = 4, an instance of all that shifted by 10 in x.
fn scene(device: &Device) -> Scene {
    let fill = |builder: &mut SceneBuilder| {
        builder
            .triangles([-1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 0.0, 1.0, 1.0], [0, 1, 2])
            .unwrap();
        let to_world = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0];
        builder.quadric(Quadric::Disk { to_world }).unwrap();
        let (center, radius) = ([0.0, 0.0, 4.0], 1.5);
        builder.quadric(Quadric::Sphere { center, radius }).unwrap();
    };
    let mut inner = SceneBuilder::new(device).unwrap();
    fill(&mut inner);
    let inner = inner.commit().unwrap();
    let mut outer = SceneBuilder::new(device).unwrap();
    fill(&mut outer);
    outer
        .instance(
            &inner,
            &[1.0, 0.0, 0.0, 10.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        )
        .unwrap();
    outer.commit().unwrap()
}

/// Onto the triangle, the disk's rim, the ball's; the same through the instance; past everything.
fn rays() -> Vec<Ray> {
    [0.0, 0.95, 1.2, 10.0, 10.95, 11.2, 50.0]
        .map(|x| Ray::new([x, 0.1, 0.0], [0.0, 0.0, 1.0]))
        .to_vec()
}

const HIT_BY_RAY: [u32; 7] = [0, 1, 2, 0, 1, 2, ffi::INVALID];

#[test]
fn rayhit_and_ray_are_not_overrun() {
    let device = device();
    let (scene, api) = (scene(&device), device.api());
    for (ray, geom) in rays().iter().zip(HIT_BY_RAY) {
        for with_args in [false, true] {
            let mut args = RtcQueryArguments::new(false);
            let args = if with_args {
                &raw mut args
            } else {
                std::ptr::null_mut()
            };
            let filled = Guarded::new(query::rayhit(ray)).fill(|rayhit| {
                // SAFETY: committed scene; `rayhit` is aligned and as large as the library's struct.
                unsafe { (api.intersect1)(scene.raw(), rayhit, args) }
            });
            assert_eq!(filled.hit.geom_id, geom);
            let ray = query::rayhit(ray).ray;
            let filled = Guarded::new(ray).fill(|ray| {
                // SAFETY: as above, with an RTCRay.
                unsafe { (api.occluded1)(scene.raw(), ray, args) }
            });
            assert_eq!(filled.tfar == f32::NEG_INFINITY, geom != ffi::INVALID);
        }
    }
}

#[test]
fn packets_are_not_overrun() {
    let device = device();
    let (scene, api) = (scene(&device), device.api());
    let all = rays().repeat(3);
    for coherent in [false, true] {
        for rays in [&all[..16], &all[..7], &all[6..7]] {
            let mut args = Guarded::new(RtcQueryArguments::new(coherent));
            let (valid, packet) = query::rayhit16(rays);
            let valid = Guarded::new(valid);
            let filled = Guarded::new(packet).fill(|packet| {
                // SAFETY: committed scene; all three are aligned and as large as the library's structs.
                unsafe {
                    (api.intersect16)(
                        valid.value.0.as_ptr(),
                        scene.raw(),
                        packet,
                        &raw mut args.value,
                    );
                }
            });
            for (i, &geom) in HIT_BY_RAY
                .iter()
                .cycle()
                .take(rays.len())
                .enumerate()
                .filter(|_| rays.len() > 1)
            {
                assert_eq!(filled.hit.geom_id[i], geom);
            }
            let (valid, packet) = query::rtc_ray16(rays);
            Guarded::new(packet).fill(|packet| {
                // SAFETY: as above, with an RTCRay16.
                unsafe {
                    (api.occluded16)(valid.0.as_ptr(), scene.raw(), packet, &raw mut args.value);
                }
            });
            assert_eq!(args.guard, [PATTERN; 64]);
        }
    }
}

#[test]
fn bounds_are_not_overrun() {
    let device = device();
    let (scene, api) = (scene(&device), device.api());
    let empty = ffi::RtcBounds {
        lower: [0.0; 3],
        align0: 0.0,
        upper: [0.0; 3],
        align1: 0.0,
    };
    let filled = Guarded::new(empty).fill(|bounds| {
        // SAFETY: committed scene; `bounds` is aligned and writable.
        unsafe { (api.get_scene_bounds)(scene.raw(), bounds) }
    });
    assert!(filled.lower[2] <= 1.0 && filled.upper[0] >= 11.0);
}

/// The other direction: what *we* write in the callbacks stays within the lanes that Embree gave us.
#[test]
fn callbacks_write_no_byte_past_a_packet() {
    use crate::shapes::{
        Prepared, bounds_callback, intersect_callback, occluded_callback, user_pointer,
    };
    let radius = 1.0;
    let shape = std::sync::Arc::new(
        Prepared::new(&Quadric::Sphere {
            center: [0.0; 3],
            radius,
        })
        .unwrap(),
    );
    let mut context = ffi::RtcRayQueryContext {
        inst_id: 3,
        inst_prim_id: PATTERN,
        padding: [PATTERN; 2],
    };
    for n in [1usize, 4, 8, 16] {
        for (words, intersect) in [(ffi::RAY_FIELDS + 8, true), (ffi::RAY_FIELDS, false)] {
            // Ray i starts at x = 0.11·i and z = −3 and looks along +z; odd lanes are dead.
            let mut packet = vec![PATTERN; words * n + 64];
            let mut valid: Vec<i32> = (0..n).map(|i| if i % 2 == 0 { -1 } else { 0 }).collect();
            for i in 0..n {
                let ray = [
                    i as f32 * 0.11,
                    0.0,
                    -3.0,
                    0.0,
                    0.0,
                    0.0,
                    1.0,
                    0.0,
                    f32::INFINITY,
                ];
                for (field, value) in ray.into_iter().enumerate() {
                    packet[field * n + i] = value.to_bits();
                }
            }
            let before = packet.clone();
            let args = ffi::RtcQueryFunctionNArguments {
                valid: valid.as_mut_ptr(),
                geometry_user_ptr: user_pointer(&shape),
                prim_id: 0,
                context: &raw mut context,
                rayhit: packet.as_mut_ptr().cast(),
                n: n as u32,
                geom_id: 5,
            };
            // SAFETY: `args` is what Embree would pass, for a packet of n rays (and hits, up to instID).
            unsafe {
                if intersect {
                    intersect_callback(&raw const args)
                } else {
                    occluded_callback(&raw const args)
                }
            }
            assert_eq!(packet[words * n..], before[words * n..], "n = {n}");
            for i in 0..n {
                let field = |k: usize| packet[k * n + i];
                let hit = i % 2 == 0 && i < 10;
                let expected = match (hit, intersect) {
                    (false, _) => f32::INFINITY,
                    (true, false) => f32::NEG_INFINITY,
                    (true, true) => 3.0 - (1.0 - (i as f32 * 0.11).powi(2)).sqrt(),
                };
                let tfar = f32::from_bits(field(8));
                assert!(
                    tfar == expected || (tfar - expected).abs() < 1e-5,
                    "n = {n}, lane {i}: {tfar}"
                );
                if intersect {
                    let ids = [field(17), field(18), field(19)];
                    assert_eq!(
                        ids,
                        if hit { [0, 5, 3] } else { [PATTERN; 3] },
                        "n = {n}, lane {i}"
                    );
                }
            }
        }
    }
    let bounds = ffi::RtcBounds {
        lower: [0.0; 3],
        align0: 0.0,
        upper: [0.0; 3],
        align1: 0.0,
    };
    let filled = Guarded::new(bounds).fill(|bounds| {
        let args = ffi::RtcBoundsFunctionArguments {
            geometry_user_ptr: user_pointer(&shape),
            prim_id: 0,
            time_step: 0,
            bounds_o: bounds,
        };
        // SAFETY: `args` is what Embree would pass.
        unsafe { bounds_callback(&raw const args) }
    });
    assert!(filled.lower[0] <= -1.0 && filled.upper[2] >= 1.0);
}

/// Shows that the guards above can fail: a ray-hit of 80 bytes, as embree4-rs 0.0.16 passes, is overrun by
/// `instPrimID` in Embree 4.3 and later, and left alone before.
#[test]
fn a_rayhit_of_80_bytes_would_be_overrun_since_4_3() {
    let device = device();
    let (scene, api) = (scene(&device), device.api());
    #[repr(C, align(16))]
    struct Short([u32; 20]);
    let mut short = Guarded::new(Short([0; 20]));
    let start = query::rayhit(&rays()[0]);
    // SAFETY: `short` has 336 bytes, the first 96 of which become a valid RTCRayHit; the rest is the guard.
    let overrun = unsafe {
        let rayhit = (&raw mut short).cast::<ffi::RtcRayHit>();
        rayhit
            .cast::<u32>()
            .copy_from_nonoverlapping((&raw const start).cast(), 20);
        (api.intersect1)(scene.raw(), rayhit, std::ptr::null_mut());
        (&raw const short.guard).read() != [PATTERN; 64]
    };
    assert_eq!(overrun, device.version() >= (4, 3, 0));
}
