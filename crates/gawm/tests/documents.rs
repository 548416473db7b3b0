//! `docs/cli.md`: every command with its help. Written anew with `GAWM_BLESS=1`.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

const HEAD: &str = "# Command line

One program, `gawm`, holds all others: `gawm ingest ...` is `gawm-ingest ...`, and so on.
Each command with its help; written and checked by a test:

    GAWM_BLESS=1 cargo test -p gawm --test documents

Exit codes of all programs: 0 clean; 1 failed, nothing usable written; 2 bad arguments or configuration; 3 finished, but a mapped stream lost data, an input was refused, or a check failed at the asked level; 130 interrupted.
Results go to standard output, what is said on the way to standard error.
";

/// The help of a command, as a terminal of 100 columns shows it.
fn help(path: &[String]) -> String {
    let output =
        Command::new(env!("CARGO_BIN_EXE_gawm")).args(path).arg("--help").env_remove("COLUMNS").output();
    let output = output.unwrap();
    assert!(output.status.success(), "{path:?} --help: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Names in the part "Commands:" of a help.
fn commands(help: &str) -> Vec<String> {
    let part =
        help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let name = |line: &str| line.strip_prefix("  ").filter(|line| !line.starts_with(' ')).map(first_word);
    part.filter_map(name).filter(|name| name != "help").collect()
}

fn first_word(line: &str) -> String {
    line.split(' ').next().unwrap().to_owned()
}

fn describe(path: &mut Vec<String>, page: &mut String) {
    let text = help(path);
    let name: Vec<&str> = std::iter::once("gawm").chain(path.iter().map(String::as_str)).collect();
    let lines: Vec<&str> = text.lines().map(str::trim_end).collect();
    write!(page, "\n## `{}`\n\n```text\n{}\n```\n", name.join(" "), lines.join("\n").trim_end()).unwrap();
    for command in commands(&text) {
        path.push(command);
        describe(path, page);
        path.pop();
    }
}

#[test]
fn the_page_of_the_command_line_is_current() {
    let mut made = HEAD.to_owned();
    describe(&mut Vec::new(), &mut made);
    for command in ["gawm ingest run", "gawm data validate", "gawm train", "gawm eval plan", "gawm run"] {
        assert!(made.contains(&format!("\n## `{command}`\n")), "{command} is missing");
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/cli.md");
    if std::env::var_os("GAWM_BLESS").is_some() {
        std::fs::write(&path, &made).unwrap();
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(made == kept, "docs/cli.md differs from the programs' help; GAWM_BLESS=1 writes it anew");
}
