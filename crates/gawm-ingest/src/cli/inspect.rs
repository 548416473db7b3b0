//! `gawm-ingest inspect`.

use std::io::{BufWriter, Write as _};
use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::suggest::library;
use super::{Exit, Failure, Global, print};
use crate::inspect::{inspect, render_text};
use crate::log::{OpenOptions, Severity};
use crate::records::{RecordsError, write_records};
use crate::suggest::DecodingProbe;

/// Arguments of `inspect`.
#[derive(Debug, Args)]
#[command(after_long_help = "Examples:
  gawm-ingest inspect run.mcap
  gawm-ingest inspect --format json logs/ > logs.json")]
pub(crate) struct InspectArgs {
    /// MCAP, HDF5 and npz files, rosbag2 and LeRobot folders, or folders of them
    #[arg(value_name = "LOG", required = true)]
    logs: Vec<PathBuf>,
    /// How to print
    #[arg(long, value_enum, default_value_t = Format::Text)]
    format: Format,
    /// Print every record of one file as JSON, as the MCAP conformance tests do
    #[arg(long)]
    records: bool,
    /// Folder of .msg files for channels without a schema
    #[arg(long, value_name = "DIR")]
    schemas: Vec<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    /// For people.
    Text,
    /// For programs.
    Json,
}

/// Runs the command.
pub(crate) fn run(args: &InspectArgs, global: &Global) -> Result<Exit, Failure> {
    if args.records {
        return records(args);
    }
    let probe = DecodingProbe { library: library(&args.schemas)? };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(global.jobs())
        .build()
        .map_err(|error| Failure { code: 1, error: anyhow::Error::new(error), hint: None })?;
    let report = pool.install(|| inspect(&args.logs, &OpenOptions::default(), &probe));
    if args.format == Format::Json {
        let text = serde_json::to_string_pretty(&report).map_err(|error| Failure {
            code: 1,
            error: anyhow::Error::new(error),
            hint: None,
        })?;
        print(&(text + "\n"))?;
    } else {
        print(&render_text(&report))?;
    }
    if report.files.is_empty()
        && let Some(refused) = report.refused.first()
    {
        return Err(Failure {
            code: 1,
            error: anyhow::anyhow!("{}", refused.error),
            hint: refused.hint.clone(),
        });
    }
    Ok(if report.has_loss() || !report.refused.is_empty() { Exit::Loss } else { Exit::Clean })
}

fn records(args: &InspectArgs) -> Result<Exit, Failure> {
    let [path] = args.logs.as_slice() else {
        return Err(Failure {
            code: 2,
            error: anyhow::anyhow!("--records prints one file, got {}", args.logs.len()),
            hint: None,
        });
    };
    let mut out = BufWriter::new(std::io::stdout().lock());
    let written = write_records(path, &OpenOptions::default(), &mut out).and_then(|damage| {
        out.flush()?;
        Ok(damage)
    });
    match written {
        Ok(damage) if damage.iter().any(|found| found.kind.severity() == Severity::Loss) => Ok(Exit::Loss),
        Ok(_) => Ok(Exit::Clean),
        // A reader that has gone away (`| head`) is no error.
        Err(RecordsError::Write(error)) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(Exit::Clean),
        Err(RecordsError::Open(error)) => {
            Err(Failure { code: 1, hint: error.hint(), error: anyhow::Error::new(error) })
        }
        Err(error) => Err(Failure { code: 1, error: anyhow::Error::new(error), hint: None }),
    }
}
