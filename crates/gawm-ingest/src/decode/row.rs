//! Where decoded values go: rows of numbers, exact values, and the stamp beside them.

use std::borrow::Cow;

use super::stamp::Stamp;

/// What a value of a message is, once decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Scalar {
    /// A floating-point number.
    F64,
    /// A signed integer.
    I64,
    /// An unsigned integer.
    U64,
    /// True or false; 1 or 0 in a row of numbers.
    Bool,
    /// Text; has no place in a row of numbers.
    Text,
}

/// One exact value, for markers, times and task texts.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// A floating-point number.
    F64(f64),
    /// A signed integer.
    I64(i64),
    /// An unsigned integer.
    U64(u64),
    /// True or false.
    Bool(bool),
    /// Text.
    Text(String),
}

impl Value {
    /// Returns the value as a number, widened; `None` for text.
    pub fn as_f64(&self) -> Option<f64> {
        match self {
            Self::F64(v) => Some(*v),
            Self::I64(v) => Some(Number::I64(*v).widen()),
            Self::U64(v) => Some(Number::U64(*v).widen()),
            Self::Bool(v) => Some(Number::Bool(*v).widen()),
            Self::Text(_) => None,
        }
    }

    /// Returns the text; `None` for numbers.
    pub fn as_text(&self) -> Option<&str> {
        match self {
            Self::Text(text) => Some(text),
            _ => None,
        }
    }

    /// Returns the truth of a bool, or of a number that is not 0.
    pub fn as_bool(&self) -> Option<bool> {
        match self {
            Self::Bool(v) => Some(*v),
            Self::I64(v) => Some(*v != 0),
            Self::U64(v) => Some(*v != 0),
            Self::F64(v) => Some(*v != 0.0),
            Self::Text(_) => None,
        }
    }
}

/// What became of one message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decoded {
    /// A row was appended.
    Row {
        /// The message's own stamp, in nanoseconds; absent if it has none or a stamp of 0.
        stamp_ns: Option<i64>,
    },
    /// The message holds none of (or not all) the elements that a `[member="..."]` of structs asks for.
    ///
    /// Not an error: transform messages carry a subset of the frames. Nothing was appended.
    NotInMessage {
        /// Selected elements that were there.
        found: u32,
        /// Selected elements that were not there.
        missing: u32,
    },
}

/// Columns that a [`DecodePlan`](super::DecodePlan) appends rows to. Use one sink per plan and thread.
#[derive(Debug, Default)]
pub struct RowSink {
    pub(crate) values: Vec<f64>,
    pub(crate) rows: usize,
    pub(crate) scratch: Scratch,
}

impl RowSink {
    /// Makes an empty sink.
    pub fn new() -> Self {
        Self::default()
    }

    /// Returns the values, row-major, shape [rows, width].
    pub fn values(&self) -> &[f64] {
        &self.values
    }

    /// Returns the number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Takes the values out and leaves the sink empty.
    pub fn take(&mut self) -> Vec<f64> {
        self.rows = 0;
        std::mem::take(&mut self.values)
    }

    /// Empties the sink and keeps its memory.
    pub fn clear(&mut self) {
        self.rows = 0;
        self.values.clear();
    }
}

/// A number of a message, before widening.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Number {
    F64(f64),
    I64(i64),
    U64(u64),
    Bool(bool),
}

impl Number {
    #[inline]
    #[expect(clippy::cast_precision_loss, reason = "features are f64; exact integers are read as values")]
    pub(crate) fn widen(self) -> f64 {
        match self {
            Self::F64(v) => v,
            Self::I64(v) => v as f64,
            Self::U64(v) => v as f64,
            Self::Bool(v) => f64::from(u8::from(v)),
        }
    }

    pub(crate) fn into_value(self) -> Value {
        match self {
            Self::F64(v) => Value::F64(v),
            Self::I64(v) => Value::I64(v),
            Self::U64(v) => Value::U64(v),
            Self::Bool(v) => Value::Bool(v),
        }
    }

    /// Tells whether the number is what a selector's text says.
    pub(crate) fn equals_text(self, text: &str) -> bool {
        match self {
            Self::F64(v) => text.parse() == Ok(v),
            Self::I64(v) => text.parse() == Ok(v),
            Self::U64(v) => text.parse() == Ok(v),
            Self::Bool(v) => text.parse() == Ok(v),
        }
    }
}

/// Takes the values of one message as a walker finds them.
pub(crate) trait Emit<'a> {
    fn number(&mut self, slot: usize, value: Number);
    fn text(&mut self, slot: usize, value: Cow<'a, str>);
    fn bytes(&mut self, slot: usize, value: Cow<'a, [u8]>);
}

/// A row of numbers; slots from the row's width on are parts of the stamp.
pub(crate) struct NumericRow<'r> {
    pub(crate) row: &'r mut [f64],
    pub(crate) stamp: Stamp,
    /// Slot of a text that has no place in the row.
    pub(crate) text_slot: Option<usize>,
}

impl<'a> Emit<'a> for NumericRow<'_> {
    #[inline]
    fn number(&mut self, slot: usize, value: Number) {
        match self.row.get_mut(slot) {
            Some(cell) => *cell = value.widen(),
            None => self.stamp.number(slot - self.row.len(), value),
        }
    }

    fn text(&mut self, slot: usize, value: Cow<'a, str>) {
        let Some(cell) = self.row.get_mut(slot) else { return self.stamp.text(&value) };
        // JSON has no such numbers; writers put them as text.
        match &*value {
            "NaN" => *cell = f64::NAN,
            "Infinity" => *cell = f64::INFINITY,
            "-Infinity" => *cell = f64::NEG_INFINITY,
            _ => self.text_slot = Some(slot),
        }
    }

    fn bytes(&mut self, slot: usize, _: Cow<'a, [u8]>) {
        self.text_slot = Some(slot);
    }
}

/// Exact values of one message.
pub(crate) struct ExactRow<'a> {
    pub(crate) values: Vec<Option<Held<'a>>>,
    pub(crate) stamp: Stamp,
}

/// A value that may borrow from the payload.
#[derive(Clone, Debug)]
pub(crate) enum Held<'a> {
    Number(Number),
    Text(Cow<'a, str>),
    Bytes(Cow<'a, [u8]>),
}

impl<'a> ExactRow<'a> {
    pub(crate) fn new(width: usize) -> Self {
        Self { values: vec![None; width], stamp: Stamp::default() }
    }
}

impl<'a> Emit<'a> for ExactRow<'a> {
    fn number(&mut self, slot: usize, value: Number) {
        let width = self.values.len();
        match self.values.get_mut(slot) {
            Some(cell) => *cell = Some(Held::Number(value)),
            None => self.stamp.number(slot - width, value),
        }
    }

    fn text(&mut self, slot: usize, value: Cow<'a, str>) {
        match self.values.get_mut(slot) {
            Some(cell) => *cell = Some(Held::Text(value)),
            None => self.stamp.text(&value),
        }
    }

    fn bytes(&mut self, slot: usize, value: Cow<'a, [u8]>) {
        if let Some(cell) = self.values.get_mut(slot) {
            *cell = Some(Held::Bytes(value));
        }
    }
}

/// Compares one member of an element with the names that are looked for.
pub(crate) struct Probe<'a> {
    pub(crate) held: Option<Held<'a>>,
}

impl Probe<'_> {
    pub(crate) fn is(&self, wanted: &str) -> bool {
        match &self.held {
            Some(Held::Text(text)) => text == wanted,
            Some(Held::Number(number)) => number.equals_text(wanted),
            Some(Held::Bytes(_)) | None => false,
        }
    }
}

impl<'a> Emit<'a> for Probe<'a> {
    fn number(&mut self, _: usize, value: Number) {
        self.held = Some(Held::Number(value));
    }

    fn text(&mut self, _: usize, value: Cow<'a, str>) {
        self.held = Some(Held::Text(value));
    }

    fn bytes(&mut self, _: usize, _: Cow<'a, [u8]>) {}
}

/// What a walker keeps from message to message, so that none allocates.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    /// The plan that this belongs to.
    pub(crate) plan_id: u64,
    pub(crate) tables: Vec<TableState>,
    /// Whether each pick has met its element (protobuf, JSON).
    pub(crate) matched: Vec<bool>,
    /// Whether each slot has its value (protobuf, JSON).
    pub(crate) set: Vec<bool>,
    /// Elements seen of each repeated field (protobuf).
    pub(crate) counters: Vec<usize>,
    /// Length of the array of each pick, `usize::MAX` before it is met (protobuf, JSON).
    pub(crate) lengths: Vec<usize>,
    /// Positions of the elements of the arrays around the current place (JSON).
    pub(crate) positions: Vec<usize>,
    pub(crate) found: u32,
    pub(crate) missing: u32,
}

/// Where the wanted names of an array stand.
#[derive(Clone, Debug, Default)]
pub(crate) struct TableState {
    /// Position of each wanted name; `u32::MAX` = not there.
    pub(crate) index: Vec<u32>,
    /// Length of the array of names in this message.
    pub(crate) count: usize,
    /// Position of the array in this message's body, for errors.
    pub(crate) at: usize,
    /// Bytes of the array in an earlier message, which `index` still holds for.
    pub(crate) cached: Vec<u8>,
    pub(crate) cached_phase: usize,
}

impl Scratch {
    /// Prepares for a message of the plan.
    #[inline]
    pub(crate) fn begin(&mut self, plan_id: u64, wanted: &[usize], n_picks: usize, n_slots: usize) {
        if self.plan_id != plan_id {
            self.plan_id = plan_id;
            self.tables = wanted
                .iter()
                .map(|n| TableState { index: vec![u32::MAX; *n], ..TableState::default() })
                .collect();
            self.matched = vec![false; n_picks];
            self.set = vec![false; n_slots];
            self.lengths = vec![usize::MAX; n_picks];
        }
        self.found = 0;
        self.missing = 0;
    }
}
