//! Files made of the programs: `docs/cli.md`, every command with its help, and the JSON Schemas of `schemas/`.
//! Written anew with `GAWM_BLESS=1`.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use gawm::schemas::{NAMES, schema};
use serde_json::Value;

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
    check_current("docs/cli.md", &made);
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn check_current(file: &str, made: &str) {
    let path = root().join(file);
    if std::env::var_os("GAWM_BLESS").is_some() {
        std::fs::write(&path, made).unwrap();
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(made == kept, "{file} differs from the programs; GAWM_BLESS=1 writes it anew");
}

/// What a schema says against a TOML file, each with its place.
fn objections(schema: &Value, text: &str) -> Vec<String> {
    let table: toml::Table = text.parse().unwrap();
    let mut found = Vec::new();
    object(&schema["$defs"], schema, &serde_json::to_value(table).unwrap(), "", &mut found);
    found
}

/// Checks a value by the keywords that our schemas have; another one fails the test.
fn object(named: &Value, schema: &Value, value: &Value, place: &str, found: &mut Vec<String>) {
    if let Value::Bool(any) = schema {
        found.extend((!any).then(|| format!("{place}: unknown")));
        return;
    }
    let body = schema.as_object().unwrap();
    let mut expect = |holds: bool, what: String| found.extend((!holds).then(|| format!("{place}: {what}")));
    for (keyword, rule) in body {
        match keyword.as_str() {
            "type" => expect(is_of_type(rule, value), format!("expected {rule}, got {value}")),
            "enum" => expect(rule.as_array().unwrap().contains(value), format!("{value} is none of {rule}")),
            "const" => expect(rule == value, format!("expected {rule}, got {value}")),
            "minimum" | "maximum" => {
                let (bound, number) = (rule.as_f64().unwrap(), value.as_f64().unwrap_or(f64::NAN));
                expect(
                    if keyword == "minimum" { number >= bound } else { number <= bound },
                    rule.to_string(),
                );
            }
            "minItems" | "maxItems" => {
                let (bound, length) = (rule.as_u64().unwrap(), value.as_array().map_or(0, Vec::len) as u64);
                expect(
                    if keyword == "minItems" { length >= bound } else { length <= bound },
                    rule.to_string(),
                );
            }
            "required" => {
                for name in rule.as_array().unwrap() {
                    expect(value.get(name.as_str().unwrap()).is_some(), format!("{name} is missing"));
                }
            }
            "$schema" | "$defs" | "$ref" | "title" | "description" | "default" | "format" => {}
            "properties" | "additionalProperties" | "items" | "anyOf" | "oneOf" => {}
            other => panic!("{place}: keyword {other}"),
        }
    }
    if let Some(name) = body.get("$ref").map(|rule| rule.as_str().unwrap().strip_prefix("#/$defs/").unwrap())
    {
        object(named, &named[name], value, place, found);
    }
    for (name, inner) in value.as_object().into_iter().flatten() {
        let known = body.get("properties").and_then(|properties| properties.get(name));
        if let Some(rule) = known.or(body.get("additionalProperties")) {
            object(named, rule, inner, &format!("{place}.{name}"), found);
        }
    }
    for (index, inner) in value.as_array().into_iter().flatten().enumerate() {
        if let Some(rule) = body.get("items") {
            object(named, rule, inner, &format!("{place}[{index}]"), found);
        }
    }
    for choice in ["anyOf", "oneOf"] {
        let Some(choices) = body.get(choice).and_then(Value::as_array) else { continue };
        let fits = |one: &&Value| {
            let mut against = Vec::new();
            object(named, one, value, place, &mut against);
            against.is_empty()
        };
        let fitting = choices.iter().filter(fits).count();
        if fitting == 0 || (choice == "oneOf" && fitting > 1) {
            found.push(format!("{place}: {value} fits {fitting} of {} forms", choices.len()));
        }
    }
}

fn is_of_type(rule: &Value, value: &Value) -> bool {
    let is = |name: &Value| match name.as_str().unwrap() {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_i64() || value.is_u64(),
        "number" => value.is_number(),
        other => panic!("type {other}"),
    };
    rule.as_array().map_or_else(|| is(rule), |names| names.iter().any(is))
}

/// The TOML files of a folder.
fn files(folder: &str) -> Vec<(PathBuf, String)> {
    let entries = root().join(folder).read_dir().unwrap().map(|entry| entry.unwrap().path());
    let files = entries.filter(|path| path.extension().is_some_and(|extension| extension == "toml"));
    files.map(|path| (path.clone(), std::fs::read_to_string(path).unwrap())).collect()
}

#[test]
fn the_json_schemas_are_current() {
    for (name, _) in NAMES {
        let output = Command::new(env!("CARGO_BIN_EXE_gawm")).args(["schema", name]).output().unwrap();
        check_current(&format!("schemas/{name}.schema.json"), &String::from_utf8(output.stdout).unwrap());
    }
}

#[test]
fn the_schemas_take_what_is_here() {
    let (pipeline, task) = (schema("pipeline").unwrap(), schema("task").unwrap());
    let checked = [("pipelines", pipeline), ("schemas", task)].map(|(folder, schema)| {
        let files = files(folder);
        for (path, text) in &files {
            assert_eq!(objections(&schema, text), [""; 0], "{path:?}");
        }
        files.len()
    });
    assert!(checked.iter().all(|&count| count >= 5), "{checked:?}");
}

#[test]
fn the_schemas_take_what_programs_write_and_no_more() {
    let pipeline = schema("pipeline").unwrap();
    let command = |arguments: &[&str]| {
        let output =
            Command::new(env!("CARGO_BIN_EXE_gawm")).args(arguments).current_dir(root()).output().unwrap();
        assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let config = ["--config", "pipelines/quickstart.toml", "--print-config"];
    for verb in [&["train"][..], &["eval", "plan"], &["loader", "run"], &["sim", "collect"]] {
        let text = command(&[verb, &config].concat());
        assert_eq!(objections(&pipeline, &text), [""; 0], "{verb:?}");
    }
    let contract = command(&["ingest", "run", "--config", "pipelines/quickstart.toml", "--print-config"]);
    let contract = objections(&schema("contract").unwrap(), &contract);
    assert_eq!(contract, [""; 0]);

    for wrong in [
        "[trian]\nsteps = 3",
        "[train]\nstep = 3",
        "[train]\nsteps = \"many\"",
        "[model]\npreset = \"huge\"",
        "[model]\nencoder.dept = 3",
        "[objectives]\npreset = \"x\"",
        "[eval.plan]\nproblem = \"final\"",
        "[[ingest.stream]]\ntopic = \"/a\"",
        "[[ingest.stream]]\nfeature = \"action\"\ngap = \"spilt\"",
        "[loader]\ncompat = 3",
        "[sim]\nroom.spede_px = 3",
    ] {
        assert!(!objections(&pipeline, wrong).is_empty(), "{wrong}");
    }
}
