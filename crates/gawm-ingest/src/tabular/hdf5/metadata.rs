//! Types and attributes, translated from the library's terms into ours.

use hdf5_reader::error::{ByteOrder, Error};
use hdf5_reader::{Dataset, Datatype, StringPadding, StringSize, VarLenKind};

use crate::tabular::column::{Attribute, AttributeValue, Dtype, Values};
use crate::tabular::raw::{self, RawForm, RawType};

/// An attribute beyond this size is described instead of read.
const MAX_ATTRIBUTE_BYTES: usize = 1 << 20;

/// Returns the error that others were wrapped around.
pub(crate) fn innermost(mut error: &Error) -> &Error {
    while let Error::Context { source, .. } = error {
        error = source;
    }
    error
}

/// Returns the extent; one without elements (a null dataspace) has the extent 0.
pub(crate) fn shape(dataset: &Dataset) -> Vec<u64> {
    match (dataset.shape(), dataset.num_elements()) {
        ([], Ok(0)) => vec![0],
        (shape, _) => shape.to_vec(),
    }
}

/// Returns how elements are stored, or what they are if they are no column here.
pub(crate) fn raw_type(datatype: &Datatype, reference_bytes: usize) -> Result<RawType, String> {
    let number = |dtype, size: u8, order: &ByteOrder| {
        let big_endian = matches!(order, ByteOrder::BigEndian);
        Ok(RawType { dtype, item_bytes: usize::from(size), big_endian, form: RawForm::Number })
    };
    let text = |form, item_bytes| Ok(RawType { dtype: Dtype::Text, item_bytes, big_endian: false, form });
    match datatype {
        Datatype::FixedPoint { size, signed, byte_order } => {
            let dtype = integer(*size, *signed).ok_or_else(|| format!("integers of {size} bytes"))?;
            number(dtype, *size, byte_order)
        }
        Datatype::Bitfield { size, byte_order } => {
            let dtype = integer(*size, false).ok_or_else(|| format!("bit fields of {size} bytes"))?;
            number(dtype, *size, byte_order)
        }
        Datatype::FloatingPoint { size, byte_order } => match size {
            2 => number(Dtype::F16, 2, byte_order),
            4 => number(Dtype::F32, 4, byte_order),
            8 => number(Dtype::F64, 8, byte_order),
            size => Err(format!("floating-point numbers of {size} bytes")),
        },
        Datatype::Enum { base, members } => {
            let raw = raw_type(base, reference_bytes)?;
            let is_bool = raw.item_bytes == 1
                && members.len() == 2
                && members
                    .iter()
                    .all(|m| matches!((m.name.as_str(), &m.value[..]), ("FALSE", [0]) | ("TRUE", [1])));
            Ok(if is_bool { RawType { dtype: Dtype::Bool, ..raw } } else { raw })
        }
        Datatype::String { size: StringSize::Fixed(0), .. } => Err("texts of 0 bytes".to_owned()),
        Datatype::String { size: StringSize::Fixed(len), padding, .. } => match padding {
            StringPadding::SpacePad => text(RawForm::SpacePadded, *len as usize),
            StringPadding::NullTerminate | StringPadding::NullPad => text(RawForm::NulPadded, *len as usize),
        },
        Datatype::String { size: StringSize::Variable, .. } => text(RawForm::HeapReference, reference_bytes),
        Datatype::VarLen { kind: VarLenKind::String, .. } => text(RawForm::HeapReference, reference_bytes),
        Datatype::VarLen { .. } => Err("sequences of variable length".to_owned()),
        Datatype::Compound { fields, .. } => {
            let names: Vec<&str> = fields.iter().take(8).map(|f| f.name.as_str()).collect();
            Err(format!("records with the fields {}", names.join(", ")))
        }
        Datatype::Array { dims, .. } => Err(format!("arrays of {dims:?} in every element")),
        Datatype::Opaque { .. } => Err("opaque bytes".to_owned()),
        Datatype::Reference { .. } => Err("references to other objects".to_owned()),
    }
}

fn integer(size: u8, signed: bool) -> Option<Dtype> {
    Some(match (size, signed) {
        (1, false) => Dtype::U8,
        (1, true) => Dtype::I8,
        (2, false) => Dtype::U16,
        (2, true) => Dtype::I16,
        (4, false) => Dtype::U32,
        (4, true) => Dtype::I32,
        (8, false) => Dtype::U64,
        (8, true) => Dtype::I64,
        _ => return None,
    })
}

/// Translates attributes, sorted by name.
pub(crate) fn attributes(attributes: &[hdf5_reader::Attribute]) -> Vec<Attribute> {
    let mut out: Vec<Attribute> =
        attributes.iter().map(|a| Attribute { name: a.name.clone(), value: value(a) }).collect();
    out.sort_by(|a, b| a.name.cmp(&b.name));
    out
}

fn value(attribute: &hdf5_reader::Attribute) -> AttributeValue {
    if attribute.raw_data.len() > MAX_ATTRIBUTE_BYTES {
        return AttributeValue::Unsupported(format!("{} bytes", attribute.raw_data.len()));
    }
    let is_scalar = attribute.shape.is_empty();
    let values = match raw_type(&attribute.datatype, 0) {
        Ok(RawType { dtype: Dtype::Text, .. }) => match attribute.read_strings() {
            Ok(texts) => Values::Text(texts),
            Err(e) => return AttributeValue::Unsupported(e.to_string()),
        },
        Ok(raw) => {
            let whole = attribute.raw_data.len() / raw.item_bytes.max(1) * raw.item_bytes;
            match raw::decode(&attribute.raw_data[..whole], raw) {
                Ok(values) => values,
                Err(e) => return AttributeValue::Unsupported(e.detail),
            }
        }
        Err(got) => return AttributeValue::Unsupported(got),
    };
    from_values(values, is_scalar)
}

fn from_values(values: Values, is_scalar: bool) -> AttributeValue {
    match values {
        Values::Text(mut texts) if is_scalar && texts.len() == 1 => AttributeValue::Text(texts.remove(0)),
        Values::Text(texts) => AttributeValue::Texts(texts),
        Values::Bool(flags) if is_scalar && flags.len() == 1 => AttributeValue::Flag(flags[0]),
        values => match (values.to_i64(), values.to_f64()) {
            (Some(integers), _) if is_scalar && integers.len() == 1 => AttributeValue::Integer(integers[0]),
            (_, Some(numbers)) if is_scalar && numbers.len() == 1 => AttributeValue::Number(numbers[0]),
            (_, Some(numbers)) => AttributeValue::Numbers(numbers),
            (_, None) => AttributeValue::Unsupported("no value".to_owned()),
        },
    }
}
