//! Rays into Embree's structs and hits out of them.

use crate::Ray;
use crate::ffi::{self, RtcRay, RtcRay16, RtcRayHit, RtcRayHit16, Valid16};
use crate::scene::PACKET_WIDTH;

#[inline]
pub(crate) fn rtc_ray(ray: &Ray) -> RtcRay {
    RtcRay {
        org: ray.origin,
        tnear: ray.tnear.max(0.0),
        dir: ray.dir,
        time: 0.0,
        tfar: ray.tfar,
        mask: u32::MAX,
        id: 0,
        flags: 0,
    }
}

const MISS: ffi::RtcHit = ffi::RtcHit {
    ng: [0.0; 3],
    u: 0.0,
    v: 0.0,
    prim_id: ffi::INVALID,
    geom_id: ffi::INVALID,
    inst_id: ffi::INVALID,
    inst_prim_id: ffi::INVALID,
};

#[inline]
pub(crate) fn rayhit(ray: &Ray) -> RtcRayHit {
    RtcRayHit {
        ray: rtc_ray(ray),
        hit: MISS,
    }
}

/// Up to 16 rays side by side; lanes without a ray are dead.
#[inline]
pub(crate) fn rtc_ray16(rays: &[Ray]) -> (Valid16, RtcRay16) {
    let mut valid = Valid16([0; PACKET_WIDTH]);
    let mut packet = RtcRay16 {
        org: [[0.0; PACKET_WIDTH]; 3],
        tnear: [0.0; PACKET_WIDTH],
        dir: [[0.0; PACKET_WIDTH]; 3],
        time: [0.0; PACKET_WIDTH],
        tfar: [f32::NEG_INFINITY; PACKET_WIDTH],
        mask: [u32::MAX; PACKET_WIDTH],
        id: [0; PACKET_WIDTH],
        flags: [0; PACKET_WIDTH],
    };
    for (i, ray) in rays.iter().enumerate().take(PACKET_WIDTH) {
        valid.0[i] = -1;
        for axis in 0..3 {
            packet.org[axis][i] = ray.origin[axis];
            packet.dir[axis][i] = ray.dir[axis];
        }
        packet.tnear[i] = ray.tnear.max(0.0);
        packet.tfar[i] = ray.tfar;
    }
    (valid, packet)
}

#[inline]
pub(crate) fn rayhit16(rays: &[Ray]) -> (Valid16, RtcRayHit16) {
    let (valid, ray) = rtc_ray16(rays);
    let hit = ffi::RtcHit16 {
        ng: [[0.0; PACKET_WIDTH]; 3],
        u: [0.0; PACKET_WIDTH],
        v: [0.0; PACKET_WIDTH],
        prim_id: [ffi::INVALID; PACKET_WIDTH],
        geom_id: [ffi::INVALID; PACKET_WIDTH],
        inst_id: [ffi::INVALID; PACKET_WIDTH],
        inst_prim_id: [ffi::INVALID; PACKET_WIDTH],
    };
    (valid, RtcRayHit16 { ray, hit })
}

#[inline]
pub(crate) fn lane(hit: &ffi::RtcHit16, i: usize) -> ffi::RtcHit {
    ffi::RtcHit {
        ng: [hit.ng[0][i], hit.ng[1][i], hit.ng[2][i]],
        u: hit.u[i],
        v: hit.v[i],
        prim_id: hit.prim_id[i],
        geom_id: hit.geom_id[i],
        inst_id: hit.inst_id[i],
        inst_prim_id: hit.inst_prim_id[i],
    }
}
