//! Guides on disk: safetensors, with who and what in the metadata.
//!
//! | key            | meaning                                        |
//! |----------------|------------------------------------------------|
//! | `format`       | `pssflow-guide`                                |
//! | `version`      | [`FORMAT_VERSION`]                             |
//! | `guide`        | name in the registry                           |
//! | `columns_hash` | table of columns of u that it was fitted for   |
//! | `scene_hash`   | scene that it was fitted for                   |
//! | `config`       | JSON: dims, options and facts of the guide     |
//! | `blake3`       | hash of `guide`, `config` and all tensor bytes |

use std::collections::HashMap;
use std::fs;
use std::io::Write as _;
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde_json::Value;

use crate::composite::Composite;
use crate::{Guide, GuideError, Header, registry};

/// Version of the file format that this build writes and reads.
pub const FORMAT_VERSION: u32 = 1;

const FORMAT: &str = "pssflow-guide";

/// What a guide puts into its file.
#[derive(Debug, Default)]
pub struct Contents {
    /// Name in the registry; of a composite, the names of its factors joined by `+`.
    pub guide: String,
    /// Dimensions, options and facts.
    pub config: Value,
    /// Name, shape, values.
    pub tensors: Vec<(String, Vec<usize>, Vec<f32>)>,
    /// The same for whole numbers.
    pub words: Vec<(String, Vec<usize>, Vec<u32>)>,
}

/// Reads a guide that was fitted for `expected`.
///
/// # Errors
/// [`GuideError::Io`], [`GuideError::Corrupt`] (truncated, damaged, or no guide at all),
/// [`GuideError::Version`], [`GuideError::UnknownGuide`], and [`GuideError::Foreign`] if it was fitted for
/// other columns or another scene.
pub fn load(path: &Path, expected: &Header) -> Result<Box<dyn Guide>, GuideError> {
    let (guide, header) = load_unchecked(path)?;
    let check = |what, found: &str, expected: &str| {
        if found == expected {
            return Ok(());
        }
        Err(GuideError::Foreign {
            path: path.to_owned(),
            what,
            found: found.to_owned(),
            expected: expected.to_owned(),
        })
    };
    check("columns", &header.columns_hash, &expected.columns_hash)?;
    check("scene", &header.scene_hash, &expected.scene_hash)?;
    Ok(guide)
}

/// Reads a guide whatever it was fitted for, and says what that was.
///
/// # Errors
/// Those of [`load`], but for [`GuideError::Foreign`].
pub fn load_unchecked(path: &Path) -> Result<(Box<dyn Guide>, Header), GuideError> {
    let (header, contents) = read(path)?;
    let corrupt = |what| GuideError::Corrupt {
        path: path.to_owned(),
        what,
    };
    let guide = if contents.guide.contains('+') {
        for name in contents.guide.split('+') {
            registry::find(name)?;
        }
        Composite::restore(contents).map_err(corrupt)?
    } else {
        let spec = registry::find(&contents.guide)?;
        (spec.restore)(contents).map_err(corrupt)?
    };
    Ok((guide, header))
}

fn checksum(guide: &str, config: &str, tensors: &SafeTensors<'_>, order: &mut [String]) -> String {
    let mut hash = blake3::Hasher::new();
    let mut field = |bytes: &[u8]| {
        // Lengths keep the end of one field from passing as the start of the next.
        hash.update(&(bytes.len() as u64).to_le_bytes());
        hash.update(bytes);
    };
    field(guide.as_bytes());
    field(config.as_bytes());
    order.sort_unstable();
    for name in order {
        field(name.as_bytes());
        if let Ok(tensor) = tensors.tensor(name) {
            field(tensor.data());
        }
    }
    hash.finalize().to_hex().to_string()
}

fn serialise(contents: &Contents, metadata: HashMap<String, String>) -> Result<Vec<u8>, String> {
    type Raw<'a> = (&'a str, &'a [usize], Dtype, Vec<u8>);
    let reals = contents.tensors.iter().map(|(name, shape, v)| -> Raw<'_> {
        let bytes = v.iter().flat_map(|x| x.to_le_bytes()).collect();
        (name, shape, Dtype::F32, bytes)
    });
    let words = contents.words.iter().map(|(name, shape, v)| -> Raw<'_> {
        let bytes = v.iter().flat_map(|x| x.to_le_bytes()).collect();
        (name, shape, Dtype::U32, bytes)
    });
    let raw: Vec<Raw<'_>> = reals.chain(words).collect();
    let mut views = Vec::with_capacity(raw.len());
    for (name, shape, dtype, bytes) in &raw {
        let view = TensorView::new(*dtype, shape.to_vec(), bytes).map_err(|e| e.to_string())?;
        views.push((*name, view));
    }
    safetensors::serialize(views, Some(metadata)).map_err(|e| e.to_string())
}

/// Writes beside `path` and renames, so that no reader ever sees half a file.
pub(crate) fn write(path: &Path, header: &Header, contents: &Contents) -> Result<(), GuideError> {
    let io = |source| GuideError::Io {
        path: path.to_owned(),
        source,
    };
    let other = |message: String| io(std::io::Error::other(message));
    let config = contents.config.to_string();
    let mut metadata = HashMap::from([
        ("format".to_owned(), FORMAT.to_owned()),
        ("version".to_owned(), FORMAT_VERSION.to_string()),
        ("guide".to_owned(), contents.guide.clone()),
        ("columns_hash".to_owned(), header.columns_hash.clone()),
        ("scene_hash".to_owned(), header.scene_hash.clone()),
        ("config".to_owned(), config.clone()),
    ]);
    let plain = serialise(contents, metadata.clone()).map_err(other)?;
    let tensors = SafeTensors::deserialize(&plain).map_err(|e| other(e.to_string()))?;
    let mut names: Vec<String> = tensors.names().into_iter().map(str::to_owned).collect();
    metadata.insert(
        "blake3".to_owned(),
        checksum(&contents.guide, &config, &tensors, &mut names),
    );
    let bytes = serialise(contents, metadata).map_err(other)?;

    let Some(name) = path.file_name() else {
        return Err(other("the path names no file".to_owned()));
    };
    let mut partial = name.to_owned();
    partial.push(format!(".{}.partial", std::process::id()));
    let partial = path.with_file_name(partial);
    let result = fs::File::create(&partial)
        .and_then(|mut file| file.write_all(&bytes).and_then(|()| file.sync_all()))
        .and_then(|()| fs::rename(&partial, path));
    result.map_err(|e| {
        // What remains of a failed write is removed; the first error is the one to report.
        let _ = fs::remove_file(&partial);
        io(e)
    })
}

fn read(path: &Path) -> Result<(Header, Contents), GuideError> {
    let corrupt = |what: String| GuideError::Corrupt {
        path: path.to_owned(),
        what,
    };
    let bytes = fs::read(path).map_err(|source| GuideError::Io {
        path: path.to_owned(),
        source,
    })?;
    let (_, metadata) = SafeTensors::read_metadata(&bytes)
        .map_err(|e| corrupt(format!("{e} ({} bytes)", bytes.len())))?;
    let metadata = metadata.metadata().clone().unwrap_or_default();
    let field = |key: &str| {
        let value = metadata.get(key).cloned();
        value.ok_or_else(|| corrupt(format!("its metadata has no `{key}`")))
    };
    if field("format")? != FORMAT {
        return Err(corrupt(format!(
            "its format is {:?}, not {FORMAT:?}",
            field("format")?
        )));
    }
    let version = field("version")?;
    if version != FORMAT_VERSION.to_string() {
        return Err(GuideError::Version {
            path: path.to_owned(),
            found: version,
            expected: FORMAT_VERSION,
        });
    }

    let tensors = SafeTensors::deserialize(&bytes).map_err(|e| corrupt(e.to_string()))?;
    let (guide, config) = (field("guide")?, field("config")?);
    let mut names: Vec<String> = tensors.names().into_iter().map(str::to_owned).collect();
    if checksum(&guide, &config, &tensors, &mut names) != field("blake3")? {
        return Err(corrupt("its checksum does not match".to_owned()));
    }
    let config = serde_json::from_str(&config)
        .map_err(|e| corrupt(format!("its configuration is not JSON: {e}")))?;
    let mut contents = Contents {
        guide,
        config,
        ..Contents::default()
    };
    for name in names {
        let tensor = tensors.tensor(&name).map_err(|e| corrupt(e.to_string()))?;
        let shape = tensor.shape().to_vec();
        let (values, _) = tensor.data().as_chunks::<4>();
        match tensor.dtype() {
            Dtype::F32 => {
                let values = values.iter().map(|&w| f32::from_le_bytes(w)).collect();
                contents.tensors.push((name, shape, values));
            }
            Dtype::U32 => {
                let values = values.iter().map(|&w| u32::from_le_bytes(w)).collect();
                contents.words.push((name, shape, values));
            }
            other => {
                return Err(corrupt(format!(
                    "tensor {name:?} is {other:?}, not F32 or U32"
                )));
            }
        }
    }
    let header = Header {
        columns_hash: field("columns_hash")?,
        scene_hash: field("scene_hash")?,
    };
    Ok((header, contents))
}

/// The values of `tensors` in the order of `wanted`; names and shapes must agree exactly.
pub(crate) fn take<T>(
    tensors: Vec<(String, Vec<usize>, Vec<T>)>,
    wanted: &[(String, Vec<usize>)],
) -> Result<Vec<Vec<T>>, String> {
    if tensors.len() != wanted.len() {
        return Err(format!(
            "it holds {} tensors, its configuration asks for {}",
            tensors.len(),
            wanted.len()
        ));
    }
    let mut by_name: HashMap<String, (Vec<usize>, Vec<T>)> = tensors
        .into_iter()
        .map(|(name, shape, values)| (name, (shape, values)))
        .collect();
    let mut list = Vec::with_capacity(wanted.len());
    for (name, shape) in wanted {
        match by_name.remove(name) {
            Some((found, values)) if found == *shape => list.push(values),
            Some((found, _)) => {
                return Err(format!(
                    "tensor {name:?} has shape {found:?}, not {shape:?}"
                ));
            }
            None => return Err(format!("tensor {name:?} is missing")),
        }
    }
    Ok(list)
}
