//! Guides on disk.

use std::fs;

use pss_guide::{Fit, GuideError, Header, load, load_unchecked, registry};

use crate::common::{self, fit_small, header};

#[test]
fn a_saved_guide_is_the_same_guide() {
    let folder = tempfile::tempdir().unwrap();
    for spec in registry() {
        let guide = &fit_small(spec.name, 5).guide;
        let path = folder.path().join(spec.name);
        guide.save(&path, &header()).unwrap();
        let (loaded, found) = load_unchecked(&path).unwrap();
        assert_eq!(found, header());
        assert_eq!(loaded.describe(), guide.describe());
        assert_eq!(loaded.mass_outside(), guide.mass_outside());
        assert_eq!(
            common::fingerprint(&**guide),
            common::fingerprint(&*load(&path, &header()).unwrap()),
            "{}",
            spec.name
        );

        let again = folder.path().join("again");
        loaded.save(&again, &found).unwrap();
        let (a, b) = (fs::read(&path).unwrap(), fs::read(&again).unwrap());
        assert_eq!(a.len(), b.len());
        assert_eq!(
            fs::read_dir(folder.path())
                .unwrap()
                .filter(|e| {
                    e.as_ref()
                        .unwrap()
                        .file_name()
                        .to_string_lossy()
                        .contains("partial")
                })
                .count(),
            0
        );
        fs::remove_file(again).unwrap();
    }
}

/// A guide whose file is small.
fn small(name: &str) -> Fit {
    let (dims, n) = if common::is_whole(name) {
        (2, 2000)
    } else {
        (5, 500)
    };
    common::fit_with(name, dims, n, common::epochs(name, 1), 1)
}

#[test]
fn truncated_and_damaged_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for spec in registry() {
        let path = folder.path().join("guide");
        small(spec.name).guide.save(&path, &header()).unwrap();
        let whole = fs::read(&path).unwrap();
        let refuse = |bytes: &[u8], what: &str| {
            fs::write(&path, bytes).unwrap();
            let error = load(&path, &header()).unwrap_err();
            let text = error.to_string();
            assert!(
                matches!(error, GuideError::Corrupt { .. }) && !text.contains('\n'),
                "{what}: {text}"
            );
        };
        let lengths = (0..64)
            .chain((64..whole.len()).step_by(1499))
            .chain(whole.len() - 16..whole.len());
        for length in lengths {
            refuse(
                &whole[..length],
                &format!("{} cut to {length} bytes", spec.name),
            );
        }
        let mut longer = whole.clone();
        longer.push(0);
        refuse(&longer, "one byte too many");
        for at in (whole.len() / 2..whole.len()).step_by(4999) {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x40;
            refuse(&bytes, &format!("{} with byte {at} flipped", spec.name));
        }
        // In the header a flip may hit a name or a hash: any error will do, but none may pass as sound.
        for at in (0..4000.min(whole.len())).step_by(37) {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x01;
            fs::write(&path, &bytes).unwrap();
            assert!(
                load(&path, &header()).is_err(),
                "{} with byte {at} flipped",
                spec.name
            );
        }
    }
}

#[test]
fn guides_of_other_renders_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for spec in registry() {
        let path = folder.path().join("guide");
        small(spec.name).guide.save(&path, &header()).unwrap();
        let text = |expected: &Header| load(&path, expected).unwrap_err().to_string();
        let at = path.display();
        assert_eq!(
            text(&Header {
                columns_hash: "other".into(),
                ..header()
            }),
            format!(
                "guide file {at}: it was fitted for columns columns-1, but this render has other. Fit the guide for this render"
            )
        );
        assert_eq!(
            text(&Header {
                scene_hash: "other".into(),
                ..header()
            }),
            format!(
                "guide file {at}: it was fitted for scene scene-1, but this render has other. Fit the guide for this render"
            )
        );
        let mut bytes = fs::read(&path).unwrap();
        let version = b"\"version\":\"1\"";
        let found = bytes
            .windows(version.len())
            .position(|w| w == version)
            .unwrap();
        bytes[found + version.len() - 2] = b'7';
        fs::write(&path, bytes).unwrap();
        assert_eq!(
            text(&header()),
            format!(
                "guide file {at}: format version 7, but this build reads version 1. Fit and save the guide again"
            )
        );
        let missing = load(&folder.path().join("none"), &header()).unwrap_err();
        assert!(matches!(missing, GuideError::Io { .. }), "{missing}");
    }
}
