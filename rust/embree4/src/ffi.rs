//! The part of Embree 4's C interface that the project uses: types, constants, function table.
//!
//! Written by hand from the documented interface (`rtcore_{common,device,scene,geometry,ray}.h`, 4.0 to
//! 4.4). Two structs grew within version 4: since 4.3 `RTCHit` and `RTCRayQueryContext` end in
//! `instPrimID`. The types here have the newer, larger size, which suits both. Sizes and alignments are
//! asserted at compile time below, and `guard_tests.rs` asserts at run time that the library writes no
//! byte past any of them.

use std::ffi::{c_char, c_int, c_uint, c_void};

/// Marks "no geometry" and "no instance".
pub(crate) const INVALID: u32 = u32::MAX;

pub(crate) const PROPERTY_VERSION: c_uint = 0;
pub(crate) const GEOMETRY_TRIANGLE: c_uint = 0;
pub(crate) const GEOMETRY_USER: c_uint = 120;
pub(crate) const GEOMETRY_INSTANCE: c_uint = 121;
pub(crate) const BUFFER_INDEX: c_uint = 0;
pub(crate) const BUFFER_VERTEX: c_uint = 1;
pub(crate) const FORMAT_UINT3: c_uint = 0x5003;
pub(crate) const FORMAT_FLOAT3: c_uint = 0x9003;
pub(crate) const FORMAT_FLOAT3X4_ROW_MAJOR: c_uint = 0x9134;
pub(crate) const QUALITY_HIGH: c_uint = 2;
pub(crate) const SCENE_ROBUST: c_uint = 1 << 2;
pub(crate) const FEATURES_ALL: c_uint = u32::MAX;
pub(crate) const QUERY_INCOHERENT: c_uint = 0;
pub(crate) const QUERY_COHERENT: c_uint = 1 << 16;

/// Number of 32-bit fields of a ray; a hit's fields follow them in `RTCRayHitN`.
pub(crate) const RAY_FIELDS: usize = 12;

/// Opaque handles. Reference-counted by the library.
pub(crate) type RtcDevice = *mut c_void;
pub(crate) type RtcScene = *mut c_void;
pub(crate) type RtcGeometry = *mut c_void;

#[repr(C, align(16))]
#[derive(Clone, Copy)]
pub(crate) struct RtcRay {
    pub(crate) org: [f32; 3],
    pub(crate) tnear: f32,
    pub(crate) dir: [f32; 3],
    pub(crate) time: f32,
    pub(crate) tfar: f32,
    pub(crate) mask: u32,
    pub(crate) id: u32,
    pub(crate) flags: u32,
}

#[repr(C, align(16))]
#[derive(Clone, Copy)]
pub(crate) struct RtcHit {
    pub(crate) ng: [f32; 3],
    pub(crate) u: f32,
    pub(crate) v: f32,
    pub(crate) prim_id: u32,
    pub(crate) geom_id: u32,
    pub(crate) inst_id: u32,
    /// Written by 4.3 and later on every hit. A struct that ends before it is overrun.
    pub(crate) inst_prim_id: u32,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub(crate) struct RtcRayHit {
    pub(crate) ray: RtcRay,
    pub(crate) hit: RtcHit,
}

#[repr(C, align(64))]
#[derive(Clone, Copy)]
pub(crate) struct RtcRay16 {
    pub(crate) org: [[f32; 16]; 3],
    pub(crate) tnear: [f32; 16],
    pub(crate) dir: [[f32; 16]; 3],
    pub(crate) time: [f32; 16],
    pub(crate) tfar: [f32; 16],
    pub(crate) mask: [u32; 16],
    pub(crate) id: [u32; 16],
    pub(crate) flags: [u32; 16],
}

#[repr(C, align(64))]
#[derive(Clone, Copy)]
pub(crate) struct RtcHit16 {
    pub(crate) ng: [[f32; 16]; 3],
    pub(crate) u: [f32; 16],
    pub(crate) v: [f32; 16],
    pub(crate) prim_id: [u32; 16],
    pub(crate) geom_id: [u32; 16],
    pub(crate) inst_id: [u32; 16],
    pub(crate) inst_prim_id: [u32; 16],
}

#[repr(C)]
#[derive(Clone, Copy)]
pub(crate) struct RtcRayHit16 {
    pub(crate) ray: RtcRay16,
    pub(crate) hit: RtcHit16,
}

/// Which lanes of a packet are alive: −1 or 0.
#[repr(C, align(64))]
pub(crate) struct Valid16(pub(crate) [c_int; 16]);

#[repr(C, align(16))]
#[derive(Clone, Copy)]
pub(crate) struct RtcBounds {
    pub(crate) lower: [f32; 3],
    pub(crate) align0: f32,
    pub(crate) upper: [f32; 3],
    pub(crate) align1: f32,
}

/// The library makes its own where we pass NULL, and hands it to callbacks. Padded: `inst_prim_id` exists
/// since 4.3 only, so nothing here reads it.
#[repr(C, align(16))]
pub(crate) struct RtcRayQueryContext {
    pub(crate) inst_id: u32,
    pub(crate) inst_prim_id: u32,
    pub(crate) padding: [u32; 2],
}

/// `RTCIntersectArguments` and `RTCOccludedArguments` have one layout. `padding` covers the field that
/// builds with `RTC_MIN_WIDTH` append.
#[repr(C)]
pub(crate) struct RtcQueryArguments {
    pub(crate) flags: c_uint,
    pub(crate) feature_mask: c_uint,
    pub(crate) context: *mut RtcRayQueryContext,
    pub(crate) filter: *const c_void,
    pub(crate) callback: *const c_void,
    pub(crate) padding: [u32; 4],
}

impl RtcQueryArguments {
    #[inline]
    pub(crate) const fn new(coherent: bool) -> Self {
        Self {
            flags: if coherent {
                QUERY_COHERENT
            } else {
                QUERY_INCOHERENT
            },
            feature_mask: FEATURES_ALL,
            context: std::ptr::null_mut(),
            filter: std::ptr::null(),
            callback: std::ptr::null(),
            padding: [0; 4],
        }
    }
}

#[repr(C)]
pub(crate) struct RtcBoundsFunctionArguments {
    pub(crate) geometry_user_ptr: *mut c_void,
    pub(crate) prim_id: c_uint,
    pub(crate) time_step: c_uint,
    pub(crate) bounds_o: *mut RtcBounds,
}

/// Also `RTCOccludedFunctionNArguments`, whose `ray` stands where `rayhit` does.
#[repr(C)]
pub(crate) struct RtcQueryFunctionNArguments {
    pub(crate) valid: *mut c_int,
    pub(crate) geometry_user_ptr: *mut c_void,
    pub(crate) prim_id: c_uint,
    pub(crate) context: *mut RtcRayQueryContext,
    pub(crate) rayhit: *mut c_void,
    pub(crate) n: c_uint,
    pub(crate) geom_id: c_uint,
}

pub(crate) type BoundsFunction = unsafe extern "C" fn(*const RtcBoundsFunctionArguments);
pub(crate) type QueryFunction = unsafe extern "C" fn(*const RtcQueryFunctionNArguments);
/// (user pointer, bytes allocated or, negative, freed, whether that happened already) → whether to go on.
pub(crate) type MemoryMonitorFunction = unsafe extern "C" fn(*mut c_void, isize, bool) -> bool;
pub(crate) type ErrorFunction = unsafe extern "C" fn(*mut c_void, c_uint, *const c_char);

/// Fails the build where a struct differs from the C declaration.
macro_rules! assert_layout {
    ($($type:ty: $size:literal, $align:literal;)*) => {
        $(const _: () = assert!(size_of::<$type>() == $size && align_of::<$type>() == $align);)*
    };
}
assert_layout! {
    RtcRay: 48, 16;
    RtcHit: 48, 16;
    RtcRayHit: 96, 16;
    RtcRay16: 768, 64;
    RtcHit16: 576, 64;
    RtcRayHit16: 1344, 64;
    Valid16: 64, 64;
    RtcBounds: 32, 16;
    RtcRayQueryContext: 16, 16;
}
// These hold pointers. The project's targets are 64-bit.
#[cfg(target_pointer_width = "64")]
assert_layout! {
    RtcQueryArguments: 48, 8;
    RtcBoundsFunctionArguments: 24, 8;
    RtcQueryFunctionNArguments: 48, 8;
}
const _: () = assert!(std::mem::offset_of!(RtcRayHit, hit) == RAY_FIELDS * 4);
const _: () = assert!(std::mem::offset_of!(RtcRayHit16, hit) == RAY_FIELDS * 4 * 16);
const _: () = assert!(std::mem::offset_of!(RtcHit, inst_prim_id) == 32);

macro_rules! function_table {
    ($($field:ident = $name:literal: fn($($arg:ty),*) $(-> $ret:ty)?;)*) => {
        /// One function pointer per C function, valid as long as the library stays loaded: for ever.
        pub(crate) struct Api {
            $(pub(crate) $field: unsafe extern "C" fn($($arg),*) $(-> $ret)?,)*
        }

        impl Api {
            /// Looks every name up; the error is the first name that is missing.
            pub(crate) fn resolve(library: &libloading::Library) -> Result<Self, &'static str> {
                Ok(Self {
                    $($field: {
                        // SAFETY: the type is the C declaration of that name in every Embree 4; the version
                        // is checked before any function with a struct argument is called, and the
                        // pointer is used only while the library is loaded (it is never unloaded).
                        let symbol = unsafe {
                            library.get::<unsafe extern "C" fn($($arg),*) $(-> $ret)?>($name)
                        };
                        *symbol.map_err(|_| $name)?
                    },)*
                })
            }
        }
    };
}

function_table! {
    new_device = "rtcNewDevice": fn(*const c_char) -> RtcDevice;
    release_device = "rtcReleaseDevice": fn(RtcDevice);
    get_device_property = "rtcGetDeviceProperty": fn(RtcDevice, c_uint) -> isize;
    get_device_error = "rtcGetDeviceError": fn(RtcDevice) -> c_uint;
    set_device_error_function = "rtcSetDeviceErrorFunction": fn(RtcDevice, Option<ErrorFunction>, *mut c_void);
    set_device_memory_monitor_function = "rtcSetDeviceMemoryMonitorFunction":
        fn(RtcDevice, Option<MemoryMonitorFunction>, *mut c_void);
    new_scene = "rtcNewScene": fn(RtcDevice) -> RtcScene;
    release_scene = "rtcReleaseScene": fn(RtcScene);
    set_scene_flags = "rtcSetSceneFlags": fn(RtcScene, c_uint);
    set_scene_build_quality = "rtcSetSceneBuildQuality": fn(RtcScene, c_uint);
    attach_geometry = "rtcAttachGeometry": fn(RtcScene, RtcGeometry) -> c_uint;
    commit_scene = "rtcCommitScene": fn(RtcScene);
    get_scene_bounds = "rtcGetSceneBounds": fn(RtcScene, *mut RtcBounds);
    new_geometry = "rtcNewGeometry": fn(RtcDevice, c_uint) -> RtcGeometry;
    release_geometry = "rtcReleaseGeometry": fn(RtcGeometry);
    commit_geometry = "rtcCommitGeometry": fn(RtcGeometry);
    set_new_geometry_buffer = "rtcSetNewGeometryBuffer":
        fn(RtcGeometry, c_uint, c_uint, c_uint, usize, usize) -> *mut c_void;
    set_shared_geometry_buffer = "rtcSetSharedGeometryBuffer":
        fn(RtcGeometry, c_uint, c_uint, c_uint, *const c_void, usize, usize, usize);
    set_geometry_user_primitive_count = "rtcSetGeometryUserPrimitiveCount": fn(RtcGeometry, c_uint);
    set_geometry_user_data = "rtcSetGeometryUserData": fn(RtcGeometry, *mut c_void);
    set_geometry_bounds_function = "rtcSetGeometryBoundsFunction":
        fn(RtcGeometry, Option<BoundsFunction>, *mut c_void);
    set_geometry_intersect_function = "rtcSetGeometryIntersectFunction": fn(RtcGeometry, Option<QueryFunction>);
    set_geometry_occluded_function = "rtcSetGeometryOccludedFunction": fn(RtcGeometry, Option<QueryFunction>);
    set_geometry_instanced_scene = "rtcSetGeometryInstancedScene": fn(RtcGeometry, RtcScene);
    set_geometry_transform = "rtcSetGeometryTransform": fn(RtcGeometry, c_uint, c_uint, *const c_void);
    intersect1 = "rtcIntersect1": fn(RtcScene, *mut RtcRayHit, *mut RtcQueryArguments);
    occluded1 = "rtcOccluded1": fn(RtcScene, *mut RtcRay, *mut RtcQueryArguments);
    intersect16 = "rtcIntersect16": fn(*const c_int, RtcScene, *mut RtcRayHit16, *mut RtcQueryArguments);
    occluded16 = "rtcOccluded16": fn(*const c_int, RtcScene, *mut RtcRay16, *mut RtcQueryArguments);
}
