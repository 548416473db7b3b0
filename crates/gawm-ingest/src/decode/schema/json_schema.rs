//! JSON Schema as a [`TypeTable`]: what it declares, for suggestions; messages may hold more.

use serde_json::{Map, Value};

use super::{Base, Field, Many, Prim, StructType, TypeTable, Wire};

/// Deepest nesting that is read.
const MAX_DEPTH: usize = 32;

/// Most structs of one schema.
const MAX_STRUCTS: usize = 10_000;

/// Returns the table of a message of which nothing is declared.
pub(crate) fn open() -> TypeTable {
    TypeTable { structs: vec![StructType::default()], root: 0 }
}

/// Reads the properties that a schema declares. An empty text declares nothing.
pub(crate) fn type_table(name: &str, data: &[u8]) -> Result<TypeTable, String> {
    if data.iter().all(u8::is_ascii_whitespace) {
        return Ok(open());
    }
    let schema: Value = serde_json::from_slice(data).map_err(|e| format!("not JSON: {e}"))?;
    let Value::Object(root) = &schema else { return Ok(open()) };
    let mut builder = Builder { root, table: TypeTable::default() };
    builder.table.structs.push(StructType {
        name: name.to_owned(),
        fields: Vec::new(),
        ..StructType::default()
    });
    builder.fill(0, root, 0);
    Ok(builder.table)
}

struct Builder<'a> {
    root: &'a Map<String, Value>,
    table: TypeTable,
}

impl<'a> Builder<'a> {
    fn fill(&mut self, index: usize, schema: &'a Map<String, Value>, depth: usize) {
        let schema = self.follow(schema);
        let Some(Value::Object(properties)) = schema.get("properties") else { return };
        for (name, property) in properties {
            let Value::Object(property) = property else { continue };
            let Some((base, many)) = self.kind(name, property, depth + 1) else { continue };
            let field = Field { name: name.clone(), base, many, wire: Wire::default() };
            self.table.structs[index].fields.push(field);
        }
    }

    /// Follows one local `$ref`.
    fn follow(&self, schema: &'a Map<String, Value>) -> &'a Map<String, Value> {
        let target =
            schema.get("$ref").and_then(Value::as_str).and_then(|r| r.strip_prefix("#/")).and_then(|path| {
                path.split('/').try_fold(self.root, |at, part| at.get(part).and_then(Value::as_object))
            });
        target.unwrap_or(schema)
    }

    fn kind(&mut self, name: &str, schema: &'a Map<String, Value>, depth: usize) -> Option<(Base, Many)> {
        if depth > MAX_DEPTH || self.table.structs.len() > MAX_STRUCTS {
            return None;
        }
        let schema = self.follow(schema);
        let declared = schema.get("type");
        let kind = match declared {
            Some(Value::String(kind)) => kind.as_str(),
            Some(Value::Array(kinds)) => kinds.iter().filter_map(Value::as_str).find(|k| *k != "null")?,
            _ if schema.contains_key("properties") => "object",
            _ if schema.contains_key("items") => "array",
            _ => return None,
        };
        Some(match kind {
            "number" => (Base::Prim(Prim::F64), Many::One),
            "integer" => (Base::Prim(Prim::I64), Many::One),
            "boolean" => (Base::Prim(Prim::Bool), Many::One),
            "string" if schema.get("contentEncoding").and_then(Value::as_str) == Some("base64") => {
                (Base::Prim(Prim::Bytes), Many::One)
            }
            "string" => (Base::Prim(Prim::Text), Many::One),
            "object" => {
                let index = self.table.structs.len();
                self.table.structs.push(StructType {
                    name: name.to_owned(),
                    fields: Vec::new(),
                    ..StructType::default()
                });
                self.fill(index, schema, depth);
                (Base::Struct(index), Many::One)
            }
            "array" => {
                let items = schema.get("items").and_then(Value::as_object)?;
                let (base, inner) = self.kind(name, items, depth + 1)?;
                if inner != Many::One {
                    return None; // Arrays of arrays have no place in the table; paths reach them all the same.
                }
                let fixed =
                    |key: &str| schema.get(key).and_then(Value::as_u64).and_then(|n| usize::try_from(n).ok());
                let many = match (fixed("minItems"), fixed("maxItems")) {
                    (Some(least), Some(most)) if least == most => Many::Fixed(least),
                    _ => Many::Dynamic,
                };
                (base, many)
            }
            _ => return None,
        })
    }
}
