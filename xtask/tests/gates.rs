//! Rules of the workspace that no compiler checks: who may link what, where `unsafe` may live, what a tree may hold.

#![expect(clippy::unwrap_used, reason = "a gate that cannot look at the workspace has failed")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Programs and what they must never link (docs/ARCHITECTURE.md, "Borders").
const FORBIDDEN: &[(&str, &[&str])] = &[
    ("gawm-schema", &["arrow", "parquet", "mcap", "candle-core", "iceoryx2"]),
    ("gawm-dataset", &["mcap", "candle-core", "iceoryx2"]),
    ("gawm-ingest", &["candle-core", "iceoryx2"]),
    ("gawm-model", &["mcap", "parquet", "arrow", "iceoryx2"]),
    ("gawm-train", &["mcap", "parquet"]),
];

/// Crates whose manifest alone may name a library.
const OWNERS: &[(&str, &[&str])] = &[("iceoryx2", &["gawm-shm"]), ("mcap", &["gawm-ingest", "gawm-sim"])];

/// Crates in which `unsafe` may appear.
const UNSAFE_CRATES: &[&str] = &["gawm-shm", "gawm-kernels"];

/// The longest a source file may be, in lines; test modules and tables are exempt by name.
const MAX_LINES: usize = 700;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the workspace").to_owned()
}

fn cargo(args: &[&str]) -> String {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".into());
    let output = Command::new(cargo).args(args).current_dir(root()).output().unwrap();
    assert!(output.status.success(), "cargo {args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn metadata() -> serde_json::Value {
    serde_json::from_str(&cargo(&["metadata", "--format-version=1", "--no-deps", "--offline"])).unwrap()
}

/// Returns our crates: name to names of its normal (not dev) dependencies.
fn our_crates() -> BTreeMap<String, BTreeSet<String>> {
    let metadata = metadata();
    let normal = |package: &serde_json::Value| {
        package["dependencies"]
            .as_array()
            .unwrap()
            .iter()
            .filter(|dependency| dependency["kind"].is_null())
            .map(|dependency| dependency["name"].as_str().unwrap().to_owned())
            .collect()
    };
    metadata["packages"]
        .as_array()
        .unwrap()
        .iter()
        .map(|package| (package["name"].as_str().unwrap().to_owned(), normal(package)))
        .collect()
}

/// Returns the files git tracks or would track, relative to the root.
fn tracked_files() -> Vec<PathBuf> {
    let output = Command::new("git")
        .args(["ls-files", "-z", "--cached", "--others", "--exclude-standard"])
        .current_dir(root())
        .output()
        .unwrap();
    assert!(output.status.success(), "git ls-files: {}", String::from_utf8_lossy(&output.stderr));
    let listing = String::from_utf8(output.stdout).unwrap();
    listing.split('\0').filter(|name| !name.is_empty()).map(PathBuf::from).collect()
}

fn sources() -> impl Iterator<Item = (PathBuf, String)> {
    let is_rust = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "rs");
    tracked_files()
        .into_iter()
        .filter(is_rust)
        .filter_map(|path| std::fs::read_to_string(root().join(&path)).ok().map(|text| (path, text)))
}

#[test]
fn crates_link_nothing_beyond_their_border() {
    let crates = our_crates();
    for (package, forbidden) in FORBIDDEN {
        if !crates.contains_key(*package) {
            continue;
        }
        let tree = cargo(&[
            "tree",
            "--offline",
            "-p",
            package,
            "-e",
            "normal",
            "--prefix",
            "none",
            "--format",
            "{p}",
        ]);
        let linked: BTreeSet<&str> = tree.lines().filter_map(|line| line.split(' ').next()).collect();
        for name in *forbidden {
            assert!(
                !linked.contains(name),
                "{package} links {name}; `cargo tree -p {package} -i {name}` shows how"
            );
        }
    }
}

#[test]
fn libraries_are_named_by_their_owner_alone() {
    for (library, owners) in OWNERS {
        for (package, dependencies) in our_crates() {
            let allowed = owners.contains(&package.as_str()) || !dependencies.contains(*library);
            assert!(allowed, "{package} depends on {library}, which belongs to {owners:?}");
        }
    }
}

#[test]
fn unsafe_lives_where_it_may() {
    for package in our_crates().keys().filter(|name| name.starts_with("gawm-") && *name != "gawm-e2e") {
        let lib = std::fs::read_to_string(root().join(format!("crates/{package}/src/lib.rs"))).unwrap();
        let forbids = lib.contains("#![forbid(unsafe_code)]");
        assert_eq!(
            forbids,
            !UNSAFE_CRATES.contains(&package.as_str()),
            "{package}/src/lib.rs and forbid(unsafe_code)"
        );
    }
}

#[test]
fn source_files_stay_readable() {
    let exempt = |path: &Path| {
        let name = path.to_string_lossy();
        name.contains("/tests")
            || name.contains("/fuzz/")
            || name.contains("/benches/")
            || name.ends_with("tables.rs")
    };
    let too_long: Vec<_> = sources()
        .filter(|(path, _)| !exempt(path))
        .map(|(path, text)| (path, text.lines().count()))
        .filter(|(_, lines)| *lines > MAX_LINES)
        .collect();
    assert!(too_long.is_empty(), "files over {MAX_LINES} lines: {too_long:?}");
}

#[test]
fn nothing_is_left_undone_or_ignored() {
    // Split so that this file does not find itself.
    let banned = [
        concat!("todo", "!("),
        concat!("unimpl", "emented!("),
        concat!("#[ign", "ore"),
        concat!("FIX", "ME"),
    ];
    for (path, text) in sources() {
        for word in banned {
            assert!(!text.contains(word), "{} holds {word}", path.display());
        }
    }
}

#[test]
fn no_path_of_a_machine_is_committed() {
    // A path is built here so that this file does not find itself.
    let machine_paths: Vec<String> = ["work", "root", "home"].iter().map(|top| format!("/{top}/")).collect();
    let is_text = |path: &Path| {
        let text = ["rs", "toml", "md", "py", "sh", "json", "html", "yml"];
        path.extension().is_some_and(|extension| text.iter().any(|known| extension == *known))
    };
    for path in tracked_files().into_iter().filter(|path| is_text(path) && !path.starts_with("fixtures")) {
        let Ok(text) = std::fs::read_to_string(root().join(&path)) else { continue };
        for (line, content) in text.lines().enumerate() {
            let found = machine_paths.iter().find(|machine| {
                content.match_indices(machine.as_str()).any(|(at, _)| {
                    !content[..at]
                        .ends_with(|before: char| before.is_alphanumeric() || "_.-)}~".contains(before))
                })
            });
            assert!(found.is_none(), "{}:{} names a path of a machine: {content}", path.display(), line + 1);
        }
    }
}

#[test]
fn the_architecture_lists_our_crates_and_their_arrows() {
    let text = std::fs::read_to_string(root().join("docs/ARCHITECTURE.md")).unwrap();
    let mut listed = BTreeMap::new();
    for line in text.lines().filter(|line| line.starts_with("| `gawm") || line.starts_with("| `xtask")) {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        let name = cells[1].trim_matches('`').to_owned();
        let arrows: BTreeSet<String> = cells[2]
            .split(',')
            .map(|arrow| arrow.trim().trim_matches('`').to_owned())
            .filter(|arrow| !arrow.is_empty() && arrow != "-")
            .collect();
        listed.insert(name, arrows);
    }
    let ours: BTreeSet<String> = our_crates().into_keys().collect();
    let actual: BTreeMap<String, BTreeSet<String>> = our_crates()
        .into_iter()
        .map(|(name, dependencies)| (name, dependencies.intersection(&ours).cloned().collect()))
        .collect();
    assert_eq!(listed, actual, "the crate table of docs/ARCHITECTURE.md differs from the manifests");
}
