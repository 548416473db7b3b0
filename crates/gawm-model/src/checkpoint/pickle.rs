//! A pickle machine for state dicts: tensors, containers, numbers and text; nothing is ever called.
//!
//! A pickle is a program. This machine knows the instructions that PyTorch writes for a `state_dict` and four globals
//! with a fixed meaning; any other instruction or global is an error that names it. Values live in an arena and refer to
//! each other by index, so that nothing is copied, nothing recurses, and memory is bounded by the length of the program.

use std::collections::HashMap;

use candle_core::DType;
use thiserror::Error;

/// Why a pickle is refused.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum PickleError {
    /// The program ends before it stops.
    #[error("truncated pickle: expected {expected} more bytes at byte {at}")]
    Truncated {
        /// Where.
        at: usize,
        /// Bytes needed.
        expected: usize,
    },
    /// An instruction that state dicts do not use.
    #[error("refused pickle instruction {code:#04x} at byte {at}: expected a plain state_dict of tensors")]
    Instruction {
        /// Where.
        at: usize,
        /// The instruction.
        code: u8,
    },
    /// A global that is neither a tensor nor a container.
    #[error("refused {name:?} at byte {at}: a pickle could run code; expected a plain state_dict of tensors")]
    Global {
        /// Where.
        at: usize,
        /// Module and name.
        name: String,
    },
    /// The program takes what is not there, or of another kind.
    #[error("malformed pickle at byte {at}: expected {expected}")]
    Malformed {
        /// Where.
        at: usize,
        /// What the instruction needs.
        expected: &'static str,
    },
    /// An entry of the state dict is not a tensor.
    #[error("entry {name:?} is not a tensor")]
    NotTensor {
        /// The key.
        name: String,
    },
    /// A key occurs twice.
    #[error("entry {name:?} occurs twice")]
    Duplicate {
        /// The key.
        name: String,
    },
}

/// A tensor as a pickle describes it: a strided view of a storage in another file.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct TensorRecord {
    pub(super) dtype: DType,
    /// Name of the storage file.
    pub(super) storage: String,
    /// Elements in the storage.
    pub(super) storage_len: usize,
    /// First element.
    pub(super) offset: usize,
    pub(super) shape: Vec<usize>,
    /// In elements.
    pub(super) stride: Vec<usize>,
}

/// Index of a value in the arena.
type Index = usize;

#[derive(Debug, Clone)]
enum Value {
    Plain, // None, truth values, floats: nothing reads them
    Int(i64),
    Text(String),
    Tuple(Vec<Index>),
    List,
    Dict(Vec<(Index, Index)>),
    Global(Global),
    Storage(DType, String, usize),
    Tensor(TensorRecord),
}

/// The globals that have a meaning here.
#[derive(Debug, Clone, Copy)]
enum Global {
    OrderedDict,
    RebuildTensor,
    RebuildParameter,
    Storage(DType),
}

fn global(module: &str, name: &str) -> Option<Global> {
    match (module, name) {
        ("collections", "OrderedDict") => Some(Global::OrderedDict),
        ("torch._utils", "_rebuild_tensor_v2") => Some(Global::RebuildTensor),
        ("torch._utils", "_rebuild_parameter") => Some(Global::RebuildParameter),
        ("torch", "DoubleStorage") => Some(Global::Storage(DType::F64)),
        ("torch", "FloatStorage") => Some(Global::Storage(DType::F32)),
        ("torch", "HalfStorage") => Some(Global::Storage(DType::F16)),
        ("torch", "BFloat16Storage") => Some(Global::Storage(DType::BF16)),
        ("torch", "LongStorage") => Some(Global::Storage(DType::I64)),
        _ => None,
    }
}

/// Runs a pickle and returns the tensors of its state dict, in order.
///
/// The state dict is the result itself, or its entry `state_dict` (Lightning).
pub(super) fn read_state_dict(program: &[u8]) -> Result<Vec<(String, TensorRecord)>, PickleError> {
    let mut machine = Machine {
        program,
        at: 0,
        values: Vec::new(),
        stack: Vec::new(),
        marks: Vec::new(),
        memo: HashMap::new(),
    };
    let result = machine.run()?;
    let values = &machine.values;
    let entries = |index: Index| match &values[index] {
        Value::Dict(entries) => Ok(entries.as_slice()),
        _ => Err(PickleError::Malformed { at: machine.at, expected: "a dict as the result" }),
    };
    let is_state_dict = |key: &Index| matches!(&values[*key], Value::Text(text) if text == "state_dict");
    let top = entries(result)?;
    let state = match top.iter().find(|(key, _)| is_state_dict(key)) {
        Some((_, inner)) => entries(*inner)?,
        None => top,
    };
    let mut tensors: Vec<(String, TensorRecord)> = Vec::new();
    let mut seen = std::collections::BTreeSet::new();
    for (key, value) in state {
        let Value::Text(name) = &values[*key] else {
            return Err(PickleError::Malformed {
                at: machine.at,
                expected: "text as the keys of the state dict",
            });
        };
        let Value::Tensor(record) = &values[*value] else {
            return Err(PickleError::NotTensor { name: name.clone() });
        };
        if !seen.insert(name.as_str()) {
            return Err(PickleError::Duplicate { name: name.clone() });
        }
        tensors.push((name.clone(), record.clone()));
    }
    Ok(tensors)
}

struct Machine<'a> {
    program: &'a [u8],
    at: usize,
    values: Vec<Value>,
    stack: Vec<Index>,
    marks: Vec<usize>,
    memo: HashMap<u32, Index>,
}

impl<'a> Machine<'a> {
    fn run(&mut self) -> Result<Index, PickleError> {
        loop {
            let at = self.at;
            let [code] = self.fixed()?;
            match code {
                b'.' => return self.pop(),
                0x80 => _ = self.fixed::<1>()?,                // PROTO
                0x95 => _ = self.fixed::<8>()?,                // FRAME
                b'N' | 0x88 | 0x89 => self.push(Value::Plain), // NONE, NEWTRUE, NEWFALSE
                b'G' => _ = (self.fixed::<8>()?, self.push(Value::Plain)), // BINFLOAT
                b'K' => {
                    let [byte] = self.fixed()?;
                    self.push(Value::Int(byte.into()));
                }
                b'M' => {
                    let value = u16::from_le_bytes(self.fixed()?);
                    self.push(Value::Int(value.into()));
                }
                b'J' => {
                    let value = i32::from_le_bytes(self.fixed()?);
                    self.push(Value::Int(value.into()));
                }
                0x8a => self.long()?,
                b'X' => self.text::<4>()?,
                0x8c => self.text::<1>()?,
                b']' => self.push(Value::List),
                b')' => self.push(Value::Tuple(Vec::new())),
                b'}' => self.push(Value::Dict(Vec::new())),
                b'(' => self.marks.push(self.stack.len()),
                b't' => {
                    let items = self.take_marked()?;
                    self.push(Value::Tuple(items));
                }
                0x85..=0x87 => self.tuple(usize::from(code - 0x84))?,
                b'q' | b'r' | 0x94 => self.remember(code)?,
                b'h' | b'j' => self.recall(code)?,
                b'c' => self.global()?,
                0x93 => self.stack_global()?,
                b'Q' => self.persistent()?,
                b'R' => self.reduce()?,
                b's' | b'u' => self.set_items(code)?,
                b'a' | b'e' => self.append(code)?,
                b'b' => self.build()?,
                _ => return Err(PickleError::Instruction { at, code }),
            }
        }
    }

    fn bytes(&mut self, count: usize) -> Result<&'a [u8], PickleError> {
        let rest = &self.program[self.at..];
        let bytes = rest
            .get(..count)
            .ok_or(PickleError::Truncated { at: self.at, expected: count - rest.len().min(count) })?;
        self.at += count;
        Ok(bytes)
    }

    fn fixed<const N: usize>(&mut self) -> Result<[u8; N], PickleError> {
        let mut fixed = [0; N];
        fixed.copy_from_slice(self.bytes(N)?);
        Ok(fixed)
    }

    fn malformed<T>(&self, expected: &'static str) -> Result<T, PickleError> {
        Err(PickleError::Malformed { at: self.at, expected })
    }

    fn push(&mut self, value: Value) {
        self.values.push(value);
        self.stack.push(self.values.len() - 1);
    }

    /// Takes the top of the stack, but not across a mark.
    fn pop(&mut self) -> Result<Index, PickleError> {
        if self.stack.len() <= self.marks.last().copied().unwrap_or(0) {
            return self.malformed("a value on the stack");
        }
        self.stack.pop().map_or_else(|| self.malformed("a value on the stack"), Ok)
    }

    fn take_marked(&mut self) -> Result<Vec<Index>, PickleError> {
        match self.marks.pop() {
            Some(mark) => Ok(self.stack.split_off(mark)),
            None => self.malformed("a mark on the stack"),
        }
    }

    fn tuple(&mut self, count: usize) -> Result<(), PickleError> {
        let mut items = (0..count).map(|_| self.pop()).collect::<Result<Vec<_>, _>>()?;
        items.reverse();
        self.push(Value::Tuple(items));
        Ok(())
    }

    /// LONG1: a little-endian integer of up to 8 bytes, sign-extended.
    fn long(&mut self) -> Result<(), PickleError> {
        let [length] = self.fixed()?;
        if length > 8 {
            return self.malformed("an integer of at most 64 bits");
        }
        let bytes = self.bytes(length.into())?;
        let negative = bytes.last().is_some_and(|byte| byte & 0x80 != 0);
        let mut wide = [if negative { 0xff } else { 0 }; 8];
        wide[..bytes.len()].copy_from_slice(bytes);
        self.push(Value::Int(i64::from_le_bytes(wide)));
        Ok(())
    }

    /// Text after a little-endian length of N bytes.
    fn text<const N: usize>(&mut self) -> Result<(), PickleError> {
        let mut length = [0; 8];
        length[..N].copy_from_slice(&self.fixed::<N>()?);
        let bytes = self.bytes(u64::from_le_bytes(length) as usize)?;
        match std::str::from_utf8(bytes) {
            Ok(text) => self.push(Value::Text(text.to_owned())),
            Err(_) => return self.malformed("UTF-8 text"),
        }
        Ok(())
    }

    fn remember(&mut self, code: u8) -> Result<(), PickleError> {
        let key = match code {
            b'q' => self.fixed::<1>()?[0].into(),
            b'r' => u32::from_le_bytes(self.fixed()?),
            _ => self.memo.len() as u32, // MEMOIZE numbers by itself
        };
        match self.stack.last() {
            Some(&index) => self.memo.insert(key, index),
            None => return self.malformed("a value on the stack"),
        };
        Ok(())
    }

    fn recall(&mut self, code: u8) -> Result<(), PickleError> {
        let key = if code == b'h' { self.fixed::<1>()?[0].into() } else { u32::from_le_bytes(self.fixed()?) };
        match self.memo.get(&key) {
            Some(&index) => self.stack.push(index),
            None => return self.malformed("a remembered value"),
        }
        Ok(())
    }

    fn global(&mut self) -> Result<(), PickleError> {
        let at = self.at;
        let mut line = || {
            let rest = &self.program[self.at..];
            let length = rest.iter().take(256).position(|&byte| byte == b'\n');
            let Some(length) = length else {
                return Err(PickleError::Malformed { at: self.at, expected: "a line of at most 255 bytes" });
            };
            self.at += length + 1;
            Ok(String::from_utf8_lossy(&rest[..length]).into_owned())
        };
        let (module, name) = (line()?, line()?);
        self.push_global(at, &module, &name)
    }

    fn stack_global(&mut self) -> Result<(), PickleError> {
        let at = self.at;
        let (name, module) = (self.pop()?, self.pop()?);
        let (module, name) = match (&self.values[module], &self.values[name]) {
            (Value::Text(module), Value::Text(name)) => (module.clone(), name.clone()),
            _ => return self.malformed("a module and a name"),
        };
        self.push_global(at, &module, &name)
    }

    fn push_global(&mut self, at: usize, module: &str, name: &str) -> Result<(), PickleError> {
        match global(module, name) {
            Some(global) => self.push(Value::Global(global)),
            None => return Err(PickleError::Global { at, name: format!("{module}.{name}") }),
        }
        Ok(())
    }

    /// `("storage", type, key, device, length)` stands for the bytes in file `data/KEY`.
    fn persistent(&mut self) -> Result<(), PickleError> {
        let id = self.pop()?;
        let storage = match &self.values[id] {
            Value::Tuple(items) => {
                let item = |n: usize| items.get(n).map(|&index| &self.values[index]);
                match (item(0), item(1), item(2), item(4)) {
                    (
                        Some(Value::Text(tag)),
                        Some(Value::Global(Global::Storage(dtype))),
                        Some(Value::Text(key)),
                        Some(Value::Int(length)),
                    ) if tag == "storage" && *length >= 0 => {
                        Some(Value::Storage(*dtype, key.clone(), *length as usize))
                    }
                    _ => None,
                }
            }
            _ => None,
        };
        match storage {
            Some(storage) => self.push(storage),
            None => return self.malformed("a storage of numbers"),
        }
        Ok(())
    }

    fn reduce(&mut self) -> Result<(), PickleError> {
        let (arguments, callable) = (self.pop()?, self.pop()?);
        let (Value::Global(callable), Value::Tuple(arguments)) =
            (&self.values[callable], &self.values[arguments])
        else {
            return self.malformed("a global and its arguments");
        };
        let value = match callable {
            Global::OrderedDict if arguments.is_empty() => Some(Value::Dict(Vec::new())),
            Global::RebuildTensor => self.tensor(arguments).map(Value::Tensor),
            Global::RebuildParameter => match arguments.first().map(|&index| &self.values[index]) {
                Some(Value::Tensor(record)) => Some(Value::Tensor(record.clone())),
                _ => None,
            },
            _ => None,
        };
        match value {
            Some(value) => self.push(value),
            None => return self.malformed("the arguments of a tensor or an empty OrderedDict"),
        }
        Ok(())
    }

    /// `(storage, offset, shape, stride, requires_grad, hooks)`.
    fn tensor(&self, arguments: &[Index]) -> Option<TensorRecord> {
        /// More axes than any tensor of a model has.
        const MAX_AXES: usize = 8;
        let numbers = |index: Index| match &self.values[index] {
            Value::Tuple(items) if items.len() <= MAX_AXES => {
                items.iter().map(|&item| self.number(item)).collect::<Option<Vec<_>>>()
            }
            _ => None,
        };
        let &[storage, offset, shape, stride, ..] = arguments else { return None };
        let Value::Storage(dtype, key, storage_len) = &self.values[storage] else { return None };
        let (shape, stride) = (numbers(shape)?, numbers(stride)?);
        (shape.len() == stride.len()).then_some(())?;
        let offset = self.number(offset)?;
        Some(TensorRecord {
            dtype: *dtype,
            storage: key.clone(),
            storage_len: *storage_len,
            offset,
            shape,
            stride,
        })
    }

    fn number(&self, index: Index) -> Option<usize> {
        match self.values[index] {
            Value::Int(value) => usize::try_from(value).ok(),
            _ => None,
        }
    }

    fn set_items(&mut self, code: u8) -> Result<(), PickleError> {
        let items = if code == b'u' {
            self.take_marked()?
        } else {
            let (value, key) = (self.pop()?, self.pop()?);
            vec![key, value]
        };
        let dict = match self.stack.last() {
            Some(&index) => &mut self.values[index],
            None => return self.malformed("a dict on the stack"),
        };
        match dict {
            Value::Dict(entries) if items.len() % 2 == 0 => {
                entries.extend(items.chunks_exact(2).map(|pair| (pair[0], pair[1])));
                Ok(())
            }
            _ => self.malformed("a dict and pairs of key and value"),
        }
    }

    /// Lists occur in training checkpoints; what they hold is of no use here.
    fn append(&mut self, code: u8) -> Result<(), PickleError> {
        if code == b'e' {
            self.take_marked()?;
        } else {
            self.pop()?;
        }
        match self.stack.last().map(|&index| &self.values[index]) {
            Some(Value::List) => Ok(()),
            _ => self.malformed("a list on the stack"),
        }
    }

    /// Attributes of an OrderedDict (`_metadata`) are dropped; nothing else can have any.
    fn build(&mut self) -> Result<(), PickleError> {
        self.pop()?;
        match self.stack.last().map(|&index| &self.values[index]) {
            Some(Value::Dict(_)) => Ok(()),
            _ => self.malformed("a dict on the stack"),
        }
    }
}
