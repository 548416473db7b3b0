//! A plan: what to read from the messages of one channel, compiled once.

use std::borrow::Cow;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

use super::channel::{ChannelSchema, Encoding, SchemaLibrary, Types};
use super::error::{CompileError, DecodeError};
use super::path::{FieldPath, Segment};
use super::resolve::{NANOS, Requests, Resolver, SECONDS, Want};
use super::row::{Decoded, Emit, ExactRow, Held, NumericRow, RowSink, Scalar, Scratch, Value};
use super::schema::{Base, Field, Many, Prim, StructType, TypeTable};
use super::stamp::{StampForm, StampUnit};
use super::transcode::Transcoder;
use super::{json, protobuf, ros};

/// Numbers plans, so that a sink notices when it is used with another one.
static NEXT_PLAN: AtomicU64 = AtomicU64::new(1);

/// Where the stamp of a message stands.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum StampSource {
    /// `header.stamp`, `stamp` or `timestamp` of the message, or of the element that the first field picks.
    #[default]
    Auto,
    /// Nowhere.
    None,
    /// At a path: seconds and nanoseconds, ISO 8601 text, or one number in a unit.
    Path {
        /// The path.
        path: FieldPath,
        /// Unit of a single number.
        unit: StampUnit,
    },
}

/// One value per message that a plan reads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Column {
    /// Its path, slices and structs written out: `data[3]`.
    pub path: String,
    /// What it decodes to.
    pub scalar: Scalar,
}

/// How to read the mapped fields of one channel. Immutable: threads share it, each with its own [`RowSink`].
#[derive(Debug)]
pub struct DecodePlan {
    core: Core,
    columns: Vec<Column>,
    stamp: StampForm,
}

/// The part that image plans share.
#[derive(Debug)]
pub(crate) struct Core {
    id: u64,
    machine: Machine,
    transcoder: Option<Transcoder>,
    pub(crate) requests: Requests,
    /// Slots that must have a value; the others are parts of the stamp.
    width: usize,
    /// Number of wanted names of each table of names.
    wanted: Vec<usize>,
}

#[derive(Debug)]
enum Machine {
    Cdr(ros::program::Program),
    Ros1(ros::program::Program),
    Protobuf { node: protobuf::node::Node, n_counters: usize },
    Json(json::node::Node),
}

impl DecodePlan {
    /// Compiles a plan for the values of `fields`, in their order, with the stamp found by itself.
    ///
    /// # Errors
    /// [`CompileError`]: the encoding is not supported, the schema does not parse, or a field is not in it.
    pub fn compile(
        channel: &ChannelSchema<'_>,
        fields: &[FieldPath],
        library: &SchemaLibrary,
    ) -> Result<Self, CompileError> {
        Self::compile_with(channel, fields, &StampSource::Auto, library)
    }

    /// Compiles a plan with a stated place of the stamp.
    ///
    /// # Errors
    /// As [`compile`](Self::compile).
    pub fn compile_with(
        channel: &ChannelSchema<'_>,
        fields: &[FieldPath],
        stamp: &StampSource,
        library: &SchemaLibrary,
    ) -> Result<Self, CompileError> {
        let types = library.types(channel)?;
        let wants: Vec<(FieldPath, Want)> = fields.iter().map(|f| (f.clone(), Want::Scalars)).collect();
        let (core, _, stamp) = Core::compile(channel, &types, &wants, stamp)?;
        let columns = core.requests.leaves[..core.width]
            .iter()
            .map(|leaf| Column { path: leaf.path.clone(), scalar: scalar(leaf.prim) })
            .collect();
        Ok(Self { core, columns, stamp })
    }

    /// Returns the number of values per message, after slices and structs are written out.
    pub fn width(&self) -> usize {
        self.core.width
    }

    /// Returns what the values are. For JSON this is what the schema declares, and `F64` where it declares nothing.
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// Tells whether messages can have a stamp.
    pub fn has_stamp(&self) -> bool {
        self.stamp != StampForm::None
    }

    /// Decodes one message and appends its row to the sink; nothing is appended unless the outcome is [`Decoded::Row`].
    ///
    /// # Errors
    /// [`DecodeError`] if the message does not fit its schema or the mapping; the sink is as before.
    pub fn decode(&self, payload: &[u8], sink: &mut RowSink) -> Result<Decoded, DecodeError> {
        let payload = self.core.transcoded(payload)?;
        let start = sink.values.len();
        sink.values.resize(start + self.core.width, f64::NAN);
        let mut emit = NumericRow {
            row: &mut sink.values[start..],
            stamp: super::stamp::Stamp::default(),
            text_slot: None,
        };
        let outcome = self.core.run(&payload, &mut sink.scratch, &mut emit);
        let (stamp, text_slot) = (emit.stamp, emit.text_slot);
        let outcome = match (outcome, text_slot) {
            (Ok(Decoded::Row { .. }), Some(slot)) => {
                Err(DecodeError::NotNumeric { path: self.columns[slot].path.clone() })
            }
            (Ok(Decoded::Row { .. }), None) => {
                sink.rows += 1;
                return Ok(Decoded::Row { stamp_ns: stamp.finish(self.stamp) });
            }
            (other, _) => other,
        };
        sink.values.truncate(start);
        outcome
    }

    /// Decodes the exact values of one message: text, 64-bit integers, bools.
    ///
    /// Returns `None` in place of the values if the message holds no selected element (see [`Decoded::NotInMessage`]).
    ///
    /// # Errors
    /// [`DecodeError`] if the message does not fit its schema or the mapping.
    pub fn decode_values(
        &self,
        payload: &[u8],
        sink: &mut RowSink,
    ) -> Result<(Decoded, Vec<Value>), DecodeError> {
        let payload = self.core.transcoded(payload)?;
        let mut emit = ExactRow::new(self.core.width);
        let outcome = self.core.run(&payload, &mut sink.scratch, &mut emit)?;
        let Decoded::Row { .. } = outcome else { return Ok((outcome, Vec::new())) };
        let values = emit.values.into_iter().zip(&self.columns).map(|(held, column)| match held {
            Some(Held::Number(number)) => Ok(number.into_value()),
            Some(Held::Text(text)) => Ok(Value::Text(text.into_owned())),
            Some(Held::Bytes(_)) | None => {
                Err(DecodeError::FieldAbsent { path: column.path.clone(), present: Vec::new() })
            }
        });
        let values = values.collect::<Result<Vec<_>, _>>()?;
        Ok((Decoded::Row { stamp_ns: emit.stamp.finish(self.stamp) }, values))
    }
}

impl Core {
    /// Compiles paths and the stamp; returns also the slots of each path.
    pub(crate) fn compile(
        channel: &ChannelSchema<'_>,
        types: &Types,
        fields: &[(FieldPath, Want)],
        stamp: &StampSource,
    ) -> Result<(Self, Vec<Range<usize>>, StampForm), CompileError> {
        let first = fields.first().map(|(path, _)| path);
        if types.encoding == Encoding::Json {
            let (mut core, slots, form) = Self::compile_json(channel, types, fields, stamp)?;
            core.transcoder.clone_from(&types.transcoder);
            return Ok((core, slots, form));
        }
        let mut resolver = Resolver::new(channel.topic, &types.table);
        let mut slots = Vec::with_capacity(fields.len());
        for (path, want) in fields {
            slots.push(resolver.add(path, *want)?);
        }
        let width = slots.last().map_or(0, |r| r.end);
        let (paths, form) = stamp_paths(stamp, &types.table, first);
        for path in &paths {
            resolver.add(path, Want::Scalars)?;
        }
        let requests = resolver.finish();
        let machine = match types.encoding {
            Encoding::Cdr => Machine::Cdr(ros::program::compile(&types.table, &requests, true)),
            Encoding::Ros1 => Machine::Ros1(ros::program::compile(&types.table, &requests, false)),
            Encoding::Protobuf | Encoding::Json => {
                let (node, n_counters) = protobuf::node::compile(&types.table, &requests);
                Machine::Protobuf { node, n_counters }
            }
        };
        let mut core = Self::new(machine, requests, width);
        core.transcoder.clone_from(&types.transcoder);
        Ok((core, slots, form))
    }

    /// Turns a payload into what the plan reads.
    pub(crate) fn transcoded<'a>(&self, payload: &'a [u8]) -> Result<Cow<'a, [u8]>, DecodeError> {
        match &self.transcoder {
            Some(transcoder) => transcoder.apply(payload),
            None => Ok(Cow::Borrowed(payload)),
        }
    }

    fn compile_json(
        channel: &ChannelSchema<'_>,
        types: &Types,
        fields: &[(FieldPath, Want)],
        stamp: &StampSource,
    ) -> Result<(Self, Vec<Range<usize>>, StampForm), CompileError> {
        let mut compiler = json::node::Compiler::new(channel.topic, &types.table);
        let mut slots = Vec::with_capacity(fields.len());
        for (path, want) in fields {
            slots.push(compiler.add(path, *want)?);
        }
        let width = slots.last().map_or(0, |r| r.end);
        let form = match stamp {
            StampSource::None => StampForm::None,
            StampSource::Auto => {
                compiler.add_stamps(&stamp_prefix(fields.first().map(|(path, _)| path)), width);
                StampForm::Parts(StampUnit::Auto)
            }
            StampSource::Path { path, unit } => {
                compiler.add_stamp(path.segments(), width);
                StampForm::Parts(*unit)
            }
        };
        let core = Self::new(Machine::Json(compiler.root), compiler.requests, width);
        Ok((core, slots, form))
    }

    fn new(machine: Machine, requests: Requests, width: usize) -> Self {
        let wanted = requests.tables.iter().map(|t| t.wanted.len()).collect();
        Self {
            id: NEXT_PLAN.fetch_add(1, Ordering::Relaxed),
            machine,
            requests,
            width,
            wanted,
            transcoder: None,
        }
    }

    /// Runs the plan over a message. The stamp of [`Decoded::Row`] is left for the caller to fill in.
    #[inline]
    pub(crate) fn run<'a, E: Emit<'a>>(
        &self,
        payload: &'a [u8],
        scratch: &mut Scratch,
        emit: &mut E,
    ) -> Result<Decoded, DecodeError> {
        let requests = &self.requests;
        let n_slots = requests.leaves.len().max(self.width + 2);
        scratch.begin(self.id, &self.wanted, requests.picks.len(), n_slots);
        match &self.machine {
            Machine::Cdr(program) => ros::run::run_cdr(program, requests, payload, scratch, emit)?,
            Machine::Ros1(program) => ros::run::run_ros1(program, requests, payload, scratch, emit)?,
            Machine::Protobuf { node, n_counters } => {
                protobuf::run::run((node, *n_counters), requests, payload, self.width, scratch, emit)?;
            }
            Machine::Json(node) => json::run::run(node, requests, payload, self.width, scratch, emit)?,
        }
        if scratch.missing > 0 {
            return Ok(Decoded::NotInMessage { found: scratch.found, missing: scratch.missing });
        }
        Ok(Decoded::Row { stamp_ns: None })
    }
}

fn scalar(prim: Prim) -> Scalar {
    match prim {
        Prim::Bool => Scalar::Bool,
        Prim::I8 | Prim::I16 | Prim::I32 | Prim::I64 => Scalar::I64,
        Prim::U8 | Prim::U16 | Prim::U32 | Prim::U64 => Scalar::U64,
        Prim::F32 | Prim::F64 => Scalar::F64,
        Prim::Text | Prim::WideText | Prim::Bytes => Scalar::Text,
    }
}

/// Returns the way to the element that a path picks first, since the element's own stamp is the one that counts.
fn stamp_prefix(field: Option<&FieldPath>) -> Vec<Segment> {
    let segments = field.map_or(&[][..], FieldPath::segments);
    let last = segments.iter().rposition(|s| !matches!(s, Segment::Field(_) | Segment::Slice { .. }));
    match last {
        Some(at) if at + 1 < segments.len() => segments[..=at].to_vec(),
        _ => Vec::new(),
    }
}

/// Finds the paths of the stamp's parts: seconds and nanoseconds, or one value.
fn stamp_paths(
    source: &StampSource,
    types: &TypeTable,
    first: Option<&FieldPath>,
) -> (Vec<FieldPath>, StampForm) {
    let none = (Vec::new(), StampForm::None);
    match source {
        StampSource::None => none,
        StampSource::Path { path, unit } => {
            let parts = place(types, path.segments())
                .and_then(|index| time_parts(&types.structs[index]))
                .map(|(sec, nanos)| vec![member(path.segments(), &sec), member(path.segments(), &nanos)]);
            (parts.unwrap_or_else(|| vec![path.clone()]), StampForm::Parts(*unit))
        }
        StampSource::Auto => {
            let prefix = stamp_prefix(first);
            let found = stamp_in(types, types.root, &[])
                .or_else(|| stamp_in(types, place(types, &prefix).filter(|_| !prefix.is_empty())?, &prefix));
            found.map_or(none, |paths| (paths, StampForm::Parts(StampUnit::Auto)))
        }
    }
}

/// Looks for a stamp among the members of one struct.
fn stamp_in(types: &TypeTable, index: usize, prefix: &[Segment]) -> Option<Vec<FieldPath>> {
    let inner = |index: usize, name: &str| -> Option<(usize, usize)> {
        let item = &types.structs[index];
        let at = item.find(name)?;
        match (item.fields[at].base, item.fields[at].many) {
            (Base::Struct(inner), Many::One) => Some((at, inner)),
            _ => None,
        }
    };
    let split = |way: &[&str], index: usize| -> Option<Vec<FieldPath>> {
        let (sec, nanos) = time_parts(&types.structs[index])?;
        let way: Vec<Segment> =
            prefix.iter().cloned().chain(way.iter().map(|n| Segment::Field((*n).to_owned()))).collect();
        Some(vec![member(&way, &sec), member(&way, &nanos)])
    };
    if let Some((_, header)) = inner(index, "header") {
        if let Some((_, stamp)) = inner(header, "stamp")
            && let Some(paths) = split(&["header", "stamp"], stamp)
        {
            return Some(paths);
        }
        if let Some(paths) = split(&["header"], header) {
            return Some(paths);
        }
    }
    for name in ["stamp", "timestamp"] {
        if let Some((_, time)) = inner(index, name)
            && let Some(paths) = split(&[name], time)
        {
            return Some(paths);
        }
        let item = &types.structs[index];
        if let Some(at) = item.find(name)
            && is_single_stamp(&item.fields[at])
        {
            return Some(vec![member(prefix, name)]);
        }
    }
    None
}

fn is_single_stamp(field: &Field) -> bool {
    field.many == Many::One
        && matches!(field.base, Base::Prim(Prim::I64 | Prim::U64 | Prim::F64 | Prim::Text))
}

/// Returns the names of the members that hold seconds and nanoseconds.
fn time_parts(item: &StructType) -> Option<(String, String)> {
    let find = |names: &[&str]| {
        item.fields.iter().find(|f| {
            f.many == Many::One
                && names.contains(&f.name.as_str())
                && matches!(f.base, Base::Prim(prim) if prim.is_number())
        })
    };
    Some((find(&SECONDS)?.name.clone(), find(&NANOS)?.name.clone()))
}

fn member(way: &[Segment], name: &str) -> FieldPath {
    let mut segments = way.to_vec();
    segments.push(Segment::Field(name.to_owned()));
    FieldPath::from_segments(segments)
}

/// Returns the struct that a path leads to.
fn place(types: &TypeTable, segments: &[Segment]) -> Option<usize> {
    let mut at = (Base::Struct(types.root), Many::One);
    for segment in segments {
        at = match (segment, at) {
            (Segment::Field(name), (Base::Struct(index), Many::One)) => {
                let item = &types.structs[index];
                let field = &item.fields[item.find(name)?];
                (field.base, field.many)
            }
            (Segment::Index(_) | Segment::Key { .. }, (base, Many::Fixed(_) | Many::Dynamic)) => {
                (base, Many::One)
            }
            _ => return None,
        };
    }
    match at {
        (Base::Struct(index), Many::One) => Some(index),
        _ => None,
    }
}
