//! From text to a checked [`Config`], and back to the TOML that lies beside a result.

use gawm_model::{ModelConfig, Objectives, Term};
use gawm_schema::pipeline::{Override, SECTIONS, unknown_section};
use serde::Deserialize;
use toml::Value;

use super::{Config, ConfigError, TrainConfig, objectives};

/// The shape of a file, for errors with line and column; its values are read again when overrides are applied.
#[derive(Debug, Deserialize)]
struct Sections {
    #[serde(default, rename = "train")]
    _train: TrainConfig,
}

impl Config {
    /// Reads the text of a pipeline file; `place` names it in errors.
    ///
    /// # Errors
    ///
    /// - as [`Config::read`].
    pub fn parse(place: &str, text: &str, overrides: &[Override]) -> Result<Config, ConfigError> {
        let syntax = |error: toml::de::Error| ConfigError::Syntax {
            place: place.to_owned(),
            message: error.to_string(),
        };
        let mut table: toml::Table = text.parse().map_err(syntax)?;
        // Parsed from the text first: this way alone knows line and column.
        toml::from_str::<Sections>(text).map_err(syntax)?;
        for change in overrides {
            change.apply(&mut table)?;
        }
        if let Some(name) = unknown_section(&table) {
            return Err(ConfigError::Section {
                place: place.to_owned(),
                message: format!("unknown section {name:?}: expected one of {SECTIONS:?}"),
            });
        }

        let mut config = Config {
            model: model(place, &table)?,
            objectives: objectives(place, section(place, &table, "objectives")?)?,
            train: train(place, &table)?,
            loaders: loaders(place, &table)?,
            table,
        };
        let values = config.train.refused();
        if !values.is_empty() {
            return Err(ConfigError::Values { place: place.to_owned(), values });
        }
        config.objectives.configure(&mut config.model);
        Ok(config)
    }

    /// Returns how many batches may have been made before they are asked for.
    pub(crate) fn queued(&self) -> u64 {
        // The loaders check the field; here it only says how long a queue takes to run empty.
        let slots =
            self.table.get("loader").and_then(|loader| loader.get("slots")).and_then(Value::as_integer);
        u64::from(self.loaders) * slots.and_then(|slots| u64::try_from(slots).ok()).unwrap_or(3).min(1024)
    }

    /// Returns the whole configuration as TOML, every field of our sections written out.
    pub fn to_toml(&self) -> String {
        let table = |table: Result<toml::Table, toml::ser::Error>| {
            Value::Table(table.expect("structs of numbers and names become TOML"))
        };
        let mut all = self.table.clone();
        all.insert("model".to_owned(), table(toml::Table::try_from(&self.model)));
        all.insert("objectives".to_owned(), Value::Table(objectives_table(&self.objectives)));
        all.insert("train".to_owned(), table(toml::Table::try_from(&self.train)));
        all.to_string()
    }
}

fn section(place: &str, table: &toml::Table, name: &str) -> Result<toml::Table, ConfigError> {
    match table.get(name) {
        None => Ok(toml::Table::new()),
        Some(Value::Table(section)) => Ok(section.clone()),
        Some(other) => Err(ConfigError::Section {
            place: place.to_owned(),
            message: format!("{name}: expected a section, got {}", other.type_str()),
        }),
    }
}

fn model(place: &str, table: &toml::Table) -> Result<ModelConfig, ConfigError> {
    let table = section(place, table, "model")?;
    ModelConfig::from_table(table).map_err(|error| ConfigError::Section {
        place: format!("{place}, [model]"),
        message: error.to_string(),
    })
}

fn train(place: &str, table: &toml::Table) -> Result<TrainConfig, ConfigError> {
    let table = section(place, table, "train")?;
    table.try_into().map_err(|error: toml::de::Error| ConfigError::Section {
        place: format!("{place}, [train]"),
        message: error.message().to_owned(),
    })
}

fn loaders(place: &str, table: &toml::Table) -> Result<u16, ConfigError> {
    let value = section(place, table, "loader")?.get("loaders").cloned().unwrap_or(Value::Integer(1));
    match value
        .as_integer()
        .and_then(|count| u16::try_from(count).ok())
        .filter(|count| (1..=1024).contains(count))
    {
        Some(count) => Ok(count),
        None => Err(ConfigError::Section {
            place: format!("{place}, [loader]"),
            message: format!("loaders: expected 1 to 1024, got {value}"),
        }),
    }
}

/// The table in the words that [`Objectives::from_table`] reads.
fn objectives_table(objectives: &Objectives) -> toml::Table {
    let name = |value: Value| (value.as_str().map(str::to_owned)).map_or(value, Value::String);
    let enumeration = |value: Result<Value, toml::ser::Error>| name(value.expect("a name becomes TOML"));
    let mut table = toml::Table::new();
    let monitored = objectives.monitored.iter().map(|term| Value::from(Term::name(*term)));
    table.insert("monitored".to_owned(), Value::Array(monitored.collect()));
    table.insert("control".to_owned(), enumeration(Value::try_from(objectives.control)));
    table.insert("sigreg-projections".to_owned(), Value::Integer(objectives.sigreg_projections as i64));
    if let Some(input) = objectives.inverse_input {
        table.insert("inverse-input".to_owned(), enumeration(Value::try_from(input)));
    }
    let weights = objectives.rows().map(|(term, weight)| (term.name().to_owned(), Value::Float(weight)));
    table.insert("weights".to_owned(), Value::Table(weights.collect()));
    table
}
