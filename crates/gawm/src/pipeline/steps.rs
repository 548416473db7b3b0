//! The steps of a pipeline: what each reads, what it makes, and by which command.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use gawm_schema::pipeline::SECTIONS;

use super::{Pipeline, PipelineError};

/// A step of a pipeline, in the order they run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub enum StepName {
    /// A simulator records logs.
    Collect,
    /// Logs become a dataset.
    Ingest,
    /// The dataset is checked.
    Validate,
    /// The dataset is shown on one page.
    Describe,
    /// A model learns from the dataset.
    Train,
    /// The model plans.
    Plan,
    /// The model's latents are examined.
    Diagnose,
}

impl StepName {
    /// Returns the name as the command line and the ledger have it.
    pub fn as_str(self) -> &'static str {
        match self {
            StepName::Collect => "collect",
            StepName::Ingest => "ingest",
            StepName::Validate => "validate",
            StepName::Describe => "describe",
            StepName::Train => "train",
            StepName::Plan => "plan",
            StepName::Diagnose => "diagnose",
        }
    }
}

/// One step: a command of this program, and how to know whether it is still to be done.
#[derive(Debug, Clone)]
pub struct Step {
    /// Which.
    pub name: StepName,
    /// What it does, for people: `logs -> dataset`.
    pub what: String,
    /// Arguments of `gawm`, without those that go on.
    pub arguments: Vec<OsString>,
    /// Arguments to add when an earlier attempt at the same key was interrupted; `None`: begin anew.
    pub resume: Option<Vec<OsString>>,
    /// The folder or file that the step makes; removed before the step begins anew.
    pub output: PathBuf,
    /// Where its standard output goes; `None`: to ours.
    pub stdout: Option<PathBuf>,
    /// Hash of all that the step reads.
    pub key: String,
}

/// Where a pipeline puts what it makes.
#[derive(Debug, Clone)]
pub(crate) struct Layout {
    pub(crate) config: PathBuf,
    pub(crate) logs: PathBuf,
    pub(crate) dataset: PathBuf,
    pub(crate) ingest_report: PathBuf,
    pub(crate) validation: PathBuf,
    pub(crate) page: PathBuf,
    pub(crate) run: PathBuf,
    pub(crate) plan: PathBuf,
    pub(crate) diagnosis: PathBuf,
    pub(crate) ledger: PathBuf,
    pub(crate) lock: PathBuf,
}

impl Layout {
    pub(crate) fn of(out: &Path) -> Layout {
        Layout {
            config: out.join("pipeline.toml"),
            logs: out.join("logs"),
            dataset: out.join("dataset"),
            ingest_report: out.join("ingest.json"),
            validation: out.join("validation.json"),
            page: out.join("dataset.html"),
            run: out.join("run"),
            plan: out.join("plan"),
            diagnosis: out.join("diagnose"),
            ledger: out.join("pipeline.json"),
            lock: out.join("pipeline.lock"),
        }
    }
}

/// Returns the steps that a pipeline has, in order.
///
/// `logs` are the logs of a user; without them the pipeline's `[sim]` records some.
///
/// # Errors
///
/// A section is missing that the steps need, or there are no logs, or a log cannot be looked at.
pub fn plan_steps(pipeline: &Pipeline, out: &Path, logs: &[PathBuf]) -> Result<Vec<Step>, PipelineError> {
    let layout = Layout::of(out);
    let mut steps = Vec::new();
    let mut key = Key::new();
    let missing = |name| PipelineError::MissingSection { path: pipeline.path.clone(), name };

    let inputs = if logs.is_empty() {
        if !pipeline.has("sim") {
            return Err(PipelineError::NoLogs { path: pipeline.path.clone() });
        }
        key.add(&pipeline.text_of(&["sim"]));
        steps.push(collect(&layout, key.digest()));
        vec![layout.logs.clone()]
    } else {
        for log in logs {
            key.add_file(log)?;
        }
        logs.to_vec()
    };

    if !pipeline.has("ingest") {
        return Err(missing("ingest"));
    }
    key.add(&pipeline.text_of(&["ingest"]));
    for file in pipeline.contract_files() {
        key.add_file(&file)?;
    }
    steps.push(ingest(&layout, &inputs, key.digest()));
    steps.extend(look(&layout, &key));
    if pipeline.has("train") {
        if let Some(name) = ["loader", "model", "objectives"].into_iter().find(|name| !pipeline.has(name)) {
            return Err(missing(name));
        }
        key.add(&pipeline.text_of(&["loader", "model", "objectives", "train"]));
        steps.push(train(&layout, key.digest()));
        if let Some(eval) = pipeline.document.get("eval") {
            let with = |part: &str| {
                let mut key = Key(key.0.clone());
                key.add(&eval.get(part).map(toml::Value::to_string).unwrap_or_default());
                key.digest()
            };
            steps.extend(eval.get("plan").map(|_| plan(&layout, with("plan"))));
            steps.push(diagnose(&layout, with("diagnose")));
        }
    }
    Ok(steps)
}

fn collect(layout: &Layout, key: String) -> Step {
    let mut arguments: Vec<OsString> = ["sim", "collect", "--config"].map(OsString::from).to_vec();
    arguments.extend([layout.config.clone().into(), "--out".into(), layout.logs.clone().into()]);
    Step {
        name: StepName::Collect,
        what: "a simulator's episodes to logs".to_owned(),
        arguments,
        resume: None,
        output: layout.logs.clone(),
        stdout: None,
        key,
    }
}

fn ingest(layout: &Layout, inputs: &[PathBuf], key: String) -> Step {
    let mut arguments: Vec<OsString> = ["ingest", "run", "--config"].map(OsString::from).to_vec();
    arguments.extend([layout.config.clone().into(), "--out".into(), layout.dataset.clone().into()]);
    arguments.extend(["--report".into(), layout.ingest_report.clone().into()]);
    arguments.extend(inputs.iter().map(|path| path.clone().into_os_string()));
    Step {
        name: StepName::Ingest,
        what: "logs to a dataset".to_owned(),
        arguments,
        resume: Some(vec!["--resume".into()]),
        output: layout.dataset.clone(),
        stdout: None,
        key,
    }
}

fn look(layout: &Layout, key: &Key) -> [Step; 2] {
    let data: OsString = layout.dataset.clone().into();
    let validate = Step {
        name: StepName::Validate,
        what: "rules of the dataset".to_owned(),
        arguments: vec!["data".into(), "validate".into(), data.clone(), "--format".into(), "json".into()],
        resume: None,
        output: layout.validation.clone(),
        stdout: Some(layout.validation.clone()),
        key: key.digest(),
    };
    let page = layout.page.clone();
    let describe = Step {
        name: StepName::Describe,
        what: "one page about the dataset".to_owned(),
        arguments: vec!["data".into(), "report".into(), data, "--out".into(), page.clone().into()],
        resume: None,
        output: page,
        stdout: None,
        key: key.digest(),
    };
    [validate, describe]
}

fn train(layout: &Layout, key: String) -> Step {
    let mut arguments: Vec<OsString> = vec!["train".into(), "--config".into(), layout.config.clone().into()];
    arguments.extend(["--data".into(), layout.dataset.clone().into()]);
    arguments.extend(["--out".into(), layout.run.clone().into()]);
    Step {
        name: StepName::Train,
        what: "dataset to a model".to_owned(),
        arguments,
        resume: Some(vec!["--resume".into()]),
        output: layout.run.clone(),
        stdout: None,
        key,
    }
}

fn plan(layout: &Layout, key: String) -> Step {
    evaluate(layout, StepName::Plan, "plan", "model and floors on the same problems", &layout.plan, key)
}

fn diagnose(layout: &Layout, key: String) -> Step {
    evaluate(layout, StepName::Diagnose, "diagnose", "what the latents hold", &layout.diagnosis, key)
}

fn evaluate(layout: &Layout, name: StepName, verb: &str, what: &str, output: &Path, key: String) -> Step {
    let mut arguments: Vec<OsString> = vec!["eval".into(), verb.into(), layout.run.clone().into()];
    arguments.extend(["--config".into(), layout.config.clone().into()]);
    arguments.extend(["--data".into(), layout.dataset.clone().into(), "--out".into(), output.into()]);
    Step {
        name,
        what: what.to_owned(),
        arguments,
        resume: None,
        output: output.to_owned(),
        stdout: None,
        key,
    }
}

/// How deep folders of logs are looked into; LeRobot's have three levels.
const MAX_DEPTH: usize = 8;

/// A hash that grows with what is read, step by step: the key of a step covers all steps before it.
struct Key(blake3::Hasher);

impl Key {
    fn new() -> Key {
        let mut key = Key(blake3::Hasher::new());
        key.add(env!("CARGO_PKG_VERSION"));
        key.add(&SECTIONS.join(","));
        key
    }

    fn add(&mut self, text: &str) {
        self.0.update(&(text.len() as u64).to_le_bytes());
        self.0.update(text.as_bytes());
    }

    /// Adds a log, or a folder of them, by name, length and time of change: hashing terabytes to find out that nothing
    /// changed helps nobody, and the same log by another path is the same log.
    fn add_file(&mut self, path: &Path) -> Result<(), PipelineError> {
        let read = |source| PipelineError::Read { path: path.to_owned(), source };
        // `logs/.` and `logs` are one folder.
        let name = path.canonicalize().map_err(read)?;
        let name = name.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let metadata = std::fs::metadata(path).map_err(read)?;
        if !metadata.is_dir() {
            self.add_stamp(&name, &metadata);
            return Ok(());
        }
        self.add(&name);
        self.add_folder(path, MAX_DEPTH)
    }

    fn add_folder(&mut self, path: &Path, depth: usize) -> Result<(), PipelineError> {
        let read = |source| PipelineError::Read { path: path.to_owned(), source };
        let mut entries =
            std::fs::read_dir(path).map_err(read)?.collect::<Result<Vec<_>, _>>().map_err(read)?;
        entries.sort_by_key(std::fs::DirEntry::file_name);
        self.add(&entries.len().to_string());
        for entry in entries {
            let metadata = entry.metadata().map_err(read)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if metadata.is_dir() && depth > 0 {
                self.add(&name);
                self.add_folder(&entry.path(), depth - 1)?;
            } else {
                self.add_stamp(&name, &metadata);
            }
        }
        Ok(())
    }

    fn add_stamp(&mut self, name: &str, metadata: &std::fs::Metadata) {
        let changed =
            metadata.modified().ok().and_then(|time| time.duration_since(std::time::UNIX_EPOCH).ok());
        let changed_ns = changed.map_or(0, |time| time.as_nanos());
        self.add(&format!("{name} {} {changed_ns}", metadata.len()));
    }

    fn digest(&self) -> String {
        self.0.finalize().to_hex()[..32].to_owned()
    }
}
