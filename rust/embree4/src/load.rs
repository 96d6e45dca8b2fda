//! Finds the library, once per process, and convinces itself that it is what the rest expects.
//!
//! Order: the file named by `EMBREE4_LIBRARY` (alone, if set: a wrong setting must not pass unnoticed);
//! the system's; the caller's candidates; the directories of [`add_search_dirs`]; those of
//! `PSSFLOW_EMBREE_DIRS`. A candidate that fails is noted with its reason and the next one is tried. The
//! library is never unloaded, because its threads may still be running when the last device is gone.

use std::ffi::CStr;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use crate::LoadError;
use crate::ffi::{self, Api};

/// Embree 4, loaded for the rest of the process.
pub(crate) struct Library {
    pub(crate) api: Api,
    /// The file's name, as it was opened.
    pub(crate) path: String,
    /// `major·10000 + minor·100 + patch`.
    pub(crate) version: usize,
}

static LOADED: Mutex<Option<&'static Library>> = Mutex::new(None);
static SEARCH_DIRS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Names under which Linux distributions and Embree's own installer keep the library.
const SYSTEM_NAMES: [&str; 2] = ["libembree4.so.4", "libembree4.so"];

/// Adds directories in which later calls of [`Device::new`](crate::Device::new) look for Embree, after the
/// system's own places. Meant for Python's `site-packages`: the wheel `embreex` keeps its copy under
/// `embreex.libs/`, which is searched too. Without effect once the library is loaded.
pub fn add_search_dirs(dirs: &[PathBuf]) {
    let mut known = SEARCH_DIRS.lock().unwrap_or_else(PoisonError::into_inner);
    for dir in dirs {
        if !known.contains(dir) {
            known.push(dir.clone());
        }
    }
}

/// The process's library; loads it on the first call that succeeds.
pub(crate) fn library(candidates: &[PathBuf]) -> Result<&'static Library, LoadError> {
    let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(library) = *loaded {
        return Ok(library);
    }
    let named = std::env::var_os("EMBREE4_LIBRARY").filter(|value| !value.is_empty());
    let library = find(named.map(PathBuf::from), candidates)?;
    let library: &'static Library = Box::leak(Box::new(library));
    *loaded = Some(library);
    Ok(library)
}

/// The search itself, without the process-wide memory.
fn find(named: Option<PathBuf>, candidates: &[PathBuf]) -> Result<Library, LoadError> {
    let mut looked = Vec::new();
    for path in places(named, candidates, &mut looked) {
        match open(&path) {
            Ok(library) => return Ok(library),
            Err(reason) => looked.push(format!("{} ({reason})", path.display())),
        }
    }
    Err(LoadError::NotFound {
        looked: looked.join("; "),
    })
}

/// Every file to try, in order; directories that hold none are noted in `looked`.
fn places(
    named: Option<PathBuf>,
    candidates: &[PathBuf],
    looked: &mut Vec<String>,
) -> Vec<PathBuf> {
    if let Some(path) = named {
        looked.push("EMBREE4_LIBRARY is set, so nowhere else".to_owned());
        return vec![path];
    }
    let mut paths: Vec<PathBuf> = SYSTEM_NAMES.iter().map(PathBuf::from).collect();
    let mut dirs = SEARCH_DIRS
        .lock()
        .unwrap_or_else(PoisonError::into_inner)
        .clone();
    if let Some(more) = std::env::var_os("PSSFLOW_EMBREE_DIRS") {
        dirs.extend(std::env::split_paths(&more).filter(|dir| !dir.as_os_str().is_empty()));
    }
    for place in candidates.iter().chain(&dirs) {
        if place.is_dir() {
            let found = libraries_in(place);
            if found.is_empty() {
                looked.push(format!(
                    "{} (no libembree4*.so* in it or its embreex.libs/)",
                    place.display()
                ));
            }
            paths.extend(found);
        } else {
            paths.push(place.clone());
        }
    }
    paths
}

/// `libembree4*.so*` in `dir` and in `dir/embreex.libs`, sorted so that each run finds the same one.
fn libraries_in(dir: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for dir in [dir.to_path_buf(), dir.join("embreex.libs")] {
        let Ok(entries) = std::fs::read_dir(dir) else {
            continue;
        };
        found.extend(entries.flatten().map(|entry| entry.path()).filter(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with("libembree4") && name.contains(".so")
        }));
    }
    found.sort();
    found
}

/// Opens one file and checks that it is Embree 4 with the layout of `ffi.rs`.
fn open(path: &Path) -> Result<Library, String> {
    // SAFETY: loading runs the library's initialisers. The file is one that the user, the system or the
    // `embreex` wheel offers as Embree; nothing more can be known before it is open.
    let library =
        unsafe { libloading::Library::new(path) }.map_err(|error| loader_reason(path, &error))?;
    let api = Api::resolve(&library)
        .map_err(|name| format!("not an Embree 4 library: it has no function {name}"))?;
    // From here on the library may own threads, so that unloading it would crash.
    std::mem::forget(library);

    // SAFETY: an empty configuration, NUL-terminated.
    let device = unsafe { (api.new_device)(c"threads=1".as_ptr()) };
    if device.is_null() {
        return Err(format!("made no device: {}", last_error(&api, device)));
    }
    // SAFETY: `device` is live; the property exists in all versions.
    let version = unsafe { (api.get_device_property)(device, ffi::PROPERTY_VERSION) };
    let checked = if (40_000..50_000).contains(&version) {
        check_layout(&api, device)
    } else {
        Err(format!(
            "its version is {version}, but 40000 <= version < 50000 is needed"
        ))
    };
    // SAFETY: `device` is live and this is its only reference.
    unsafe { (api.release_device)(device) };
    checked?;
    Ok(Library {
        api,
        path: path.display().to_string(),
        version: version.unsigned_abs(),
    })
}

/// Traces one ray through an instance of a triangle and looks at the bytes of the hit.
///
/// An Embree built with more than one instance level has a larger `RTCHit`, which no version number tells:
/// its packets would overrun ours. It writes further than byte 84 of the ray-hit; a build with one level
/// doesn't.
fn check_layout(api: &Api, device: ffi::RtcDevice) -> Result<(), String> {
    #[repr(C)]
    struct Probe {
        rayhit: ffi::RtcRayHit,
        guard: [u8; 160],
    }
    const USED: usize = 84;
    const FILL: u8 = 0xA5;

    let positions: [f32; 9] = [-1.0, -1.0, 1.0, 3.0, -1.0, 1.0, -1.0, 3.0, 1.0];
    let identity: [f32; 12] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let mut probe = Probe {
        rayhit: crate::query::rayhit(&crate::Ray::new([0.0; 3], [0.0, 0.0, 1.0])),
        guard: [FILL; 160],
    };
    let bytes = (&raw mut probe).cast::<u8>();
    // SAFETY: all handles are created and released here, in Embree's documented order. The vertex buffer
    // has room for three vertices and the index buffer for one triangle, and they are filled before the
    // commit. `probe` is 16-byte aligned and larger than any RTCRayHit; `bytes` stays inside it.
    let intact = unsafe {
        let inner = (api.new_scene)(device);
        let mesh = (api.new_geometry)(device, ffi::GEOMETRY_TRIANGLE);
        let vertices =
            (api.set_new_geometry_buffer)(mesh, ffi::BUFFER_VERTEX, 0, ffi::FORMAT_FLOAT3, 12, 3);
        let indices =
            (api.set_new_geometry_buffer)(mesh, ffi::BUFFER_INDEX, 0, ffi::FORMAT_UINT3, 12, 1);
        if vertices.is_null() || indices.is_null() {
            return Err(format!(
                "made no geometry buffer: {}",
                last_error(api, device)
            ));
        }
        positions
            .as_ptr()
            .copy_to_nonoverlapping(vertices.cast(), 9);
        [0u32, 1, 2]
            .as_ptr()
            .copy_to_nonoverlapping(indices.cast(), 3);
        (api.commit_geometry)(mesh);
        (api.attach_geometry)(inner, mesh);
        (api.release_geometry)(mesh);
        (api.commit_scene)(inner);

        let outer = (api.new_scene)(device);
        let instance = (api.new_geometry)(device, ffi::GEOMETRY_INSTANCE);
        (api.set_geometry_instanced_scene)(instance, inner);
        (api.set_geometry_transform)(
            instance,
            0,
            ffi::FORMAT_FLOAT3X4_ROW_MAJOR,
            identity.as_ptr().cast(),
        );
        (api.commit_geometry)(instance);
        (api.attach_geometry)(outer, instance);
        (api.release_geometry)(instance);
        (api.commit_scene)(outer);

        for byte in USED..size_of::<Probe>() {
            bytes.add(byte).write(FILL);
        }
        (api.intersect1)(outer, &raw mut probe.rayhit, std::ptr::null_mut());
        (api.release_scene)(outer);
        (api.release_scene)(inner);
        (USED..size_of::<Probe>()).all(|byte| bytes.add(byte).read() == FILL)
    };
    let hit = probe.rayhit.hit;
    if intact && (hit.geom_id, hit.prim_id, hit.inst_id) == (0, 0, 0) {
        Ok(())
    } else {
        Err(
            "its RTCHit has another layout than Embree's default build (one instance level)"
                .to_owned(),
        )
    }
}

/// Embree's name for the last error of `device` on this thread; a null device asks for the one that
/// prevented a device.
pub(crate) fn last_error(api: &Api, device: ffi::RtcDevice) -> String {
    // SAFETY: null or live, as the function allows.
    let code = unsafe { (api.get_device_error)(device) };
    error_name(code).to_owned()
}

/// What an `RTCError` means.
pub(crate) fn error_name(code: u32) -> &'static str {
    match code {
        0 => "no error recorded",
        1 => "unknown error",
        2 => "invalid argument",
        3 => "invalid operation",
        4 => "out of memory",
        5 => "unsupported processor",
        6 => "cancelled",
        _ => "error of an unknown kind",
    }
}

/// Copies a C string of Embree's; empty for null.
///
/// # Safety
/// `text` is null or points to a NUL-terminated string.
pub(crate) unsafe fn text(text: *const std::ffi::c_char) -> String {
    if text.is_null() {
        return String::new();
    }
    // SAFETY: the caller's promise.
    unsafe { CStr::from_ptr(text) }
        .to_string_lossy()
        .into_owned()
}

/// The dynamic loader's own words, on one line and without the path that they begin with.
fn loader_reason(path: &Path, error: &libloading::Error) -> String {
    let text = match std::error::Error::source(error) {
        Some(source) => source.to_string(),
        None => error.to_string(),
    };
    let line = text.lines().next().unwrap_or_default();
    let prefix = format!("{}: ", path.display());
    line.strip_prefix(&prefix).unwrap_or(line).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reason(path: &str) -> String {
        match find(Some(PathBuf::from(path)), &[]) {
            Ok(_) => String::from("loaded"),
            Err(error) => error.to_string(),
        }
    }

    #[test]
    fn a_foreign_library_is_refused_by_the_function_it_lacks() {
        let text = reason("libc.so.6");
        assert!(
            text.contains("libc.so.6 (not an Embree 4 library: it has no function rtcNewDevice)"),
            "{text}"
        );
        assert!(
            text.contains("pip install embreex") && text.contains("apt install libembree4-4"),
            "{text}"
        );
        assert_eq!(text.lines().count(), 1, "{text}");
    }

    #[test]
    fn a_missing_library_is_named_with_the_way_to_get_one() {
        let text = reason("/nowhere/libembree4.so.4");
        assert!(
            text.contains("/nowhere/libembree4.so.4 (") && text.contains("EMBREE4_LIBRARY is set"),
            "{text}"
        );
        assert_eq!(text.lines().count(), 1, "{text}");
    }

    #[test]
    fn directories_without_a_library_are_listed() {
        let mut looked = Vec::new();
        let dir = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("src");
        let paths = places(None, std::slice::from_ref(&dir), &mut looked);
        assert_eq!(paths[..2], SYSTEM_NAMES.map(PathBuf::from));
        assert!(
            looked[0].starts_with(&*dir.to_string_lossy()) && looked[0].contains("embreex.libs"),
            "{looked:?}"
        );
    }
}
