//! A table of two methods with two runs each, written and read again.

use super::*;
use crate::config::{PlanConfig, Protocol};
use crate::planner::PlannerConfig;
use crate::program::{plan, write_plan};
use crate::testing::run;

fn small() -> PlanConfig {
    let planner = PlannerConfig {
        samples: 8,
        iterations: 1,
        elites: 2,
        horizon: 1,
        receding: 1,
        kept_elites: 0,
        ..PlannerConfig::small()
    };
    PlanConfig {
        count: 6,
        planner: Some(planner),
        budget_steps: 10,
        protocol: Protocol::Reference,
        ..PlanConfig::default()
    }
}

#[test]
fn runs_become_a_table_with_paired_intervals() {
    let root = tempfile::tempdir().unwrap();
    let write = |method: &str, seed: u64| {
        let run = crate::run::Run { method: method.to_owned(), ..run(seed) };
        let result = plan(Some(&run), None, None, &small(), &|_, _, _| ()).unwrap();
        let folder = root.path().join(format!("{method}-{seed}"));
        write_plan(&folder, &result, 2).unwrap();
        for file in [
            "plan.json",
            "outcomes-published.jsonl",
            "sheet-published.png",
            "success.csv",
            "success.parquet",
            "success-published.svg",
            "index.html",
        ] {
            assert!(folder.join(file).is_file(), "{file}");
        }
        let read = PlanFolder::read(&folder).unwrap();
        // What is on disk is the report without outcomes and times.
        assert_eq!(read.report.sets[0].solvers[0].any, result.report.sets[0].solvers[0].any);
        read
    };
    let folders = [write("sa-idm", 1), write("sa-idm", 2), write("lewm", 1), write("lewm", 2)];
    let table = compare(&folders);
    assert_eq!(table.columns, ["two-room reference published"]);
    assert_eq!(table.rows[..3], ["sa-idm", "lewm", "untrained"]);
    let cell = |table: &CompareTable, row: &str| {
        let cell = table.cells.iter().find(|cell| cell.row == row).unwrap();
        (cell.seeds.len(), cell.pooled.n)
    };
    assert_eq!(cell(&table, "lewm"), (2, 12));
    // All four had the same problems and the same untrained weights.
    assert_eq!(cell(&table, "untrained"), (1, 6));
    assert_eq!(table.duels.len(), 1);
    let pairs = table.duels[0].difference.pairs;
    assert_eq!(pairs.both + pairs.only_first + pairs.only_second + pairs.neither, 12);
    let markdown = table.to_markdown();
    assert!(markdown.contains("| sa-idm - lewm | two-room reference published |"), "{markdown}");

    let labelled = folders.map(|folder| PlanFolder { label: Some("both".to_owned()), ..folder });
    let table = compare(&labelled);
    assert_eq!((cell(&table, "both"), table.duels.len()), ((4, 24), 0));
}

#[test]
fn the_same_run_gives_the_same_bytes() {
    let root = tempfile::tempdir().unwrap();
    let write = |name: &str| {
        let result = plan(Some(&run(1)), None, None, &small(), &|_, _, _| ()).unwrap();
        write_plan(&root.path().join(name), &result, 2).unwrap();
    };
    write("a");
    write("b");
    for file in
        ["plan.json", "outcomes-published.jsonl", "success.parquet", "index.html", "sheet-published.png"]
    {
        let read = |name: &str| std::fs::read(root.path().join(name).join(file)).unwrap();
        assert!(read("a") == read("b"), "{file}");
    }
}

#[test]
fn files_that_are_no_results_are_named() {
    let root = tempfile::tempdir().unwrap();
    assert!(matches!(PlanFolder::read(root.path()), Err(CompareError::Io { .. })));
    std::fs::write(root.path().join("plan.json"), "{\"format_version\": 1}").unwrap();
    let error = PlanFolder::read(root.path()).unwrap_err();
    assert!(
        matches!(&error, CompareError::Syntax { message, .. } if message.contains("missing field")),
        "{error}"
    );
}
