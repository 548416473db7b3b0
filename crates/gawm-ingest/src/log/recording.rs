//! Groups files and folders into recordings.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::OpenOptions;
use super::error::OpenLogError;
use super::open::limits;
use super::refusal::Foreign;
use super::rosbag2::{METADATA_FILE, Rosbag2Metadata};
use super::source::Source;
use super::summary::{read_summary, read_tail};

/// Folders below a named folder that are searched.
const MAX_DEPTH: usize = 16;
/// Parts of a recording without metadata follow on each other within this time.
const MAX_PART_GAP_NS: u64 = 2_000_000_000;

/// One recording: a file, or the ordered parts of a split bag.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Recording {
    /// Name of the file or of the folder, without its path.
    pub name: String,
    /// The files in order of time.
    pub parts: Vec<PathBuf>,
    /// The rosbag2 metadata beside the parts, if there is any that lists them.
    pub rosbag2: Option<Rosbag2Metadata>,
}

/// What was found at the named paths.
#[derive(Debug, Default)]
pub struct Discovery {
    /// Recordings in a fixed order: as named, folders by file name.
    pub recordings: Vec<Recording>,
    /// Paths that are refused, and why.
    pub refused: Vec<OpenLogError>,
}

/// The files that were found so far, whatever names they were found by.
#[derive(Default)]
struct Seen {
    paths: BTreeSet<PathBuf>,
    /// How often a file was found again.
    n_again: usize,
}

impl Seen {
    /// Notes a file and returns whether it was not found before.
    fn is_new(&mut self, path: &Path) -> bool {
        let is_new = self.paths.insert(canonical(path));
        self.n_again += usize::from(!is_new);
        is_new
    }
}

/// Finds the recordings at the named files and folders.
///
/// A folder with a rosbag2 `metadata.yaml`, and a LeRobot folder, is one recording. In other folders, files named `x_0.mcap`, `x_1.mcap`, … without
/// a hole are the parts of one recording where each goes on within two seconds of where the one before ends (or has no
/// summary that says when it ends), and every other `.mcap`, `.h5`, `.hdf5` or `.npz` file is one of its own; folders below
/// are searched too.
/// Named files are recordings of their own, except when all parts that a `metadata.yaml` beside them lists are named.
/// A file that is named twice counts once.
pub fn discover(inputs: &[PathBuf]) -> Discovery {
    let mut discovery = Discovery::default();
    let named: BTreeSet<PathBuf> =
        inputs.iter().filter(|path| !path.is_dir()).map(|path| canonical(path)).collect();
    let mut seen = Seen::default();
    for input in inputs {
        let is_metadata = input.file_name().is_some_and(|name| name == METADATA_FILE) && input.is_file();
        let input = &if is_metadata {
            input.parent().map_or_else(|| ".".into(), folder_or_here)
        } else {
            input.clone()
        };
        if input.is_dir() {
            let n_before = discovery.recordings.len() + discovery.refused.len() + seen.n_again;
            folder(input, MAX_DEPTH, &mut seen, &mut discovery);
            if discovery.recordings.len() + discovery.refused.len() + seen.n_again == n_before {
                discovery.refused.push(OpenLogError::EmptyFolder { path: input.clone() });
            }
        } else {
            file(input, &named, &mut seen, &mut discovery);
        }
    }
    discovery
}

fn canonical(path: &Path) -> PathBuf {
    path.canonicalize().unwrap_or_else(|_not_there| path.to_owned())
}

/// Returns the folder, `.` for the empty path.
fn folder_or_here(folder: &Path) -> PathBuf {
    if folder.as_os_str().is_empty() { ".".into() } else { folder.to_owned() }
}

fn name_of(path: &Path) -> String {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
    name.or_else(|| canonical(path).file_name().map(|name| name.to_string_lossy().into_owned()))
        .unwrap_or_default()
}

fn push(
    parts: Vec<PathBuf>,
    name: String,
    rosbag2: Option<Rosbag2Metadata>,
    seen: &mut Seen,
    to: &mut Discovery,
) {
    let parts: Vec<PathBuf> = parts.into_iter().filter(|part| seen.is_new(part)).collect();
    if !parts.is_empty() {
        to.recordings.push(Recording { name, parts, rosbag2 });
    }
}

/// Takes a file that was named.
fn file(path: &Path, named: &BTreeSet<PathBuf>, seen: &mut Seen, to: &mut Discovery) {
    let folder = &path.parent().map_or_else(|| ".".into(), folder_or_here);
    // Metadata beside a named file only adds to it; when it is damaged, the file is still a file.
    let metadata = Rosbag2Metadata::read(folder).ok().flatten();
    let parts = metadata.as_ref().and_then(|metadata| metadata.parts(folder).ok()).unwrap_or_default();
    let is_listed = parts.iter().any(|part| canonical(part) == canonical(path));
    let rosbag2 = metadata.filter(|_| is_listed);
    if is_listed && parts.len() > 1 && parts.iter().all(|part| named.contains(&canonical(part))) {
        push(parts, name_of(folder), rosbag2, seen, to);
    } else {
        push(vec![path.to_owned()], name_of(path), rosbag2, seen, to);
    }
}

/// Takes a folder that was named, or one below it.
fn folder(path: &Path, depth: usize, seen: &mut Seen, to: &mut Discovery) {
    if crate::lerobot::is_dataset(path) {
        return push(vec![path.to_owned()], name_of(path), None, seen, to);
    }
    match Rosbag2Metadata::read(path) {
        Ok(Some(metadata)) => return bag(path, metadata, seen, to),
        Ok(None) => {}
        Err(error) => to.refused.push(error),
    }
    let entries = match std::fs::read_dir(path) {
        Ok(entries) => entries,
        Err(source) => return to.refused.push(OpenLogError::Io { path: path.to_owned(), source }),
    };
    let mut paths: Vec<PathBuf> = entries.filter_map(Result::ok).map(|entry| entry.path()).collect();
    paths.sort();
    let files: Vec<PathBuf> = paths.iter().filter(|path| path.is_file()).cloned().collect();
    for (name, parts) in grouped(&files) {
        push(parts, name, None, seen, to);
    }
    for other in files {
        if let Some(found) = foreign_by_name(&other)
            && seen.is_new(&other)
        {
            to.refused.push(OpenLogError::NotMcap { path: other, found });
        }
    }
    for below in paths.iter().filter(|path| depth > 0 && path.is_dir() && !path.is_symlink()) {
        folder(below, depth - 1, seen, to);
    }
}

fn bag(path: &Path, metadata: Rosbag2Metadata, seen: &mut Seen, to: &mut Discovery) {
    match metadata.parts(path) {
        Ok(parts) => match parts.iter().find_map(|part| Some((part, foreign_by_name(part)?))) {
            Some((part, found)) => to.refused.push(OpenLogError::NotMcap { path: part.clone(), found }),
            None => push(parts, name_of(path), Some(metadata), seen, to),
        },
        Err(error) => to.refused.push(error),
    }
}

/// Tells by its name a log of another kind; other files in a folder are not looked at.
fn foreign_by_name(path: &Path) -> Option<Foreign> {
    let name = path.file_name()?.to_str()?;
    let foreign = [
        (".bag", Foreign::RosBag1),
        (".db3", Foreign::Sqlite),
        (".mcap.gz", Foreign::Compressed { name: "gzip" }),
        (".mcap.lz4", Foreign::Compressed { name: "lz4" }),
        (".db3.zstd", Foreign::Sqlite),
    ];
    foreign.into_iter().find(|(ending, _)| name.ends_with(ending)).map(|(_, foreign)| foreign)
}

/// Groups the logs and tables of a folder without metadata, in order of their names.
fn grouped(files: &[PathBuf]) -> Vec<(String, Vec<PathBuf>)> {
    let mut numbered: BTreeMap<String, BTreeMap<u64, PathBuf>> = BTreeMap::new();
    let mut groups = Vec::new();
    for path in files.iter().filter(|path| is_log(path)) {
        match split_number(path) {
            // `x_1.mcap` and `x_01.mcap` would be the same part; the second is one of its own.
            Some((stem, number)) if !numbered.get(&stem).is_some_and(|parts| parts.contains_key(&number)) => {
                numbered.entry(stem).or_default().insert(number, path.clone());
            }
            _ => groups.push((name_of(path), vec![path.clone()])),
        }
    }
    for (stem, parts) in numbered {
        let is_whole = parts.len() > 1 && parts.keys().copied().eq(0..parts.len() as u64);
        if is_whole && go_on(parts.values()) {
            groups.push((stem, parts.into_values().collect()));
        } else {
            groups.extend(parts.into_values().map(|path| (name_of(&path), vec![path])));
        }
    }
    groups.extend(files.iter().filter(|path| is_table(path)).map(|path| (name_of(path), vec![path.clone()])));
    groups.sort_by(|a, b| a.1.cmp(&b.1));
    groups
}

/// Returns whether each file goes on where the one before ends; those that do not say when they begin and end may.
///
/// One file per episode is often numbered as well.
fn go_on<'a>(parts: impl Iterator<Item = &'a PathBuf>) -> bool {
    let spans: Vec<Option<(u64, u64)>> = parts.map(|part| span_of(part)).collect();
    spans.windows(2).all(|pair| match (pair[0], pair[1]) {
        (Some((_, end)), Some((start, _))) => end.abs_diff(start) <= MAX_PART_GAP_NS,
        _ => true,
    })
}

/// Returns the first and the last log time that the summary of a file states.
fn span_of(path: &Path) -> Option<(u64, u64)> {
    let source = Source::open(path).ok()?;
    let mut damage = Vec::new();
    let tail = read_tail(&source, &mut damage).ok()??;
    let summary = read_summary(&source, &tail, limits(&OpenOptions::default()), &mut damage).ok()??;
    let statistics = summary.statistics.filter(|statistics| statistics.message_count > 0)?;
    Some((statistics.message_start_time, statistics.message_end_time))
}

/// Tells a log by its name; rosbag2 may have compressed it as a whole.
fn is_log(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    [".mcap", ".mcap.zstd", ".mcap.zst"].iter().any(|ending| name.ends_with(ending))
}

/// Tells a table by its name: other files of a folder are not opened.
fn is_table(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ["h5", "hdf5", "npz"].iter().any(|known| ending == *known))
}

/// Splits `name_12.mcap` into `name` and 12.
fn split_number(path: &Path) -> Option<(String, u64)> {
    let stem = path.file_name()?.to_str()?.split(".mcap").next()?;
    let (stem, digits) = stem.rsplit_once('_')?;
    let is_number = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
    Some((stem.to_owned(), digits.parse().ok().filter(|_| is_number)?))
}
