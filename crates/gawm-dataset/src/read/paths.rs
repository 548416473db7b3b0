//! Paths from metadata: templates are filled in, and nothing leads out of the folder.

use std::path::{Component, Path, PathBuf};

/// The values that path templates may name.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct TemplateValues<'a> {
    pub(super) chunk: u64,
    pub(super) file: u64,
    pub(super) episode: u64,
    pub(super) video_key: &'a str,
}

/// Fills a template such as `data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet`.
///
/// Returns the relative path, or what is wrong with the template.
pub(super) fn fill(template: &str, values: TemplateValues<'_>) -> Result<String, String> {
    let mut out = String::with_capacity(template.len() + 16);
    let mut rest = template;
    while let Some(open) = rest.find('{') {
        out.push_str(&rest[..open]);
        let close =
            rest[open..].find('}').ok_or_else(|| format!("an unclosed brace in {template:?}"))? + open;
        let (name, format) = rest[open + 1..close].split_once(':').unwrap_or((&rest[open + 1..close], ""));
        let number = match name {
            "chunk_index" | "episode_chunk" => values.chunk,
            "file_index" => values.file,
            "episode_index" => values.episode,
            "video_key" => {
                out.push_str(values.video_key);
                rest = &rest[close + 1..];
                continue;
            }
            other => return Err(format!("the unknown placeholder {other:?} in {template:?}")),
        };
        let digits = match format {
            "" | "d" => 0,
            f => f
                .trim_end_matches('d')
                .parse::<usize>()
                .map_err(|e| format!("the unknown format {f:?} ({e}) in {template:?}"))?,
        };
        if digits > 20 {
            return Err(format!("a width of {digits} digits in {template:?}"));
        }
        out.push_str(&format!("{number:0digits$}"));
        rest = &rest[close + 1..];
    }
    out.push_str(rest);
    Ok(out)
}

/// Joins a relative path from metadata to the folder if it stays inside.
///
/// Symbolic links are followed only inside the folder, or into the `blobs` folder of a Hugging Face cache that the folder
/// belongs to. A path that does not exist is joined unchanged; pipes and devices are refused.
pub(crate) fn join_inside(root: &Path, relative: &str) -> Result<PathBuf, String> {
    let path = Path::new(relative);
    if path.components().any(|c| !matches!(c, Component::Normal(_) | Component::CurDir)) {
        return Err(format!("{relative:?}, which leaves the folder"));
    }
    let joined = root.join(path);
    let Ok(real) = joined.canonicalize() else { return Ok(joined) };
    // Opening a pipe waits for somebody to write into it.
    if std::fs::metadata(&real).is_ok_and(|m| !m.is_file() && !m.is_dir()) {
        return Err(format!("{relative:?}, which is neither a file nor a folder"));
    }
    let real_root = root.canonicalize().map_err(|e| e.to_string())?;
    let blobs = real_root.parent().and_then(Path::parent).map(|repository| repository.join("blobs"));
    if real.starts_with(&real_root) || blobs.is_some_and(|blobs| real.starts_with(blobs)) {
        return Ok(joined);
    }
    Err(format!("{relative:?}, a link that leaves the folder"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_fill(template: &str, expected: Result<&str, &str>) {
        let values =
            TemplateValues { chunk: 1, file: 12, episode: 1234567, video_key: "observation.images.a" };
        match (fill(template, values), expected) {
            (Ok(got), Ok(expected)) => assert_eq!(got, expected),
            (Err(got), Err(part)) => assert!(got.contains(part), "{got}"),
            (got, expected) => panic!("expected {expected:?}, got {got:?}"),
        }
    }

    #[test]
    fn templates_are_filled_or_refused() {
        check_fill(
            "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            Ok("data/chunk-001/file-012.parquet"),
        );
        check_fill("d/{episode_chunk:03d}/e_{episode_index:06d}.parquet", Ok("d/001/e_1234567.parquet"));
        check_fill("v/{video_key}/{file_index}.mp4", Ok("v/observation.images.a/12.mp4"));
        check_fill("x/{file_index:999d}", Err("999 digits"));
        check_fill("x/{nobody}", Err("nobody"));
        check_fill("x/{file_index", Err("unclosed"));
    }

    #[test]
    fn paths_do_not_leave_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        for bad in ["../x", "/etc/passwd", "a/../../b"] {
            assert!(join_inside(folder.path(), bad).is_err(), "{bad}");
        }
        assert!(join_inside(folder.path(), "data/x").is_ok());
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink("/etc", folder.path().join("out")).unwrap();
            assert!(join_inside(folder.path(), "out/passwd").is_err());
        }
    }
}
