//! Columns of one run, filled from record batches.

use arrow::{
    array::{Array, ArrayRef, AsArray, BooleanArray, FixedSizeListArray, GenericListArray, PrimitiveArray},
    datatypes::{
        ArrowNativeType, ArrowNumericType, DataType, Float32Type, Float64Type, Int8Type, Int16Type,
        Int32Type, Int64Type, UInt8Type, UInt16Type, UInt32Type, UInt64Type,
    },
};

/// Most row numbers kept for each kind of trouble; the count goes on.
const MAX_NOTED_ROWS: usize = 16;

/// One column of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Column {
    /// Column name.
    pub name: String,
    /// The values.
    pub values: ColumnValues,
    /// Rows with null, counted and the first of them.
    pub nulls: RowNotes,
    /// Rows with a list of the wrong length, counted and the first of them.
    pub wrong_widths: RowNotes,
}

/// The values of a column.
#[derive(Debug, Clone, PartialEq)]
pub enum ColumnValues {
    /// Numbers, one vector of equal length per dim; NaN stands for what is null or missing.
    Vector(Vec<Vec<f64>>),
    /// Exact integers; `i64::MIN` stands for null.
    Int(Vec<i64>),
    /// Texts; empty stands for null.
    Text(Vec<String>),
}

/// A count of rows and the first few of them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RowNotes {
    /// How many rows.
    pub n_rows: u64,
    /// The first of them, within the run.
    pub first_rows: Vec<u64>,
}

impl RowNotes {
    fn note(&mut self, row: usize) {
        self.n_rows += 1;
        if self.first_rows.len() < MAX_NOTED_ROWS {
            self.first_rows.push(row as u64);
        }
    }
}

impl Column {
    /// Returns an empty column of numbers with `width` dims.
    pub(super) fn vector(name: &str, width: usize) -> Column {
        Column::with(name, ColumnValues::Vector(vec![Vec::new(); width]))
    }

    /// Returns an empty column of integers.
    pub(super) fn int(name: &str) -> Column {
        Column::with(name, ColumnValues::Int(Vec::new()))
    }

    /// Returns an empty column of texts.
    pub(super) fn text(name: &str) -> Column {
        Column::with(name, ColumnValues::Text(Vec::new()))
    }

    fn with(name: &str, values: ColumnValues) -> Column {
        Column {
            name: name.to_owned(),
            values,
            nulls: RowNotes::default(),
            wrong_widths: RowNotes::default(),
        }
    }

    /// Returns the column emptied, of the same name, type and width.
    pub(super) fn emptied(&self) -> Column {
        match &self.values {
            ColumnValues::Vector(dims) => Column::vector(&self.name, dims.len()),
            ColumnValues::Int(_) => Column::int(&self.name),
            ColumnValues::Text(_) => Column::text(&self.name),
        }
    }

    /// Returns the dims of a column of numbers.
    pub fn dims(&self) -> &[Vec<f64>] {
        match &self.values {
            ColumnValues::Vector(dims) => dims,
            _ => &[],
        }
    }

    /// Returns the values of a column of integers.
    pub fn ints(&self) -> Option<&[i64]> {
        match &self.values {
            ColumnValues::Int(values) => Some(values),
            _ => None,
        }
    }

    /// Appends rows `from..to` of `array`.
    pub(super) fn append(&mut self, array: &ArrayRef, from: usize, to: usize) {
        match &mut self.values {
            ColumnValues::Int(values) => append_ints(values, &mut self.nulls, array, from, to),
            ColumnValues::Text(values) => append_texts(values, &mut self.nulls, array, from, to),
            ColumnValues::Vector(dims) => {
                append_vector(dims, &mut self.nulls, &mut self.wrong_widths, array, from, to)
            }
        }
    }
}

fn append_ints(values: &mut Vec<i64>, nulls: &mut RowNotes, array: &ArrayRef, from: usize, to: usize) {
    let leaf = Leaf::of(array.as_ref());
    for row in from..to {
        let value = leaf.as_ref().and_then(|leaf| leaf.int(row));
        if value.is_none() {
            nulls.note(values.len());
        }
        values.push(value.unwrap_or(i64::MIN));
    }
}

fn append_texts(values: &mut Vec<String>, nulls: &mut RowNotes, array: &ArrayRef, from: usize, to: usize) {
    for row in from..to {
        let text = match array.data_type() {
            _ if array.is_null(row) => None,
            DataType::Utf8 => Some(array.as_string::<i32>().value(row).to_owned()),
            DataType::LargeUtf8 => Some(array.as_string::<i64>().value(row).to_owned()),
            _ => None,
        };
        if text.is_none() {
            nulls.note(values.len());
        }
        values.push(text.unwrap_or_default());
    }
}

fn append_vector(
    dims: &mut [Vec<f64>],
    nulls: &mut RowNotes,
    wrong_widths: &mut RowNotes,
    array: &ArrayRef,
    from: usize,
    to: usize,
) {
    let width = dims.len();
    let filled = dims.first().map_or(0, Vec::len);
    let layers = Layers::of(array.as_ref());
    let leaf = Leaf::of(layers.leaf);
    if let Some(leaf) = &leaf
        && let Some(start) = layers.regular_start(from, to, width)
        && leaf.append_strided(dims, start, to - from)
    {
        return;
    }
    for (at, row) in (filled..).zip(from..to) {
        let range = layers.range(row);
        match (&range, &leaf) {
            (Some((start, end)), Some(leaf)) if end - start == width => {
                let mut has_null = false;
                for (dim, values) in dims.iter_mut().enumerate() {
                    let value = leaf.float(start + dim);
                    has_null |= value.is_none();
                    values.push(value.unwrap_or(f64::NAN));
                }
                if has_null {
                    nulls.note(at);
                }
            }
            _ => {
                dims.iter_mut().for_each(|values| values.push(f64::NAN));
                if range.is_none() { nulls.note(at) } else { wrong_widths.note(at) }
            }
        }
    }
}

/// Nested lists over one leaf array.
struct Layers<'a> {
    lists: Vec<ListLayer<'a>>,
    leaf: &'a dyn Array,
}

enum ListLayer<'a> {
    Small(&'a GenericListArray<i32>),
    Large(&'a GenericListArray<i64>),
    Fixed(&'a FixedSizeListArray),
}

impl<'a> Layers<'a> {
    fn of(mut array: &'a dyn Array) -> Layers<'a> {
        let mut lists = Vec::new();
        loop {
            let (layer, child) = match array.data_type() {
                DataType::List(_) => (ListLayer::Small(array.as_list()), array.as_list::<i32>().values()),
                DataType::LargeList(_) => {
                    (ListLayer::Large(array.as_list()), array.as_list::<i64>().values())
                }
                DataType::FixedSizeList(..) => {
                    (ListLayer::Fixed(array.as_fixed_size_list()), array.as_fixed_size_list().values())
                }
                _ => return Layers { lists, leaf: array },
            };
            lists.push(layer);
            array = child.as_ref();
        }
    }

    /// Returns the leaf range of `row`, or `None` where a list is null.
    fn range(&self, row: usize) -> Option<(usize, usize)> {
        let (mut start, mut end) = (row, row + 1);
        for layer in &self.lists {
            if (start..end).any(|i| layer.is_null(i)) {
                return None;
            }
            (start, end) = (layer.offset(start), layer.offset(end));
        }
        Some((start, end))
    }

    /// Returns where the leaf values of rows `from..to` begin if all have `width` values and none is null.
    fn regular_start(&self, from: usize, to: usize, width: usize) -> Option<usize> {
        match self.lists.as_slice() {
            [] => (width == 1).then_some(from),
            [layer] => {
                let start = layer.offset(from);
                let is_regular = !layer.has_nulls()
                    && (from..to).all(|row| layer.offset(row + 1) - layer.offset(row) == width);
                is_regular.then_some(start)
            }
            _ => None,
        }
    }
}

impl ListLayer<'_> {
    fn is_null(&self, i: usize) -> bool {
        match self {
            ListLayer::Small(list) => list.is_null(i),
            ListLayer::Large(list) => list.is_null(i),
            ListLayer::Fixed(list) => list.is_null(i),
        }
    }

    fn has_nulls(&self) -> bool {
        match self {
            ListLayer::Small(list) => list.null_count() > 0,
            ListLayer::Large(list) => list.null_count() > 0,
            ListLayer::Fixed(list) => list.null_count() > 0,
        }
    }

    fn offset(&self, i: usize) -> usize {
        match self {
            ListLayer::Small(list) => list.value_offsets()[i].as_usize(),
            ListLayer::Large(list) => list.value_offsets()[i].as_usize(),
            ListLayer::Fixed(list) => i * list.value_length().as_usize(),
        }
    }
}

/// A leaf array of numbers.
enum Leaf<'a> {
    F32(&'a PrimitiveArray<Float32Type>),
    F64(&'a PrimitiveArray<Float64Type>),
    I8(&'a PrimitiveArray<Int8Type>),
    I16(&'a PrimitiveArray<Int16Type>),
    I32(&'a PrimitiveArray<Int32Type>),
    I64(&'a PrimitiveArray<Int64Type>),
    U8(&'a PrimitiveArray<UInt8Type>),
    U16(&'a PrimitiveArray<UInt16Type>),
    U32(&'a PrimitiveArray<UInt32Type>),
    U64(&'a PrimitiveArray<UInt64Type>),
    Bool(&'a BooleanArray),
}

impl<'a> Leaf<'a> {
    fn of(array: &'a dyn Array) -> Option<Leaf<'a>> {
        Some(match array.data_type() {
            DataType::Float32 => Leaf::F32(array.as_primitive()),
            DataType::Float64 => Leaf::F64(array.as_primitive()),
            DataType::Int8 => Leaf::I8(array.as_primitive()),
            DataType::Int16 => Leaf::I16(array.as_primitive()),
            DataType::Int32 => Leaf::I32(array.as_primitive()),
            DataType::Int64 => Leaf::I64(array.as_primitive()),
            DataType::UInt8 => Leaf::U8(array.as_primitive()),
            DataType::UInt16 => Leaf::U16(array.as_primitive()),
            DataType::UInt32 => Leaf::U32(array.as_primitive()),
            DataType::UInt64 => Leaf::U64(array.as_primitive()),
            DataType::Boolean => Leaf::Bool(array.as_boolean()),
            _ => return None,
        })
    }

    fn float(&self, i: usize) -> Option<f64> {
        match self {
            Leaf::F32(a) => valid(a, i).map(f64::from),
            Leaf::F64(a) => valid(a, i),
            Leaf::Bool(a) => a.is_valid(i).then(|| f64::from(u8::from(a.value(i)))),
            Leaf::U64(a) => valid(a, i).map(|v| v as f64),
            other => other.int(i).map(|v| v as f64),
        }
    }

    fn int(&self, i: usize) -> Option<i64> {
        match self {
            Leaf::F32(_) | Leaf::F64(_) => self.float(i).filter(|v| v.fract() == 0.0).map(|v| v as i64),
            Leaf::I8(a) => valid(a, i).map(i64::from),
            Leaf::I16(a) => valid(a, i).map(i64::from),
            Leaf::I32(a) => valid(a, i).map(i64::from),
            Leaf::I64(a) => valid(a, i),
            Leaf::U8(a) => valid(a, i).map(i64::from),
            Leaf::U16(a) => valid(a, i).map(i64::from),
            Leaf::U32(a) => valid(a, i).map(i64::from),
            Leaf::U64(a) => valid(a, i).and_then(|v| i64::try_from(v).ok()),
            Leaf::Bool(a) => a.is_valid(i).then(|| i64::from(a.value(i))),
        }
    }

    /// Appends `n_rows` regular rows that begin at leaf position `start`; false if that is not possible.
    fn append_strided(&self, dims: &mut [Vec<f64>], start: usize, n_rows: usize) -> bool {
        match self {
            Leaf::F32(a) if a.null_count() == 0 => {
                append_strided(dims, &a.values()[start..], n_rows, f64::from)
            }
            Leaf::F64(a) if a.null_count() == 0 => append_strided(dims, &a.values()[start..], n_rows, |v| v),
            _ => return false,
        }
        true
    }
}

fn append_strided<T: Copy>(
    dims: &mut [Vec<f64>],
    values: &[T],
    n_rows: usize,
    to_float: impl Fn(T) -> f64 + Copy,
) {
    let width = dims.len();
    for (dim, out) in dims.iter_mut().enumerate() {
        out.extend(values[dim..].iter().step_by(width).take(n_rows).map(|v| to_float(*v)));
    }
}

fn valid<T: ArrowNumericType>(array: &PrimitiveArray<T>, i: usize) -> Option<T::Native> {
    array.is_valid(i).then(|| array.value(i))
}
