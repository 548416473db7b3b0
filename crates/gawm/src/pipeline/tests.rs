use std::path::Path;

use super::{Pipeline, PipelineError, StepName, plan_steps};

const TEXT: &str = "[sim]\nenv = \"two-room\"\nepisodes = 3\nseed = 1\n[ingest]\nversion = 1\n";
const TRAINED: &str =
    "[loader]\nbatch = 2\n[model]\npreset = \"micro\"\n[objectives]\npreset = \"idm\"\n[train]\nsteps = 5\n";

fn pipeline(text: &str, overrides: &[&str]) -> Result<Pipeline, PipelineError> {
    let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
    Pipeline::parse(Path::new("p.toml"), text, &overrides)
}

fn keys(pipeline: &Pipeline) -> Vec<(StepName, String)> {
    let steps = plan_steps(pipeline, Path::new("out"), &[]).unwrap();
    steps.into_iter().map(|step| (step.name, step.key)).collect()
}

#[test]
fn an_override_sets_a_value_of_its_type() {
    let pipeline =
        pipeline(TEXT, &["sim.episodes=7", "ingest.ticks.fps=2.5", "ingest.robot_type=arm"]).unwrap();
    assert_eq!(pipeline.document["sim"]["episodes"].as_integer(), Some(7));
    assert_eq!(pipeline.document["ingest"]["ticks"]["fps"].as_float(), Some(2.5));
    assert_eq!(pipeline.document["ingest"]["robot_type"].as_str(), Some("arm"));
}

#[test]
fn what_no_program_reads_is_refused() {
    assert!(
        matches!(pipeline("[trian]\n", &[]), Err(PipelineError::UnknownSection { name, .. }) if name == "trian")
    );
    assert!(matches!(pipeline(TEXT, &["sim"]), Err(PipelineError::Override { .. })));
    assert!(matches!(pipeline(TEXT, &["episodes=1"]), Err(PipelineError::Override { .. })));
    assert!(matches!(pipeline(TEXT, &["sim.seed.x=1"]), Err(PipelineError::Override { .. })));
    assert!(matches!(pipeline("[sim", &[]), Err(PipelineError::Syntax { .. })));
}

#[test]
fn a_pipeline_without_logs_or_contract_says_so() {
    let no_logs = plan_steps(&pipeline("[ingest]\n", &[]).unwrap(), Path::new("out"), &[]);
    assert!(matches!(no_logs, Err(PipelineError::NoLogs { .. })));
    let no_contract = pipeline("[sim]\nenv = \"two-room\"\nepisodes = 1\nseed = 1\n", &[]).unwrap();
    let no_contract = plan_steps(&no_contract, Path::new("out"), &[]);
    assert!(matches!(no_contract, Err(PipelineError::MissingSection { name: "ingest", .. })));
    let half = pipeline(&format!("{TEXT}[train]\nsteps = 1\n"), &[]).unwrap();
    let half = plan_steps(&half, Path::new("out"), &[]);
    assert!(matches!(half, Err(PipelineError::MissingSection { name: "loader", .. })));
}

#[test]
fn a_change_makes_the_steps_that_read_it_and_those_after_them_due() {
    let text = format!("{TEXT}{TRAINED}");
    let before = keys(&pipeline(&text, &[]).unwrap());
    let same_until = |overrides: &[&str]| {
        let after = keys(&pipeline(&text, overrides).unwrap());
        let same: Vec<StepName> =
            before.iter().zip(&after).filter(|(a, b)| a == b).map(|(a, _)| a.0).collect();
        same
    };
    use StepName::{Collect, Describe, Ingest, Train, Validate};
    assert_eq!(same_until(&[]), [Collect, Ingest, Validate, Describe, Train]);
    assert_eq!(same_until(&["train.steps=6"]), [Collect, Ingest, Validate, Describe]);
    assert_eq!(same_until(&["ingest.version=2"]), [Collect]);
    assert_eq!(same_until(&["sim.seed=2"]), []);
}

#[test]
fn planning_and_diagnosis_are_due_each_for_its_own_part() {
    let text = format!("{TEXT}{TRAINED}[eval.plan]\ncount = 5\n");
    let of = |overrides: &[&str]| keys(&pipeline(&text, overrides).unwrap());
    let (before, planned, examined) = (of(&[]), of(&["eval.plan.count=6"]), of(&["eval.diagnose.stride=2"]));
    let due = |after: &[(StepName, String)]| -> Vec<StepName> {
        before.iter().zip(after).filter(|(a, b)| a != b).map(|(a, _)| a.0).collect()
    };
    assert_eq!(due(&planned), [StepName::Plan]);
    assert_eq!(due(&examined), [StepName::Diagnose]);
}

#[test]
fn a_log_is_the_same_log_by_any_path() {
    let folder = tempfile::tempdir().unwrap();
    let (log, nested) = (folder.path().join("a.mcap"), folder.path().join("bag/deep"));
    std::fs::create_dir_all(&nested).unwrap();
    std::fs::write(&log, "one").unwrap();
    std::fs::write(nested.join("part"), "one").unwrap();
    let pipeline = pipeline(TEXT, &[]).unwrap();
    let key = |path: &Path| {
        let steps = plan_steps(&pipeline, Path::new("out"), &[path.to_owned()]).unwrap();
        steps.into_iter().map(|step| step.key).collect::<Vec<_>>()
    };
    assert_eq!(key(&log), key(&folder.path().join("bag/../a.mcap")));
    let bag = folder.path().join("bag");
    let before = key(&bag);
    assert_eq!(before, key(&bag.join(".")));
    std::fs::write(nested.join("part"), "more").unwrap();
    assert_ne!(before, key(&bag));
}
