//! Datasets of other people, from the shared corpora: what `gawm-data` says of them.

use std::{env, path::PathBuf};

use gawm_dataset::{
    read::{Dataset, OpenError, ReadLimits},
    report::{ReportOptions, render_report},
    stats::dataset_stats,
    validate::{Severity, ValidateOptions, validate},
};

fn corpus(name: &str) -> Option<PathBuf> {
    let Some(shared) = env::var_os("GAWM_SHARED") else {
        println!("skipped: GAWM_SHARED is not set");
        return None;
    };
    let dir = PathBuf::from(shared).join("corpora").join(name);
    assert!(dir.is_dir(), "GAWM_SHARED is set, but {} is missing", dir.display());
    Some(dir)
}

/// Checks the codes of errors and warnings, which are all true of these datasets but for the last list.
fn check_findings(name: &str, n_episodes: u64, n_rows: u64, expected: &[&str], false_alarms: &[&str]) {
    let Some(dir) = corpus(name) else { return };
    let dataset = Dataset::open(&dir, ReadLimits::default()).expect("the corpus opens");
    let report = validate(&dataset, &ValidateOptions::default()).expect("the corpus is scanned");
    assert_eq!((report.episodes, report.rows), (n_episodes, n_rows));
    let mut codes: Vec<&str> =
        report.findings.iter().filter(|f| f.severity >= Severity::Warning).map(|f| f.code).collect();
    codes.sort_unstable();
    codes.dedup();
    let mut wanted: Vec<&str> = expected.iter().chain(false_alarms).copied().collect();
    wanted.sort_unstable();
    assert_eq!(codes, wanted, "{:#?}", report.findings);
}

#[test]
fn gr1_lacks_one_camera_and_names_too_many_episodes() {
    check_findings("lerobot_v2_gr1_picknplace", 5, 2096, &["IMAGE-011", "SPLIT-004"], &[]);
}

#[test]
fn apple_storage_was_trimmed_by_its_makers() {
    check_findings(
        "lerobot_v3_apple_storage",
        3,
        899,
        &["IMAGE-011", "SPLIT-004", "STRUCT-013"],
        &["TIME-008"],
    );
}

#[test]
fn empty_metadata_are_refused_by_name() {
    let Some(dir) = corpus("lerobot_broken_carla") else { return };
    let error = Dataset::open(&dir, ReadLimits::default()).unwrap_err();
    assert!(matches!(error, OpenError::BadInfo { .. }), "{error}");
    assert!(error.to_string().contains("meta/info.json"), "{error}");
}

#[test]
fn statistics_agree_with_those_that_came_with_the_data() {
    let Some(dir) = corpus("lerobot_v2_gr1_picknplace") else { return };
    let dataset = Dataset::open(&dir, ReadLimits::default()).unwrap();
    let stats = dataset_stats(&dataset).unwrap();
    let stored = dataset.stats.as_ref().unwrap();
    for column in stats.columns.iter().filter(|c| c.name == "action" || c.name == "observation.state") {
        for (i, dim) in column.dims.iter().enumerate() {
            let summary = dim.values.summary();
            for (key, value) in
                [("mean", summary.mean), ("std", summary.std), ("min", summary.min), ("max", summary.max)]
            {
                let expected = stored[&column.name][key][i].as_f64().unwrap();
                // The makers computed in single precision.
                assert!(
                    (value - expected).abs() < 2e-4 * (1.0 + expected.abs()),
                    "{key} {i}: {value} {expected}"
                );
            }
        }
    }
}

#[test]
fn statistics_do_not_depend_on_the_number_of_threads() {
    let Some(dir) = corpus("lerobot_v2_gr1_picknplace") else { return };
    let dataset = Dataset::open(&dir, ReadLimits::default()).unwrap();
    let with = |n: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| dataset_stats(&dataset).unwrap())
    };
    assert!(with(1) == with(4));
}

#[test]
fn a_shared_report_is_self_contained_and_small() {
    let Some(dir) = corpus("lerobot_v2_gr1_picknplace") else { return };
    let dataset = Dataset::open(&dir, ReadLimits::default()).unwrap();
    let page = render_report(&dataset, ReportOptions { is_shared: true }).unwrap();
    assert!(page.len() < 5 << 20, "{} bytes", page.len());
    for needle in ["http://", "https://", "<link", "@import", "url(", "lerobot_v2_gr1"] {
        assert!(!page.contains(needle), "{needle}");
    }
    assert!(!page.contains(dir.to_str().unwrap()));
}
