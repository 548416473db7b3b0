//! Messages to values: run-time decoding by schema.
//!
//! A [`DecodePlan`] is compiled once per channel from the schema and the mapped [`FieldPath`]s. Decoding a message then reads the
//! payload once, steps over what is not mapped, and appends a row of `f64` to a [`RowSink`], without allocation or schema look-up.
//!
//! ```
//! use gawm_ingest::decode::{ChannelSchema, DecodePlan, Decoded, RowSink, SchemaLibrary};
//!
//! let channel = ChannelSchema {
//!     topic: "/arm",
//!     message_encoding: "json",
//!     ..ChannelSchema::default()
//! };
//! let fields = [r#"position[name="elbow"]"#.parse()?, "ok".parse()?];
//! let plan = DecodePlan::compile(&channel, &fields, &SchemaLibrary::builtin())?;
//! let mut sink = RowSink::new();
//! let message = br#"{"stamp": {"sec": 12, "nanosec": 5}, "name": ["wrist", "elbow"], "position": [0.5, 1.5], "ok": true}"#;
//! assert_eq!(plan.decode(message, &mut sink)?, Decoded::Row { stamp_ns: Some(12_000_000_005) });
//! assert_eq!(sink.values(), [1.5, 1.0]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The unit of loss is one message: a [`DecodeError`] costs that message and says why. A [`CompileError`] costs the mapping.

mod camera;
mod channel;
mod error;
mod fields;
mod image;
mod json;
mod path;
mod plan;
mod protobuf;
mod resolve;
mod ros;
mod row;
mod schema;
mod stamp;
mod to_json;
mod transcode;

#[cfg(test)]
mod tests;

pub use camera::{CameraInfo, CropRect};
pub use channel::{ChannelSchema, SchemaLibrary};
pub use error::{CompileError, DecodeError};
pub use fields::{FieldInfo, channel_fields, sample_fields};
pub use image::{
    DecompressError, ImageKind, ImageMessage, ImagePlan, decompress_message, is_compressed_message,
};
pub use path::{FieldPath, PathError, Segment};
pub use plan::{Column, DecodePlan, StampSource};
pub(crate) use resolve::closest_first;
pub use row::{Decoded, RowSink, Scalar, Value};
pub use schema::ros_library::SchemaFolderError;
pub(crate) use stamp::stamp_of_json;
pub use stamp::{StampClass, StampUnit, classify_stamp};
pub use to_json::{decode_to_json, decode_to_json_limited};
