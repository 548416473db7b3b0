//! `gawm-loader clean`

use clap::{Args, ValueEnum};
use serde_json::json;

use super::{Failure, Global, print};

/// Arguments of `clean`.
#[derive(Debug, Args)]
pub(crate) struct CleanArgs {
    /// Form of the result
    #[arg(long, value_enum, default_value_t = Format::Text)]
    format: Format,
}

/// Form of a result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// Lines for people.
    Text,
    /// One JSON object.
    Json,
}

/// Runs the command.
pub(crate) fn run(args: &CleanArgs, global: &Global) -> Result<(), Failure> {
    let place = global.place();
    let report = place.clean()?;
    let text = match args.format {
        Format::Json => {
            let report = json!({
                "removed": report.removed,
                "alive": report.alive,
                "files": report.files,
                "bytes": report.bytes,
            });
            format!("{report}\n")
        }
        Format::Text => {
            let list = |names: &[String]| if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            format!(
                "removed: {} ({} files, {} bytes of shared memory)\nin use: {}\n",
                list(&report.removed),
                report.files,
                report.bytes,
                list(&report.alive)
            )
        }
    };
    print(&text);
    Ok(())
}
