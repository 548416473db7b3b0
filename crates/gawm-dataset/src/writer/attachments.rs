//! Files that come with a recording: attachments of the log, calibrations of its cameras.

use std::fs;
use std::path::{Path, PathBuf};

use gawm_schema::ContentHash;
use serde_json::Value;

use super::{DatasetWriter, open_recording};
use crate::durable::sync_parent;
use crate::error::WriteError;
use crate::journal::to_json;
use crate::layout::{ATTACHMENTS, CALIBRATION};
use crate::provenance::AttachmentRecord;

/// Longer file names are cut.
const MAX_NAME_BYTES: usize = 100;

impl DatasetWriter {
    /// Keeps a file that came with the open recording under `meta/attachments/` and returns its path in the dataset.
    ///
    /// The name loses folders and characters other than letters, digits, `.`, `_`, `-`. Equal bytes under one name are
    /// kept once; other bytes under a name that is taken get a part of their hash into the name.
    ///
    /// # Errors
    /// - no recording is open;
    /// - the name has no usable character;
    /// - the file cannot be written.
    pub fn add_attachment(&mut self, name: &str, bytes: &[u8]) -> Result<String, WriteError> {
        let file_name = safe_name(name)?;
        self.keep(ATTACHMENTS, name, &file_name, bytes)
    }

    /// Keeps a calibration of the open recording under `meta/calibration/<name>.json` and returns its path.
    ///
    /// # Errors
    /// As [`add_attachment`](DatasetWriter::add_attachment).
    pub fn add_calibration(&mut self, name: &str, calibration: &Value) -> Result<String, WriteError> {
        let file_name = format!("{}.json", safe_name(name)?);
        let bytes = to_json(Path::new(&file_name), calibration)?;
        self.keep(CALIBRATION, name, &file_name, &bytes)
    }

    fn keep(
        &mut self,
        folder: &str,
        name: &str,
        file_name: &str,
        bytes: &[u8],
    ) -> Result<String, WriteError> {
        let recording = open_recording(&mut self.recording, "add_attachment")?;
        let hash = ContentHash::of(bytes);
        let known = || {
            let earlier = self.meta.recordings.iter().flat_map(|recording| &recording.attachments);
            earlier.chain(&recording.record.attachments)
        };
        let mut path = format!("{folder}/{file_name}");
        if known().any(|a| a.path == path && a.content_hash != hash) {
            path = format!("{folder}/{}", with_hash(file_name, hash));
        }
        let record = AttachmentRecord {
            path: path.clone(),
            name: name.to_owned(),
            content_hash: hash,
            length_bytes: bytes.len() as u64,
        };
        if !known().any(|a| a.path == path) {
            let target = self.dir.join(&path);
            let parent = self.dir.join(folder);
            fs::create_dir_all(&parent).map_err(WriteError::io("create", &parent))?;
            self.disk.write_whole(&target, bytes).map_err(WriteError::io("write", &target))?;
            sync_parent(&parent).map_err(WriteError::io("sync", &parent))?;
        }
        if !recording.record.attachments.contains(&record) {
            recording.record.attachments.push(record);
        }
        Ok(path)
    }

    /// Returns the files of an aborted recording that no other recording has.
    pub(super) fn orphans(&self, attachments: &[AttachmentRecord]) -> Vec<PathBuf> {
        let is_kept = |path: &str| {
            self.meta.recordings.iter().flat_map(|recording| &recording.attachments).any(|a| a.path == path)
        };
        attachments.iter().filter(|a| !is_kept(&a.path)).map(|a| self.dir.join(&a.path)).collect()
    }
}

/// Returns the last part of a path with nothing in it that a file system or shell could take for something else.
fn safe_name(name: &str) -> Result<String, WriteError> {
    let last = name.rsplit(['/', '\\']).find(|part| !part.is_empty()).unwrap_or_default();
    let kept: String = last
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-') { c } else { '_' })
        .collect();
    let kept = kept.trim_start_matches(['.', '-']);
    if !kept.chars().any(|c| c.is_ascii_alphanumeric()) {
        return Err(WriteError::AttachmentName { name: name.to_owned() });
    }
    let (stem, extension) = kept.rsplit_once('.').unwrap_or((kept, ""));
    let extension: String = extension.chars().take(16).collect();
    let stem: String = stem.chars().take(MAX_NAME_BYTES - 17).collect();
    // The suffix of unfinished files is not a name to keep.
    Ok(match extension.as_str() {
        "" => stem,
        "tmp" => format!("{stem}_tmp"),
        _ => format!("{stem}.{extension}"),
    })
}

fn with_hash(file_name: &str, hash: ContentHash) -> String {
    let digits = &hash.to_string()[..12];
    match file_name.rsplit_once('.') {
        Some((stem, extension)) => format!("{stem}-{digits}.{extension}"),
        None => format!("{file_name}-{digits}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_name(name: &str, expected: Option<&str>) {
        assert_eq!(safe_name(name).ok().as_deref(), expected, "{name:?}");
    }

    #[test]
    fn names_stay_in_the_folder() {
        check_name("robot.urdf", Some("robot.urdf"));
        check_name("/etc/passwd", Some("passwd"));
        check_name("../../x/../arm model.urdf", Some("arm_model.urdf"));
        check_name("C:\\logs\\cal.yaml", Some("cal.yaml"));
        check_name(".hidden", Some("hidden"));
        check_name("a\0b\n.txt", Some("a_b_.txt"));
        check_name("x.tmp", Some("x_tmp"));
        check_name("..", None);
        check_name("/", None);
        check_name("", None);
        check_name("___", None);
        assert!(safe_name(&"x".repeat(5000)).unwrap().len() <= MAX_NAME_BYTES);
    }
}
