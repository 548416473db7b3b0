//! Whole CDR and ROS 1 messages as JSON, for people.

use serde_json::{Map, Value};

use super::super::error::DecodeError;
use super::super::schema::{Base, Field, Many, Prim, TypeTable};
use super::super::to_json::number_to_json;
use super::program::Layouts;
use super::reader::Reader;
use super::run::{check_end, open_cdr};

/// Decodes a CDR message; of each array at most `max_items` elements are kept.
pub(crate) fn cdr_to_json(types: &TypeTable, payload: &[u8], max_items: usize) -> Result<Value, DecodeError> {
    let (body, big) = open_cdr(payload)?;
    let decode = |wide| {
        if big {
            to_json::<true, true>(types, Reader::new(body, 4, wide), max_items)
        } else {
            to_json::<true, false>(types, Reader::new(body, 4, wide), max_items)
        }
    };
    let first = decode(4);
    let has_wide = types.structs.iter().flat_map(|s| &s.fields).any(|f| f.base == Base::Prim(Prim::WideText));
    if has_wide && first.is_err() { decode(2).or(first) } else { first }
}

/// Decodes a ROS 1 message.
pub(crate) fn ros1_to_json(
    types: &TypeTable,
    payload: &[u8],
    max_items: usize,
) -> Result<Value, DecodeError> {
    to_json::<false, false>(types, Reader::new(payload, 0, 4), max_items)
}

fn to_json<const ALIGN: bool, const BIG: bool>(
    types: &TypeTable,
    mut reader: Reader<'_, ALIGN, BIG>,
    max_items: usize,
) -> Result<Value, DecodeError> {
    if types.root().fields.is_empty() && reader.remaining() == 0 {
        return Ok(Value::Object(Map::new()));
    }
    let layouts = Layouts::new(types, ALIGN);
    let value = Whole { types, layouts: &layouts, max_items }.structure(types.root, &mut reader)?;
    check_end(&reader)?;
    Ok(value)
}

struct Whole<'t> {
    types: &'t TypeTable,
    layouts: &'t Layouts,
    max_items: usize,
}

impl Whole<'_> {
    fn structure<const ALIGN: bool, const BIG: bool>(
        &self,
        index: usize,
        reader: &mut Reader<'_, ALIGN, BIG>,
    ) -> Result<Value, DecodeError> {
        let item = &self.types.structs[index];
        if item.fields.is_empty() && ALIGN {
            reader.skip(1)?;
        }
        let mut object = Map::new();
        for field in &item.fields {
            object.insert(field.name.clone(), self.field(field, reader)?);
        }
        Ok(Value::Object(object))
    }

    fn field<const ALIGN: bool, const BIG: bool>(
        &self,
        field: &Field,
        reader: &mut Reader<'_, ALIGN, BIG>,
    ) -> Result<Value, DecodeError> {
        if field.many == Many::One {
            return self.one(field.base, reader);
        }
        let min_size = self.layouts.base_min(field.base);
        let count = reader.count(field.many, min_size)?;
        let mut items = Vec::with_capacity(count.min(self.max_items).min(1024));
        for i in 0..count {
            let value = self.one(field.base, reader)?;
            if i < self.max_items {
                items.push(value);
            } else if min_size == 0 {
                break; // Elements of no size: nothing is left to be read.
            }
        }
        if count > self.max_items {
            items.push(Value::String(format!("... {} more", count - self.max_items)));
        }
        Ok(Value::Array(items))
    }

    fn one<const ALIGN: bool, const BIG: bool>(
        &self,
        base: Base,
        reader: &mut Reader<'_, ALIGN, BIG>,
    ) -> Result<Value, DecodeError> {
        Ok(match base {
            Base::Struct(index) => self.structure(index, reader)?,
            Base::Prim(Prim::Text) => Value::String(reader.text()?.into_owned()),
            Base::Prim(Prim::WideText) => Value::String(reader.wide_text()?),
            Base::Prim(prim) => number_to_json(reader.number(prim)?),
        })
    }
}
