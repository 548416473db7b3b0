//! What a schema says about its messages, in one form for every schema language.

pub(crate) mod json_schema;
pub(crate) mod proto;
pub(crate) mod ros_idl;
pub(crate) mod ros_library;
pub(crate) mod ros_msg;

/// The types of one schema: a graph of structs, of which one is the message.
#[derive(Clone, Debug, Default)]
pub(crate) struct TypeTable {
    pub(crate) structs: Vec<StructType>,
    /// Index of the message's own type.
    pub(crate) root: usize,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct StructType {
    /// Full name, as the schema language writes it.
    pub(crate) name: String,
    pub(crate) fields: Vec<Field>,
    /// How the type may be extended, where its schema says: of meaning in XCDR2 only.
    pub(crate) extensibility: Option<Extensibility>,
    /// Numbers of the fields in mutable types; empty: their positions.
    pub(crate) member_ids: Vec<u32>,
}

/// How a type may be extended (DDS-XTypes).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Extensibility {
    Final,
    Appendable,
    Mutable,
}

#[derive(Clone, Debug)]
pub(crate) struct Field {
    pub(crate) name: String,
    pub(crate) base: Base,
    pub(crate) many: Many,
    /// How protobuf writes it; of no meaning elsewhere.
    pub(crate) wire: Wire,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Base {
    Prim(Prim),
    /// Index into [`TypeTable::structs`].
    Struct(usize),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Many {
    One,
    Fixed(usize),
    Dynamic,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Prim {
    Bool,
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
    Text,
    WideText,
    /// Protobuf `bytes`, base64 in JSON; arrays of `U8` elsewhere.
    Bytes,
}

/// How protobuf writes a field, and what holds when it is not there.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Wire {
    pub(crate) number: u32,
    pub(crate) zigzag: bool,
    pub(crate) fixed: bool,
    /// The value of an absent scalar; `None` = absence is not a value.
    pub(crate) default: Option<f64>,
}

impl TypeTable {
    pub(crate) fn root(&self) -> &StructType {
        &self.structs[self.root]
    }
}

impl StructType {
    pub(crate) fn find(&self, name: &str) -> Option<usize> {
        self.fields.iter().position(|f| f.name == name)
    }
}

impl Prim {
    /// Returns the size in bytes of a fixed-size scalar as CDR and ROS 1 write it.
    pub(crate) fn size(self) -> Option<usize> {
        match self {
            Self::Bool | Self::I8 | Self::U8 => Some(1),
            Self::I16 | Self::U16 => Some(2),
            Self::I32 | Self::U32 | Self::F32 => Some(4),
            Self::I64 | Self::U64 | Self::F64 => Some(8),
            Self::Text | Self::WideText | Self::Bytes => None,
        }
    }

    pub(crate) fn is_number(self) -> bool {
        self.size().is_some()
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Bool => "bool",
            Self::I8 => "int8",
            Self::U8 => "uint8",
            Self::I16 => "int16",
            Self::U16 => "uint16",
            Self::I32 => "int32",
            Self::U32 => "uint32",
            Self::I64 => "int64",
            Self::U64 => "uint64",
            Self::F32 => "float32",
            Self::F64 => "float64",
            Self::Text => "string",
            Self::WideText => "wstring",
            Self::Bytes => "bytes",
        }
    }
}
