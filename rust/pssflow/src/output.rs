//! Images on disk: OpenEXR, one part, 32-bit float, layers by dotted channel names (`R`, `variance.R`), which
//! is what Mitsuba reads. Written beside the target and renamed, so that no half-written file is ever seen.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use exr::prelude::{
    AnyChannel, AnyChannels, FlatSamples, Image, ReadChannels, ReadLayers, WritableImage,
};

use crate::error::RenderError;

/// A layer: its name (empty for the image itself) and (height, width, 3) values.
pub type Layer<'a> = (&'a str, &'a [f32]);

/// Writes the layers of an image of `width` × `height` pixels.
///
/// # Errors
/// [`RenderError::Write`], naming the file; nothing is left behind.
pub fn write_exr(
    path: &Path,
    width: u32,
    height: u32,
    layers: &[Layer<'_>],
) -> Result<(), RenderError> {
    let pixels = width as usize * height as usize;
    let mut channels = exr::prelude::SmallVec::<[AnyChannel<FlatSamples>; 4]>::new();
    for (name, values) in layers {
        if values.len() != 3 * pixels {
            return Err(RenderError::Write {
                path: path.to_owned(),
                reason: format!(
                    "layer {name:?} has {} values, not {}",
                    values.len(),
                    3 * pixels
                ),
            });
        }
        for (c, channel) in ["R", "G", "B"].into_iter().enumerate() {
            let full = if name.is_empty() {
                channel.to_owned()
            } else {
                format!("{name}.{channel}")
            };
            let samples = values.iter().skip(c).step_by(3).copied().collect();
            channels.push(AnyChannel::new(full.as_str(), FlatSamples::F32(samples)));
        }
    }
    let image = Image::from_channels(
        (width as usize, height as usize),
        AnyChannels::sort(channels),
    );
    write_beside(path, |part| {
        image.write().to_file(part).map_err(|e| e.to_string())
    })
}

/// Channels of an image by their full names (`R`, `variance.R`), each of `width` × `height` values.
#[derive(Clone, Debug, PartialEq)]
pub struct Channels {
    /// Columns.
    pub width: usize,
    /// Names and values, row by row from the top.
    pub values: Vec<(String, Vec<f32>)>,
}

/// Reads the first part of an EXR, on the calling thread alone.
///
/// # Errors
/// [`RenderError::Read`], naming the file: it is none, is damaged, or has channels of several sizes.
pub fn read_exr(path: &Path) -> Result<Channels, RenderError> {
    let error = |reason: String| RenderError::Read {
        path: path.to_owned(),
        reason,
    };
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .non_parallel()
        .from_file(path)
        .map_err(|e| error(e.to_string()))?;
    let layer = image.layer_data;
    let pixels = layer.size.area();
    let mut values = Vec::new();
    for channel in layer.channel_data.list {
        if channel.sample_data.len() != pixels {
            return Err(error(format!(
                "channel {} has {} values for {pixels} pixels",
                channel.name,
                channel.sample_data.len()
            )));
        }
        let samples = channel.sample_data.values_as_f32().collect();
        values.push((channel.name.to_string(), samples));
    }
    Ok(Channels {
        width: layer.size.width(),
        values,
    })
}

/// Lets `write` fill a file next to `path`, then renames it; removes it where that fails.
///
/// # Errors
/// [`RenderError::Write`].
pub fn write_beside(
    path: &Path,
    write: impl FnOnce(&Path) -> Result<(), String>,
) -> Result<(), RenderError> {
    let error = |reason: String| RenderError::Write {
        path: path.to_owned(),
        reason,
    };
    let name = path
        .file_name()
        .ok_or_else(|| error("it names no file".to_owned()))?;
    // Neither another process nor another thread of this one writes to the same file.
    static SERIAL: AtomicU64 = AtomicU64::new(0);
    let mut part = PathBuf::from(path);
    part.set_file_name(format!(
        ".{}.{}.{}.part",
        name.to_string_lossy(),
        std::process::id(),
        SERIAL.fetch_add(1, Ordering::Relaxed)
    ));
    let done = write(&part).and_then(|()| fs::rename(&part, path).map_err(|e| e.to_string()));
    done.map_err(|reason| {
        // The first failure is what the user needs to know; this one can only repeat it.
        let _ = fs::remove_file(&part);
        error(reason)
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn layers_come_back_by_their_dotted_names() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("image.exr");
        let values: Vec<f32> = (0..24).map(|i| i as f32).collect();
        write_exr(&path, 4, 2, &[("", &values), ("variance", &values)]).unwrap();
        let read = read_exr(&path).unwrap();
        assert_eq!(read.width, 4);
        for prefix in ["", "variance."] {
            for (i, channel) in ["R", "G", "B"].into_iter().enumerate() {
                let name = format!("{prefix}{channel}");
                let (_, found) = read.values.iter().find(|(n, _)| *n == name).unwrap();
                let want = values.iter().skip(i).step_by(3);
                assert!(found.iter().eq(want), "{name}");
            }
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_is_no_exr_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("image.exr");
        write_exr(&path, 4, 2, &[("", &[0.5; 24])]).unwrap();
        let whole = fs::read(&path).unwrap();
        for bytes in [&b"text"[..], &[], &whole[..whole.len() - 9]] {
            fs::write(&path, bytes).unwrap();
            let error = read_exr(&path).unwrap_err().to_string();
            assert!(
                error.contains("image.exr") && !error.contains('\n'),
                "{error}"
            );
        }
    }

    #[test]
    fn a_failed_write_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("no/such/image.exr");
        let error = write_exr(&path, 1, 1, &[("", &[0.0; 3])]).unwrap_err();
        assert!(error.to_string().contains("no/such/image.exr"), "{error}");
        let path = folder.path().join("half");
        assert!(
            write_beside(&path, |p| {
                fs::write(p, "x").unwrap();
                Err("disk full".into())
            })
            .is_err()
        );
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
