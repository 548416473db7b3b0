//! JSON Schemas of the files that people write, made of the structs that read them: an editor completes names, shows
//! what they mean and marks what no program would take.
//!
//! The folder `schemas/` holds them as `NAME.schema.json`; a test keeps them current.

use schemars::JsonSchema;
use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};

/// Names of the schemas, with what they describe.
pub const NAMES: [(&str, &str); 3] = [
    ("pipeline", "a pipeline: one section per program"),
    ("contract", "a contract: how logs become a dataset, in a file of its own"),
    ("task", "a task schema: what the logs of a task record"),
];

/// Returns the JSON Schema (draft 2020-12) of a name of [`NAMES`].
pub fn schema(name: &str) -> Option<Value> {
    let (_, title) = NAMES.into_iter().find(|(known, _)| *known == name)?;
    let mut schema = match name {
        "pipeline" => pipeline(),
        "contract" => of::<gawm_ingest::contract::Contract>(),
        _ => of::<gawm_ingest::contract::TaskSchema>(),
    };
    let body = schema.as_object_mut()?;
    body.shift_insert(0, "$schema".to_owned(), json!("https://json-schema.org/draft/2020-12/schema"));
    body.insert("title".to_owned(), json!(title));
    Some(schema)
}

fn pipeline() -> Value {
    let mut model = of::<gawm_model::ModelConfig>();
    leave_out(&mut model);
    model["properties"]["preset"] = json!({
        "description": "Sizes that the fields below differ from; tiny-14, the published model, by default.",
        "enum": gawm_model::PRESETS,
    });
    let mut objectives = of::<gawm_model::objective::ObjectivesTable>();
    objectives["properties"]["preset"]["enum"] = json!(gawm_model::objective::PRESETS);
    let sections = [
        of::<gawm_sim::cli::SimConfig>(),
        of::<gawm_ingest::contract::Contract>(),
        of::<gawm_loader::LoaderConfig>(),
        model,
        objectives,
        of::<gawm_train::config::TrainConfig>(),
        of::<gawm_eval::config::EvalConfig>(),
    ];
    let (mut properties, mut definitions) = (Map::new(), Map::new());
    for (name, mut section) in gawm_schema::pipeline::SECTIONS.into_iter().zip(sections) {
        // References count from the root of the file.
        if let Some(Value::Object(named)) =
            section.as_object_mut().and_then(|body| body.shift_remove("$defs"))
        {
            definitions.extend(named);
        }
        properties.insert(name.to_owned(), section);
    }
    json!({ "type": "object", "properties": properties, "additionalProperties": false, "$defs": definitions })
}

fn of<T: JsonSchema>() -> Value {
    let generator = SchemaSettings::draft2020_12().with(|settings| settings.inline_subschemas = true);
    let mut schema = generator.into_generator().into_root_schema_for::<T>().to_value();
    if let Some(body) = schema.as_object_mut() {
        body.shift_remove("$schema");
        body.shift_remove("title");
    }
    drop_null(&mut schema);
    schema
}

/// TOML has no null: a field without a value is not written.
fn drop_null(schema: &mut Value) {
    match schema {
        Value::Object(body) => {
            if let Some(Value::Array(types)) = body.get_mut("type") {
                types.retain(|name| name != "null");
                if let [only] = types.as_slice() {
                    let only = only.clone();
                    body.insert("type".to_owned(), only);
                }
            }
            if body.get("default").is_some_and(Value::is_null) {
                body.shift_remove("default");
            }
            for choice in ["anyOf", "enum"] {
                if let Some(Value::Array(choices)) = body.get_mut(choice) {
                    choices.retain(|one| !one.is_null() && *one != json!({ "type": "null" }));
                }
            }
            if let Some(Value::Array(choices)) = body.get("anyOf")
                && let [Value::Object(only)] = choices.as_slice()
            {
                let only = only.clone();
                body.shift_remove("anyOf");
                for (key, value) in only {
                    body.entry(key).or_insert(value);
                }
            }
            body.values_mut().for_each(drop_null);
        }
        Value::Array(values) => values.iter_mut().for_each(drop_null),
        _ => {}
    }
}

/// Makes every field one that may be left out.
fn leave_out(schema: &mut Value) {
    if let Some(body) = schema.as_object_mut() {
        body.shift_remove("required");
        body.values_mut().for_each(leave_out);
    }
}
