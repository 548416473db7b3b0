//! Where an output may lie, and how it appears there at once.

use std::fs;
use std::path::{Component, Path, PathBuf};

use tempfile::TempDir;

use super::{EditError, Input};
use crate::durable::sync_parent;

/// The output under construction: a folder beside the place where it will be.
pub(super) struct Target {
    place: PathBuf,
    work: TempDir,
    folder: PathBuf,
}

impl Target {
    /// Checks the output's place and makes the folder that it grows in.
    pub(super) fn prepare(out: &Path, inputs: &[Input]) -> Result<Target, EditError> {
        let place = check_place(out, inputs.iter().map(|input| input.dataset.root.as_path()))?;
        let parent = place.parent().unwrap_or(Path::new("/")).to_owned();
        fs::create_dir_all(&parent).map_err(EditError::io("create", &parent))?;
        let name = place.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let work = tempfile::Builder::new()
            .prefix(&format!(".{name}."))
            .suffix(".unfinished")
            .tempdir_in(&parent)
            .map_err(EditError::io("create a folder in", &parent))?;
        let folder = work.path().join("dataset");
        fs::create_dir(&folder).map_err(EditError::io("create", &folder))?;
        Ok(Target { place, work, folder })
    }

    /// Returns the folder to write into.
    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Gives the output its name.
    pub(super) fn finish(self) -> Result<(), EditError> {
        // An empty folder that is there gives way to the new one.
        fs::rename(&self.folder, &self.place).map_err(EditError::io("rename to", &self.place))?;
        sync_parent(&self.place).map_err(EditError::io("sync", &self.place))?;
        let path = self.work.path().to_owned();
        self.work.close().map_err(EditError::io("remove", &path))
    }
}

/// Returns the absolute place of an output that may be written there.
pub(super) fn check_place<'a>(
    out: &Path,
    inputs: impl Iterator<Item = &'a Path>,
) -> Result<PathBuf, EditError> {
    let place = resolve(out)?;
    for input in inputs {
        let real = input.canonicalize().map_err(EditError::io("resolve", input))?;
        if place.starts_with(&real) || real.starts_with(&place) {
            return Err(EditError::InsideInput { path: out.to_owned(), input: input.to_owned() });
        }
    }
    match fs::read_dir(&place) {
        Ok(mut entries) => match entries.next() {
            Some(_) => Err(EditError::NotEmpty { path: out.to_owned() }),
            None => Ok(place),
        },
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(place),
        // A file, or a folder that cannot be looked into.
        Err(error) => Err(EditError::io("list", out)(error)),
    }
}

/// Returns the path with links and `..` followed as far as it exists.
fn resolve(out: &Path) -> Result<PathBuf, EditError> {
    let absolute = std::path::absolute(out).map_err(EditError::io("resolve", out))?;
    let mut existing = absolute.as_path();
    let mut rest = Vec::new();
    loop {
        if let Ok(real) = existing.canonicalize() {
            return Ok(rest.iter().rev().fold(real, |path: PathBuf, part| path.join(part)));
        }
        match (existing.components().next_back(), existing.parent()) {
            (Some(Component::Normal(part)), Some(parent)) => {
                rest.push(part.to_owned());
                existing = parent;
            }
            _ => return Err(EditError::OutputPath { path: out.to_owned() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outputs_lie_beside_inputs() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let input = root.join("in");
        fs::create_dir_all(input.join("data")).unwrap();
        fs::create_dir_all(root.join("full/x")).unwrap();
        fs::create_dir_all(root.join("empty")).unwrap();
        fs::write(root.join("file"), "").unwrap();
        let check = |out: &str| check_place(&root.join(out), [input.as_path()].into_iter());
        for good in ["out", "empty", "a/b/c", "in/../out", "in/data/../../out2"] {
            assert!(check(good).is_ok(), "{good}");
        }
        for inside in ["in", "in/out", "in/data/x", "out/../in/y", "."] {
            let inside = if inside == "out/../in/y" { "empty/../in/y" } else { inside };
            assert!(matches!(check(inside), Err(EditError::InsideInput { .. })), "{inside}");
        }
        assert!(matches!(check("full"), Err(EditError::NotEmpty { .. })));
        assert!(matches!(check("absent/../in/x"), Err(EditError::OutputPath { .. })));
        assert!(matches!(check("file"), Err(EditError::Write(_))));
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(&input, root.join("link")).unwrap();
            assert!(matches!(check("link/new"), Err(EditError::InsideInput { .. })));
        }
    }
}
