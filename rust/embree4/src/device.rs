//! The device: Embree's settings, its worker threads and its errors.

use std::cell::RefCell;
use std::ffi::{CString, c_char, c_uint, c_void};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicIsize, Ordering};

use crate::ffi::{Api, RtcDevice};
use crate::load::{self, Library};
use crate::{EmbreeError, LoadError};

/// Instruction sets that Embree can be held to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Isa {
    /// 128-bit vectors.
    Sse42,
    /// 256-bit vectors.
    Avx2,
    /// 512-bit vectors.
    Avx512,
}

impl Isa {
    /// Reads `PSSFLOW_ISA` (`avx512`, `avx2` or `sse4.2`; unset or empty: no choice).
    ///
    /// # Errors
    /// [`LoadError::UnknownIsa`] for any other value.
    pub fn from_env() -> Result<Option<Self>, LoadError> {
        match std::env::var_os("PSSFLOW_ISA") {
            None => Ok(None),
            Some(value) => Self::parse(&value.to_string_lossy()),
        }
    }

    fn parse(value: &str) -> Result<Option<Self>, LoadError> {
        match value {
            "" => Ok(None),
            "sse4.2" => Ok(Some(Self::Sse42)),
            "avx2" => Ok(Some(Self::Avx2)),
            "avx512" => Ok(Some(Self::Avx512)),
            _ => Err(LoadError::UnknownIsa {
                value: value.to_owned(),
            }),
        }
    }

    /// The name in `PSSFLOW_ISA`, and in messages.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sse42 => "sse4.2",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }

    /// The name in Embree's configuration string, whose scanner is kinder to names without a dot.
    const fn embree_name(self) -> &'static str {
        match self {
            Self::Sse42 => "sse42",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }

    /// Embree takes the setting on trust and would die of SIGILL, so it is checked here.
    #[cfg(target_arch = "x86_64")]
    fn is_supported(self) -> bool {
        match self {
            Self::Sse42 => is_x86_feature_detected!("sse4.2"),
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512cd")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512vl")
            }
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn is_supported(self) -> bool {
        false
    }
}

/// How to make a [`Device`]. The default lets Embree choose everything and ignores `PSSFLOW_ISA`.
#[derive(Clone, Debug, Default)]
pub struct DeviceOptions {
    /// Library files, or directories to search, tried after the system's own.
    pub candidates: Vec<PathBuf>,
    /// Threads that build BVHs; 0 means one per core. Tracing uses the caller's threads.
    pub threads: usize,
    /// Instruction set; `None` means the best that library and processor share.
    pub isa: Option<Isa>,
}

/// An Embree device. Cloning is cheap and shares it; scenes keep it alive.
#[derive(Clone)]
pub struct Device(Arc<Handle>);

struct Handle {
    raw: RtcDevice,
    library: &'static Library,
    /// Bytes that the device holds; Embree's monitor points here.
    memory: Box<AtomicIsize>,
}

// SAFETY: Embree's device functions may be called from any thread, and the handle is released once, by the
// last owner. Errors are collected per thread (see `LAST_ERROR`).
unsafe impl Send for Handle {}
// SAFETY: as above; no method hands out access that isn't synchronised inside the library.
unsafe impl Sync for Handle {}

impl Drop for Handle {
    fn drop(&mut self) {
        // SAFETY: made by rtcNewDevice, released once. Scenes hold references of their own.
        unsafe { (self.library.api.release_device)(self.raw) }
    }
}

thread_local! {
    // The library reports an error to the callback on the thread that made the failing call.
    static LAST_ERROR: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Embree's error callback. Keeps the first error since the last look: later ones follow from it.
unsafe extern "C" fn record_error(_: *mut c_void, code: c_uint, message: *const c_char) {
    // SAFETY: Embree passes null or a NUL-terminated string.
    let message = unsafe { load::text(message) };
    // While a thread ends its slot may be gone, and while it is read it may be borrowed: then the message
    // is dropped, for a callback must not panic.
    let _ = LAST_ERROR.try_with(|slot| {
        if let Ok(mut slot) = slot.try_borrow_mut() {
            slot.get_or_insert_with(|| match message.is_empty() {
                true => load::error_name(code).to_owned(),
                false => format!("{} ({message})", load::error_name(code)),
            });
        }
    });
}

/// Embree's memory monitor: counts, and always lets it go on.
unsafe extern "C" fn count_memory(counter: *mut c_void, bytes: isize, _done: bool) -> bool {
    // SAFETY: the pointer is the counter of the device's `Handle`, which outlives the device.
    let counter = unsafe { &*counter.cast::<AtomicIsize>() };
    counter.fetch_add(bytes, Ordering::Relaxed);
    true
}

impl Device {
    /// A device on the library found in the usual places, with `PSSFLOW_ISA` honoured.
    ///
    /// # Errors
    /// [`LoadError`], which says everywhere it looked and how to install Embree.
    ///
    /// # Examples
    /// ```no_run
    /// let device = embree4::Device::new()?;
    /// assert_eq!(device.version().0, 4);
    /// # Ok::<(), embree4::LoadError>(())
    /// ```
    pub fn new() -> Result<Self, LoadError> {
        Self::with_candidates(&[])
    }

    /// As [`Device::new`], with further library files or directories (such as Python's `site-packages`) to
    /// try after the system's.
    ///
    /// # Errors
    /// [`LoadError`], which says everywhere it looked and how to install Embree.
    pub fn with_candidates(candidates: &[PathBuf]) -> Result<Self, LoadError> {
        Self::with_options(&DeviceOptions {
            candidates: candidates.to_vec(),
            threads: 0,
            isa: Isa::from_env()?,
        })
    }

    /// A device made exactly as told.
    ///
    /// # Errors
    /// [`LoadError`]: no library, an instruction set that this processor lacks, or Embree's own refusal.
    pub fn with_options(options: &DeviceOptions) -> Result<Self, LoadError> {
        if let Some(isa) = options.isa.filter(|isa| !isa.is_supported()) {
            return Err(LoadError::UnsupportedIsa { isa: isa.name() });
        }
        let library = load::library(&options.candidates)?;
        let mut config = String::from("verbose=0");
        if options.threads > 0 {
            config += &format!(",threads={}", options.threads);
        }
        if let Some(isa) = options.isa {
            config += &format!(",isa={}", isa.embree_name());
        }
        // Embree reads up to the NUL, so one must be there; none can be inside.
        let text = CString::new(config.as_str()).unwrap_or_default();
        // SAFETY: `text` is NUL-terminated and outlives the call.
        let raw = unsafe { (library.api.new_device)(text.as_ptr()) };
        if raw.is_null() {
            return Err(LoadError::Device {
                library: library.path.clone(),
                config,
                message: load::last_error(&library.api, raw),
            });
        }
        // SAFETY: `raw` is live; the callback is a function of this program and needs no user pointer.
        unsafe {
            (library.api.set_device_error_function)(raw, Some(record_error), std::ptr::null_mut())
        };
        let memory = Box::new(AtomicIsize::new(0));
        // SAFETY: `raw` is live; the counter has a fixed address and is freed after the device, see `Handle::drop`.
        unsafe {
            (library.api.set_device_memory_monitor_function)(
                raw,
                Some(count_memory),
                std::ptr::from_ref::<AtomicIsize>(&memory).cast_mut().cast(),
            );
        }
        Ok(Self(Arc::new(Handle {
            raw,
            library,
            memory,
        })))
    }

    /// Version of the library: major, minor, patch.
    pub fn version(&self) -> (usize, usize, usize) {
        let version = self.0.library.version;
        (version / 10_000, version / 100 % 100, version % 100)
    }

    /// Bytes that Embree has allocated on this device and not freed yet: BVHs, not the arrays that it reads in place.
    pub fn memory(&self) -> usize {
        usize::try_from(self.0.memory.load(Ordering::Relaxed)).unwrap_or(0)
    }

    /// The file that was loaded, as it was named to the system's loader.
    pub fn library(&self) -> &str {
        &self.0.library.path
    }

    pub(crate) fn raw(&self) -> RtcDevice {
        self.0.raw
    }

    pub(crate) fn api(&self) -> &'static Api {
        &self.0.library.api
    }

    pub(crate) fn is_same(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }

    /// Forgets errors that this thread has seen, so that [`Device::check`] speaks of what follows.
    pub(crate) fn clear(&self) {
        LAST_ERROR.with(|slot| slot.borrow_mut().take());
    }

    /// The error that this thread's calls since [`Device::clear`] have raised, if any.
    pub(crate) fn check(&self, call: &'static str) -> Result<(), EmbreeError> {
        match LAST_ERROR.with(|slot| slot.borrow_mut().take()) {
            Some(message) => Err(EmbreeError::Library { call, message }),
            None => Ok(()),
        }
    }
}

impl std::fmt::Debug for Device {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (major, minor, patch) = self.version();
        write!(
            f,
            "Device(Embree {major}.{minor}.{patch}, {})",
            self.library()
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instruction_sets_have_three_names_and_the_rest_is_refused() {
        assert_eq!(Isa::parse(""), Ok(None));
        for isa in [Isa::Sse42, Isa::Avx2, Isa::Avx512] {
            assert_eq!(Isa::parse(isa.name()), Ok(Some(isa)));
        }
        let error = Isa::parse("avx3")
            .err()
            .map(|error| error.to_string())
            .unwrap_or_default();
        assert_eq!(
            error,
            "PSSFLOW_ISA = \"avx3\" is not an instruction set (known: avx512, avx2, sse4.2). Unset it to let Embree choose"
        );
    }
}
