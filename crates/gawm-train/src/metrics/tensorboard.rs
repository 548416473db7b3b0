//! TensorBoard event files: protobuf messages in TFRecord frames, as `tensorboard` reads them.
//!
//! ```text
//! length u64 le | masked crc32c of the length u32 le | message | masked crc32c of the message u32 le
//! ```

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use prost::Message;

use super::{MetricsError, Record};

/// An event file of a run, open for writing.
#[derive(Debug)]
pub struct EventFile {
    path: PathBuf,
    file: File,
}

/// `tensorflow.Event`, the fields that are written.
#[derive(Clone, PartialEq, Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
    #[prost(message, optional, tag = "7")]
    session_log: Option<SessionLog>,
}

/// `tensorflow.SessionLog`.
#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    #[prost(int32, tag = "1")]
    status: i32,
}

/// `SessionLog.START`: what was logged at this step and later before is void.
const SESSION_START: i32 = 1;

/// `tensorflow.Summary`.
#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

/// `tensorflow.Summary.Value`.
#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
    #[prost(message, optional, tag = "8")]
    tensor: Option<Tensor>,
    #[prost(message, optional, tag = "9")]
    metadata: Option<Metadata>,
}

/// `tensorflow.TensorProto` of texts.
#[derive(Clone, PartialEq, Message)]
struct Tensor {
    #[prost(int32, tag = "1")]
    dtype: i32,
    #[prost(message, optional, tag = "2")]
    shape: Option<Shape>,
    #[prost(bytes = "vec", repeated, tag = "8")]
    string_val: Vec<Vec<u8>>,
}

/// `DataType.DT_STRING`.
const DT_STRING: i32 = 7;

/// `tensorflow.TensorShapeProto`.
#[derive(Clone, PartialEq, Message)]
struct Shape {
    #[prost(message, repeated, tag = "2")]
    dim: Vec<Dim>,
}

/// `tensorflow.TensorShapeProto.Dim`.
#[derive(Clone, PartialEq, Message)]
struct Dim {
    #[prost(int64, tag = "1")]
    size: i64,
}

/// `tensorflow.SummaryMetadata`.
#[derive(Clone, PartialEq, Message)]
struct Metadata {
    #[prost(message, optional, tag = "1")]
    plugin_data: Option<PluginData>,
}

/// `tensorflow.SummaryMetadata.PluginData`.
#[derive(Clone, PartialEq, Message)]
struct PluginData {
    #[prost(string, tag = "1")]
    plugin_name: String,
}

impl EventFile {
    /// Starts the next event file of `folder` at `step`; TensorBoard forgets what older files say from there on.
    ///
    /// # Errors
    ///
    /// - [`MetricsError::Io`].
    pub fn create(folder: &Path, step: u64) -> Result<EventFile, MetricsError> {
        let io = |path: &Path| {
            let path = path.to_owned();
            move |cause| MetricsError::Io { verb: "write", path, cause }
        };
        std::fs::create_dir_all(folder).map_err(io(folder))?;
        // TensorBoard reads the files of a folder in the order of their names.
        let taken = folder.read_dir().map_err(io(folder))?.filter_map(Result::ok).count();
        let mut index = taken;
        let (path, file) = loop {
            let path = folder.join(format!("events.out.tfevents.{index:010}.gawm"));
            match File::create_new(&path) {
                Ok(file) => break (path, file),
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => index += 1,
                Err(error) => return Err(io(&path)(error)),
            }
        };
        let mut events = EventFile { path, file };
        events.append(0, Event { file_version: Some("brain.Event:2".to_owned()), ..Event::default() })?;
        let session_log = Some(SessionLog { status: SESSION_START });
        events.append(step, Event { session_log, ..Event::default() })?;
        Ok(events)
    }

    /// Appends scalars of one step.
    ///
    /// # Errors
    ///
    /// - [`MetricsError::Io`].
    pub fn scalars(&mut self, step: u64, scalars: &[(String, f64)]) -> Result<(), MetricsError> {
        let value = |(tag, value): &(String, f64)| Value {
            tag: tag.clone(),
            simple_value: Some(*value as f32),
            ..Value::default()
        };
        let summary = Some(Summary { value: scalars.iter().map(value).collect() });
        self.append(step, Event { summary, ..Event::default() })
    }

    /// Appends a text (Markdown).
    ///
    /// # Errors
    ///
    /// - [`MetricsError::Io`].
    pub fn text(&mut self, step: u64, tag: &str, text: &str) -> Result<(), MetricsError> {
        let shape = Shape { dim: vec![Dim { size: 1 }] };
        let value = Value {
            tag: tag.to_owned(),
            simple_value: None,
            tensor: Some(Tensor {
                dtype: DT_STRING,
                shape: Some(shape),
                string_val: vec![text.as_bytes().to_vec()],
            }),
            metadata: Some(Metadata { plugin_data: Some(PluginData { plugin_name: "text".to_owned() }) }),
        };
        let summary = Some(Summary { value: vec![value] });
        self.append(step, Event { summary, ..Event::default() })
    }

    fn append(&mut self, step: u64, event: Event) -> Result<(), MetricsError> {
        let wall_time = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |now| now.as_secs_f64());
        let step = i64::try_from(step).unwrap_or(i64::MAX);
        let bytes = frame(&Event { wall_time, step, ..event }.encode_to_vec());
        let path = &self.path;
        self.file.write_all(&bytes).map_err(|cause| MetricsError::Io {
            verb: "write",
            path: path.clone(),
            cause,
        })
    }
}

/// Puts a message into a TFRecord frame.
fn frame(message: &[u8]) -> Vec<u8> {
    let length = (message.len() as u64).to_le_bytes();
    let mut bytes = Vec::with_capacity(message.len() + 16);
    bytes.extend_from_slice(&length);
    bytes.extend_from_slice(&masked_crc(&length).to_le_bytes());
    bytes.extend_from_slice(message);
    bytes.extend_from_slice(&masked_crc(message).to_le_bytes());
    bytes
}

/// The checksum of TFRecord: crc32c, rotated and offset so that data holding its own checksum is no special case.
fn masked_crc(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// What a record shows in TensorBoard: scalars of the model, of the constant and of the identity baseline.
///
/// The baselines have the tags of the curves that they belong to and go to runs of their own, so that TensorBoard draws
/// them into the same charts.
pub fn scalars_of(record: &Record) -> [Vec<(String, f64)>; 3] {
    let mut model = Vec::new();
    let (mut constant, mut identity) = (Vec::new(), Vec::new());
    match record {
        Record::Train(train) => {
            model.push(("train/total".to_owned(), f64::from(train.total)));
            model.push(("train/rate".to_owned(), train.rate));
            model.push(("train/gradient norm".to_owned(), train.gradient_norm));
            model.extend(train.terms.iter().map(|term| (format!("train/{}", term.term), term.value)));
        }
        Record::Validation(validation) => {
            for term in &validation.terms {
                let tag = format!("validation/{}", term.term);
                if let Some(baseline) = &term.baseline {
                    let curves = if baseline.name == "identity" { &mut identity } else { &mut constant };
                    curves.push((tag.clone(), baseline.value));
                }
                model.push((tag, term.value));
            }
            let scalars = [
                ("skill", validation.skill),
                ("skill with shuffled actions", validation.skill_shuffled_actions),
                ("drop of skill under shuffled actions", validation.skill_drop),
                ("prediction over variance", validation.prediction_over_variance),
                ("latent std", validation.latent_std),
                ("effective rank", validation.effective_rank),
                ("score", validation.score),
            ];
            model.extend(scalars.map(|(tag, value)| (format!("validation/{tag}"), value)));
            identity.push(("validation/skill".to_owned(), 0.0));
            constant.push(("validation/prediction over variance".to_owned(), 1.0));
            for (kind, dims) in [("state", &validation.states), ("action", &validation.actions)] {
                let tag = |dim: &super::DimReport| format!("{kind}/{}", dim.name);
                model.extend(dims.iter().map(|dim| (tag(dim), dim.error)));
                constant.extend(dims.iter().map(|dim| (tag(dim), dim.variance)));
            }
        }
    }
    [model, constant, identity]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads frames back the way TensorBoard does, both checksums included.
    fn events(bytes: &[u8]) -> Vec<Event> {
        let mut rest = bytes;
        let mut events = Vec::new();
        while !rest.is_empty() {
            let (length, tail) = rest.split_at(8);
            let (crc, tail) = tail.split_at(4);
            assert_eq!(u32::from_le_bytes(crc.try_into().unwrap()), masked_crc(length));
            let (message, tail) = tail.split_at(u64::from_le_bytes(length.try_into().unwrap()) as usize);
            let (crc, tail) = tail.split_at(4);
            assert_eq!(u32::from_le_bytes(crc.try_into().unwrap()), masked_crc(message));
            events.push(Event::decode(message).unwrap());
            rest = tail;
        }
        events
    }

    #[test]
    fn checksums_are_those_of_tensorflow() {
        // The frame of the empty record, as TensorFlow's TFRecordWriter writes it.
        let expected = [0, 0, 0, 0, 0, 0, 0, 0, 0x29, 0x03, 0x98, 0x07, 0xd8, 0xea, 0x82, 0xa2];
        assert_eq!(frame(b""), expected);
    }

    #[test]
    fn files_start_with_version_and_session_and_hold_what_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let mut file = EventFile::create(folder.path(), 7).unwrap();
        file.scalars(8, &[("a".to_owned(), 0.5), ("b".to_owned(), -1.0)]).unwrap();
        file.text(8, "config", "x = 1").unwrap();
        let second = EventFile::create(folder.path(), 9).unwrap();
        assert!(second.path > file.path);

        let events = events(&std::fs::read(&file.path).unwrap());
        assert_eq!(events[0].file_version.as_deref(), Some("brain.Event:2"));
        assert_eq!(events[1].step, 7);
        assert_eq!(events[1].session_log, Some(SessionLog { status: SESSION_START }));
        let values = &events[2].summary.as_ref().unwrap().value;
        assert_eq!((values[0].tag.as_str(), values[0].simple_value), ("a", Some(0.5)));
        assert_eq!((values[1].tag.as_str(), values[1].simple_value), ("b", Some(-1.0)));
        let text = &events[3].summary.as_ref().unwrap().value[0];
        assert_eq!(text.tensor.as_ref().unwrap().string_val, [b"x = 1".to_vec()]);
        assert!(events.iter().all(|event| event.wall_time > 1.6e9));
    }
}
